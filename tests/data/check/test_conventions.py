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
from essjax.data.check.geometry import GeometryCheck, judge_geometry
from essjax.data.check.pairs import choose, steps
from essjax.data.check.values import ValuesCheck, judge_values
from essjax.data.layout import SequenceInfo
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
    assert (
        found["motion, references"].verdict == "ok" and "cameras and depth say so" in found["motion, references"].found
    )
    assert found["motion, rendered frames"].verdict == found["jitter, frame to frame"].verdict == "ok"


def test_colour_that_is_its_own_reference_says_nothing_about_jitter(good, tmp_path):
    """An import without references: the same pictures, but nobody can put the references right."""
    change = lambda sequence: dataclasses.replace(sequence, reference=sequence.frames.color)
    folder = rewrite(good, tmp_path / "same", change)
    path = folder / NAME / "sequence.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "source": {"reference": "color"}}))
    report = check_dataset(read_dataset(folder), pairs=2)
    found = {finding.check: finding for finding in report.findings}
    assert report.verdict != "wrong"
    for row in ("jitter, references", "sub-pixel shift"):
        assert (found[row].verdict, found[row].found) == ("not decidable", "the colour is its own reference")
    edit_records(folder, lambda record, _: record.update(jitter=[0.9, 0.0]))
    assert_wrong(folder, "jitter, references", "in [-0.5, 0.5)", pairs=2)


@pytest.mark.parametrize(("frames", "pairs"), [(48, 24), (94, 24), (12, 6), (48, 7)])
def test_pairs_see_every_phase_of_the_jitter(frames, pairs):
    """A jitter of period 2, 3, 4 or one that changes every second frame: each of its steps is looked at.

    A third of the pairs that are expected of each phase is the least that counts.
    """
    records = tuple({"number": number} for number in range(frames))
    chosen = choose(SequenceInfo("x", 4, 4, 1, (), False, {}, frames=records), pairs)
    assert chosen[0] == 0 and len(chosen) == len(set(chosen)) == pairs + 1 and chosen[-1] < frames
    assert abs(sum(index % 2 for index in chosen[1:]) - pairs / 2) <= 0.5
    for period in (3, 4, 8) if pairs == 24 else ():
        phases = np.bincount(np.array(chosen[1:]) % period, minlength=period)
        assert phases.min() >= pairs / period / 3, phases
    assert max(np.diff(chosen)) <= 4 * frames / pairs + 2  # nothing is left out for long


def test_negative_pairs_are_refused():
    with pytest.raises(ValueError, match=r"pairs: expected 0 \(all frames\) or more, got -3"):
        check_dataset(None, pairs=-3)  # type: ignore[arg-type]


def test_how_many_pixels_follow_the_cameras():
    """10 % off may be odd, 35 % is worth a look, 60 % of what is known to stand still is wrong."""

    def judge(off, marked=True):
        check = GeometryCheck(counts={"static": 1000, "off camera": off}, has_stencil=marked)
        return judge_geometry([check], motion_wrong=False)[1]

    assert [judge(off).verdict for off in (0, 100, 110, 350, 490, 600)] == ["ok"] * 2 + ["warning"] * 3 + ["wrong"]
    assert judge(350).fix.startswith("is camera_to_world row-major")
    assert judge(600, marked=False).verdict == "warning"
    assert judge(350, marked=False).fix.startswith("nothing marks what moves by itself (stencil)")


def test_colour_that_was_clipped_at_the_end_of_half(good):
    """99 % of radiance in some other unit, flattened at 65504."""
    check = ValuesCheck()
    for step in steps(read_dataset(good), NAME, 1):
        raw = {**step.raw, "color": np.full_like(step.raw["color"], 65504.0)}
        raw["color"][:4] = 100.0
        check.add(dataclasses.replace(step, raw=raw))
    finding = judge_values([check])[2]
    assert finding.verdict == "warning" and "color never exceeds 65504" in finding.found
    assert "recipe: color in [scale]" in finding.fix


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
    assert {name for name, row in found.items() if row.verdict != "ok"} == {"cameras", "motion, surfaces"}
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
