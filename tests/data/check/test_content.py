"""Depth, cameras, normals, values, duplicates and cuts: each defect is named, with its fix."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from essjax.data import exr, read_dataset
from essjax.data.check.pairs import steps
from essjax.data.check.values import ValuesCheck, judge_values
from tests.data.check.corrupt import NAME, H, W, assert_wrong, edit, edit_records, put, rows, write_raw


def test_reversed_depth(copy):
    edit(copy, lambda planes, number: {"depth.Z": np.float32(0.1) / planes["depth.Z"]})
    assert_wrong(copy, "depth", "depth is reversed")
    edit_records(copy, lambda record, number: record.update(camera=None))  # by what hides what
    assert_wrong(copy, "depth", "depth is reversed")


def test_order_of_depth_without_cameras(copy):
    edit_records(copy, lambda record, number: record.update(camera=None))
    finding = rows(copy)["depth"]
    assert finding.verdict == "ok" and "what hides is the nearer surface in" in finding.found


def test_other_depths(copy):
    depths = {p: exr.read(p)["depth.Z"] for p in copy.glob("*/lr.*.exr")}
    restore = lambda change: [
        write_raw(p, {**exr.read(p), "depth.Z": np.float32(change(z))}) for p, z in depths.items()
    ]
    restore(lambda z: z * 100)
    assert_wrong(copy, "depth", "different units: divide depth by 100")
    restore(lambda z: -z)
    assert_wrong(copy, "depth", "negate it at import if -z is stored")
    camera = json.loads((copy / NAME / "sequence.json").read_text())["frames"][0]["camera"]
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    ray = np.hypot(np.hypot((x - W / 2) / camera["focal"][0], (y - H / 2) / camera["focal"][1]), 1)
    restore(lambda z: z * ray)
    assert_wrong(copy, "depth", "depth lies along the ray")


def test_cameras_of_another_frame(copy):
    edit(copy, lambda planes, number: {f"world_position.{c}": np.zeros((H, W), np.float32) for c in "XYZ"})
    records = json.loads((copy / NAME / "sequence.json").read_text())["frames"]
    edit_records(copy, lambda record, number: record.update(camera=records[number // 2]["camera"]))
    assert_wrong(copy, "cameras", "is camera_to_world row-major, looking along -Z")


def test_normals(copy):
    half = lambda planes: {name: np.float16(0.5 * planes[name] + 0.5) for name in planes if name.startswith("normal.")}
    edit(copy, lambda planes, number: half(planes))
    assert_wrong(copy, "normals", "normals are encoded in [0, 1]: n = 2 v - 1")
    edit(copy, lambda planes, number: {name: np.float16(1 - 2 * planes[name]) for name in half(planes)})
    assert_wrong(copy, "normals", "normals point into the surfaces: negate them")
    edit_records(copy, lambda record, number: record.update(camera=None))
    assert rows(copy)["normals"].verdict == "ok"  # no cameras: nothing says where the surfaces face


def values(folder):
    """The checks of values alone: no warps."""
    check = ValuesCheck()
    for step in steps(read_dataset(folder), NAME, 0):
        check.add(step)
    return {finding.check: finding for finding in judge_values([check])}


@pytest.mark.parametrize(
    ("channel", "value", "found", "fix"),
    [
        ("color.G", np.nan, f"NaN: color.G in 1 frames ({NAME} 3)", "mark the pixels as reactive"),
        ("motion.Y", np.nan, "NaN: motion.Y in 1 frames", "find what makes them"),
        ("normal.X", np.inf, "infinite: normal.X", "clamp"),
        ("color.R", -0.5, "negative: color.R", "clamp at 0 at import"),
        ("base_color.B", 200.0, "out of [0, 1]: base_color.B", "in [0, 255]"),
    ],
)
def test_values(copy, channel, value, found, fix):
    edit(copy, lambda planes, number: {channel: put(planes[channel], value)}, only=[3])
    finding = values(copy)["values"]
    assert finding.verdict == "wrong" and found in finding.found and fix in finding.fix


def test_a_value_that_breaks_every_warp_is_still_only_named(copy):
    """NaN and infinities must not spread into the other checks."""
    bad = {"color.G": np.nan, "motion.X": np.inf, "depth.Z": np.nan}
    edit(copy, lambda planes, number: {name: put(planes[name], value) for name, value in bad.items()}, only=[3])
    verdicts = {name: finding.verdict for name, finding in rows(copy).items()}
    assert verdicts.pop("values") == "wrong" and set(verdicts.values()) == {"ok"}


def test_constant_channels_and_clipped_colour(copy):
    edit(copy, lambda planes, number: {"base_color.G": np.full((H, W), 0.5, np.float16)})
    edit(copy, lambda planes, number: {"roughness.Y": np.full((H, W), 0.25, np.float16)})
    clip = lambda planes: {n: np.minimum(8 * p, 1).astype(np.float16) for n, p in planes.items() if n[-1] in "RGB"}
    edit(copy, lambda planes, number: {n: p for n, p in clip(planes).items() if n.startswith("color")})
    edit(copy, lambda planes, number: clip(planes), kind="hr")
    found = values(copy)
    assert found["constant channels"].verdict == "warning"
    assert "base_color.G = 0.5" in found["constant channels"].found
    assert found["colour scale"].verdict == "warning" and "never exceeds 1" in found["colour scale"].found
    edit(copy, lambda planes, number: {"color.G": np.full((H, W), 0.5, np.float16)})
    assert values(copy)["constant channels"].verdict == "wrong"


@pytest.mark.parametrize("kinds", [("lr", "hr"), ("hr",)])
def test_a_duplicated_frame(copy, kinds):
    for kind in kinds:
        shutil.copy(copy / NAME / f"{kind}.0003.exr", copy / NAME / f"{kind}.0004.exr")
    found = rows(copy)
    assert found["duplicated frames"].verdict == "wrong" and f"{NAME} 4" in found["duplicated frames"].found
    assert {row.verdict for name, row in found.items() if name != "duplicated frames"} == {"ok"}


def test_cuts(copy):
    edit_records(copy, lambda record, number: record.update(cut=number in (0, 5)))
    finding = rows(copy)["cuts"]
    assert finding.verdict == "warning" and f"go on with the frame before: {NAME} 5" in finding.found
    turn = lambda planes: {n: np.roll(p, (p.shape[0] // 2, p.shape[1] // 3), (0, 1)) for n, p in planes.items()}
    edit(copy, lambda planes, number: turn(planes), kind="hr", only=range(3, 7))
    finding = rows(copy)["cuts"]
    assert finding.verdict == "wrong" and f"not marked as cuts: {NAME} 3" in finding.found
    assert '"cut": true' in finding.fix


@pytest.mark.parametrize(
    ("change", "verdict", "fix"),
    [
        (lambda color: np.rint(np.clip(color, 0, 1) * 255) / 255, "warning", "encoding 'srgb' in [color]"),
        (lambda color: np.rint(np.clip(color, 0, 1) * 255), "warning", "color in [scale]"),
        (lambda color: np.float16((np.rint(np.clip(color, 0, 0.9) * 255) / 255) ** 2.2), "ok", ""),
    ],
)
def test_pictures_of_8_bits_that_were_taken_as_linear(good, change, verdict, fix):
    check = ValuesCheck()
    for step in steps(read_dataset(good), NAME, 1):
        check.add(dataclasses.replace(step, raw={**step.raw, "color": change(step.raw["color"])}))
    finding = judge_values([check])[2]
    assert finding.verdict == verdict and fix in finding.fix
    assert judge_values([check], srgb=True)[2].verdict == ("warning" if verdict == "warning" else "ok")


def test_motion_that_is_longer_than_anything_can_be(good):
    check = ValuesCheck()
    for step in steps(read_dataset(good), NAME, 1):
        motion = step.raw["motion"].copy()
        motion[0, 0, 0] = -1e6
        check.add(dataclasses.replace(step, raw={**step.raw, "motion": motion}))
    finding = judge_values([check])[0]
    assert finding.verdict == "wrong" and "beyond the picture: motion.X" in finding.found
    assert "unit in [motion]" in finding.fix and "unwritten in [motion]" in finding.fix
