"""Data at the edges: three frames without splits, a line of pixels, a cut on every frame."""

import dataclasses
import re

import pytest

from essjax.data import check as proofs
from essjax.data import write_dataset, write_sequence
from experiments import checks, datasets
from experiments.settings import make_settings
from tests.data.test_store import sequence


@pytest.fixture
def clip(tmp_path):
    """Three frames, which an import leaves in one split."""
    write_sequence(tmp_path / "clip", "a", sequence(T=3))
    return write_dataset(tmp_path / "clip", {"test": ["a"]})


def prepare(clip, tmp_path, **options):
    return datasets.prepare(make_settings("quick"), clip, tmp_path / "out", lambda n, total: None, **options)


def test_what_trains_nothing_needs_a_test_split_alone(clip, tmp_path):
    """``--variant bilinear`` asked for three splits."""
    assert prepare(clip, tmp_path, trained=False) is clip and datasets.evaluated_splits(clip) == ["test"]
    settings = make_settings("quick", {"evaluation.warmup": 0})
    checks.check_scored(clip, settings)  # also with the validation that tuning would have
    message = (
        f"{clip.path}: this run needs the splits train, validation and test; this dataset has test. Import it again "
        "with --train, --validation and --test."
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        prepare(clip, tmp_path, trained=True)
    train = dataclasses.replace(clip, splits={"train": clip.splits["test"]})
    with pytest.raises(
        ValueError, match="this run needs the split test; this dataset has train. Import it again with --test"
    ):
        prepare(train, tmp_path, trained=False)


def test_lines_of_pixels_are_refused_before_any_work(tmp_path):
    """The reader takes them; nothing can be proven or scored on them, and the dataset is named."""
    write_sequence(tmp_path / "line", "a", sequence(T=2, H=1, W=40))
    line = write_dataset(tmp_path / "line", {"test": ["a"]})
    with pytest.raises(ValueError, match="line: expected frames of at least 2x2 pixels, got 40x1: a line"):
        proofs.check_dataset(line)
    with pytest.raises(ValueError, match="line: expected frames of at least 11x11 pixels, the window of SSIM"):
        checks.check_dataset([], line)
