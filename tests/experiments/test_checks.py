"""Everything that can be refused is refused before a frame is rendered, and leaves nothing behind."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from essjax.data import write_dataset, write_sequence
from experiments import run
from experiments.checks import check_settings
from experiments.members import all_settings, resolve
from experiments.settings import PRESETS
from tests.helpers import make_sequence


def member(name, preset, overrides):
    return resolve(all_settings([name], preset, overrides), preset, Path("out"))[name]


def printed(capsys):
    return capsys.readouterr().out.replace("\n", " ")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_has_frames_to_score(preset):
    check_settings([member("extrass", preset, ["data.test_sequences=4"])])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["evaluation.warmup=5"], "scenes, split test: expected frames to score in .*, got none in test-cuts-"),
        (["evaluation.tune=true", "evaluation.warmup=8"], "validation: .* got none in validation-corrid"),
        (["stages.crop=[32,20]"], r"expected at least 24x24 LR .* got 32x20 from crop \(32, 20\) of 48x28 frames"),
        (["data.size=[40,20]"], "got 32x20 from crop"),
    ],
)  # fmt: skip
def test_settings_are_refused_before_anything_is_rendered(overrides, message, tmp_path, capsys):
    with pytest.raises(ValueError, match=message):
        check_settings([member("extrass", "smoke", overrides)])
    assert run.main(["--preset", "smoke", "--out", str(tmp_path / "out"), "--set", *overrides]) == 2
    assert not (tmp_path / "out").exists()


def test_the_crop_is_of_no_matter_where_nothing_is_trained():
    check_settings([member("taau", "smoke", ["stages.crop=[8,8]"])])


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """A dataset without normals and base colour, at twice the size, of 5 frames."""
    folder = tmp_path_factory.mktemp("imported")
    sequence = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(0, 5, 1, 24, 32))
    gbuffers = dataclasses.replace(sequence.frames.gbuffers, normal=None, base_color=None)
    sequence = dataclasses.replace(sequence, frames=dataclasses.replace(sequence.frames, gbuffers=gbuffers))
    write_sequence(folder, "a", sequence)
    write_dataset(folder, {split: ["a"] for split in ("train", "validation", "test")})
    return folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variant", "fasset"], "fasset cannot run on it: this dataset has no base_color, normal."),
        (["--variant", "nsrr", "--set", "data.fresh=3"], "was not made by the built-in renderer"),
        (["--variant", "nsrr", "--set", "nsrr.crop=[24,16]"], "got 24x16 from crop (24, 16) of 32x24 frames"),
        (
            ["--variant", "nsrr", "--set", "evaluation.warmup=5"],
            "expected frames to score in every sequence, got none in a",
        ),
    ],
)
def test_data_is_refused_before_the_folder_is_taken(imported, arguments, message, tmp_path, capsys):
    out = tmp_path / "out"
    assert run.main(["--preset", "smoke", "--data", str(imported), "--out", str(out), *arguments]) == 2
    assert message in printed(capsys)
    assert not out.exists()
