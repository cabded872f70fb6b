"""Good datasets are green, and one with a broken convention gets the fix that undoes it.

The oracle is the corruption itself: each takes a dataset that is known to be right, breaks one convention, and knows
what a user has to type to put it right again.
"""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from essjax.data import exr, read_dataset, read_sequence, write_dataset, write_sequence
from essjax.data.check import check_dataset
from tests.data.check.corrupt import (
    CONVENTIONS,
    NAME,
    H,
    W,
    assert_wrong,
    edit,
    edit_records,
    motion,
    rewrite,
    rows,
)

BRIEF = ("x flipped", "y flipped", "both flipped", "twice", "jitter negated")
"""The same on the real clip, which takes longer."""


def test_a_good_dataset_is_green(good):
    report = check_dataset(read_dataset(good))
    assert {finding.check: finding.verdict for finding in report.findings if finding.verdict != "ok"} == {}
    assert report.verdict == "ok" and (report.looked_at, report.frames) == (7, 7)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_broken_convention_gets_its_fix(copy, name):
    corrupt, row, fix = CONVENTIONS[name]
    corrupt(copy)
    assert_wrong(copy, row, fix, pairs=4)


def test_the_chess_clip_is_green_and_motion_gains_6_db(chess):
    """Oracle for the gain: measured when the clip was made, 33.5 dB against 26.7 on the surface."""
    found = rows(chess)
    assert {name: row.verdict for name, row in found.items() if row.verdict != "ok"} == {}
    assert found["motion, references"].numbers["gain"] > 6
    assert f"{found['motion, references'].numbers['gain']:+.1f} dB" in found["motion, references"].found


@pytest.mark.parametrize("name", BRIEF)
def test_a_broken_chess_clip_gets_its_fix(chess, tmp_path, name):
    folder = shutil.copytree(chess, tmp_path / "copy")
    corrupt, row, fix = CONVENTIONS[name]
    corrupt(folder)
    assert_wrong(folder, row, fix, pairs=3)


def test_a_clip_without_motion_is_not_decidable(copy):
    first = {kind: exr.read(copy / NAME / f"{kind}.0000.exr") for kind in ("lr", "hr")}
    ones = {"valid.Y": np.ones((H, W), np.uint32), "steady.Y": np.ones((H, W), np.uint32)}
    still = {"motion.X": np.zeros((H, W), np.float32), "motion.Y": np.zeros((H, W), np.float32)}
    edit(copy, lambda planes, number: {**first["lr"], **ones, **still})
    edit(copy, lambda planes, number: first["hr"], kind="hr")
    records = json.loads((copy / NAME / "sequence.json").read_text())["frames"]
    edit_records(copy, lambda record, number: record.update(jitter=[0, 0], camera=records[0]["camera"]))
    found = rows(copy)
    for name in ("motion, references", "motion, rendered frames", "jitter, references", "jitter, frame to frame"):
        assert found[name].verdict == "not decidable"
    assert "the motion is < 0.25 px" in found["motion, references"].found
    assert found["duplicated frames"].verdict == "ok"  # nothing moves: frames may be equal


def test_one_frame(good, tmp_path):
    found = rows(rewrite(good, tmp_path / "one", lambda sequence: sequence, (2, 2)))
    assert found["motion, references"].verdict == found["cameras"].verdict == "not decidable"
    assert found["depth"].verdict == found["values"].verdict == found["sub-pixel shift"].verdict == "ok"


def test_jittered_references_do_not_blame_motion(good, tmp_path):
    """Scale 1, the reference is the jittered frame itself: motion plus jitter would explain it best."""
    change = lambda sequence: dataclasses.replace(sequence, reference=sequence.frames.color)
    found = rows(rewrite(good, tmp_path / "same", change))
    assert found["jitter, references"].verdict == "wrong"
    assert "switch the jitter of the reference off" in found["jitter, references"].fix
    assert found["motion, references"].verdict == "not decidable"
    assert found["motion, rendered frames"].verdict == found["jitter, frame to frame"].verdict == "ok"


def test_colour_depth_and_motion_alone(good, tmp_path):
    """No cameras, ids, positions or masks: what there is suffices, and the unit of radiance does not matter."""

    def bare(sequence):
        keep = ("base_color", "normal", "depth")
        absent = {f.name: None for f in dataclasses.fields(sequence.frames.gbuffers) if f.name not in keep}
        frames = dataclasses.replace(
            sequence.frames,
            gbuffers=dataclasses.replace(sequence.frames.gbuffers, **absent),
            camera=None,
            color=500 * sequence.frames.color,
        )
        return dataclasses.replace(sequence, frames=frames, reference=500 * sequence.reference, valid=None, steady=None)

    found = rows(rewrite(good, tmp_path / "bare", bare))
    assert {name for name, row in found.items() if row.verdict != "ok"} == {"cameras"}
    assert found["depth"].found.startswith("what hides is the nearer surface in")


def test_motion_that_is_missing(copy):
    motion(lambda x, y: (0 * x, 0 * y))(copy)
    assert_wrong(copy, "motion, references", "motion is not that of cameras and depth")


def test_one_wrong_sequence_among_good_ones_is_named(good, tmp_path):
    sequence = read_sequence(read_dataset(good), NAME)
    frames = dataclasses.replace(sequence.frames, motion=-sequence.frames.motion)
    for name in ("a", "b", "c"):
        write_sequence(tmp_path, name, dataclasses.replace(sequence, frames=frames) if name == "b" else sequence)
    finding = rows(write_dataset(tmp_path, {"train": ["a", "b", "c"]}).path, pairs=3)["motion, references"]
    assert finding.verdict == "wrong" and "sequence b: 'both flipped'" in finding.found


def shift_reference(planes, number):
    """By half a reference pixel to the right and down: a quarter of a rendered pixel."""
    moved = {}
    for name, plane in planes.items():
        plane = 0.5 * (plane + np.roll(plane, 1, 1))
        moved[name] = np.float16(0.5 * (plane + np.roll(plane, 1, 0)))
    return moved


def test_a_shifted_reference(copy):
    edit(copy, shift_reference, kind="hr")
    finding = rows(copy)["sub-pixel shift"]
    assert finding.verdict == "wrong" and "resized with aligned corners" in finding.fix
    np.testing.assert_allclose([finding.numbers["x"], finding.numbers["y"]], 0.25, atol=0.08)
    assert f"move the reference by ({-2 * finding.numbers['x']:+.1f}, " in finding.fix
