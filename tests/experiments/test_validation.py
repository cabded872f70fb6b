"""Validation during training: which frames are played, and that their scores are those of the evaluation."""

import dataclasses

import jax
import numpy as np
import pytest

from essjax import methods
from essjax.data import Segment, write_dataset, write_sequence
from experiments.evaluate import Clips, Runner, evaluate
from experiments.members import settings_of
from experiments.validation import CLIPS, SCORED, Scorer, windows
from tests.helpers import make_sequence

H, W = 12, 15


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Three validation clips of 12 frames; the second has a cut at frame 4, the third is scored from frame 7 on."""
    folder = tmp_path_factory.mktemp("validation")
    for index, name in enumerate("abc"):
        sequence = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(index, 12, 1, H, W))
        cut = np.arange(12) == (4 if name == "b" else 0)
        cut[0] = True
        frames = dataclasses.replace(sequence.frames, cut=cut)
        write_sequence(folder, name, dataclasses.replace(sequence, frames=frames))
    segment = Segment("c", 2, 11, 7)
    return write_dataset(folder, {"train": ["a"], "validation": ["a", "b", segment], "test": ["a"]})


def test_windows(dataset):
    found = windows(dataset, settings_of("warp", "smoke", ["evaluation.warmup=5"]), native=False)
    assert [len(window.sequence.frames.cut) for window in found] == [9, 8, 9]
    assert [window.scored for window in found] == [[5, 6, 7, 8], [5, 6, 7], [5, 6, 7, 8]]
    jitter = lambda name, n: dataset.sequences[name].frames[n]["jitter"]
    starts = [window.sequence.frames.jitter[0].tolist() for window in found]
    assert starts == [pytest.approx(jitter(*at)) for at in (("a", 0), ("b", 4), ("c", 2))]
    assert windows(dataset, settings_of("warp", "smoke", ["evaluation.warmup=20"]), native=False) == []


def test_of_many_clips_a_few_are_played(dataset):
    many = dataclasses.replace(dataset, splits={**dataset.splits, "validation": 5 * dataset.splits["validation"]})
    assert len(windows(many, settings_of("warp", "smoke", ["evaluation.warmup=2"]), native=False)) == CLIPS < 15


@pytest.mark.parametrize("method", [methods.bilinear(), methods.warp(), methods.taau()], ids=lambda m: m.info.name)
def test_scores_are_those_of_the_evaluation(dataset, method):
    """Of the first clip, whose window is what evaluation plays from the start: the same frames give the same PSNR."""
    settings = settings_of("warp", "smoke", ["evaluation.warmup=5"])
    alone = dataclasses.replace(dataset, splits={**dataset.splits, "validation": dataset.splits["validation"][:1]})
    example = jax.tree.map(lambda leaf: leaf[:1], windows(alone, settings, native=False)[0].sequence.frames)
    variables = method.init(jax.random.key(0), example)
    scores = Scorer(method, alone, settings)(variables)
    runner = Runner(method, variables, settings.compiler_options)
    curves = evaluate({"it": runner}, Clips(alone, "validation", 5), pictures=0)["curves"]["it"]["a"]
    assert set(scores) == ({"ss"} if method.info.renders_all else set(method.info.predicts))
    for kind, value in scores.items():
        parity = 0 if method.info.renders_all else {"ss": 0, "ess": 1}[kind]
        frames = [n for n in range(5, 5 + SCORED) if method.info.renders_all or n % 2 == parity]
        expected = [entry["psnr"] for entry in curves if entry["kind"] == kind and entry["frame"] in frames]
        assert value == pytest.approx(np.mean(expected), rel=1e-5), kind
