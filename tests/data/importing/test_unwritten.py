"""Motion where the producer wrote none: from the cameras, by a mask or a rule, or a warning."""

import jax
import numpy as np
import pytest

from essjax.cameras import pixel_positions, static_motion
from tests.data.importing.dumps import H, W, imported, rgb, truth, write
from tests.data.importing.test_formats import load, write_cameras

RECIPE = """
[files]
frame = "a.{frame}.exr"
%s
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["u", "v"]
%s
[motion]
sign = "previous-current"
y = "down"
unit = "pixels"
%s
[depth]
kind = "linear"
"""
CAMERAS = 'metadata = "cameras.json"'


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """Sky without motion, and a stripe of surface without any; a mask knows both."""
    folder, known = tmp_path_factory.mktemp("dump"), truth(T=3)
    (folder / "dump").mkdir()
    frames = known.frames
    camera = frames.camera
    motions, missing = np.array(frames.motion), np.isinf(frames.gbuffers.depth)
    stripe = np.zeros_like(missing)
    stripe[:, 4] = True
    positions = pixel_positions(H, W)
    static = np.zeros_like(motions)
    for t in (1, 2):
        now, before = (jax.tree.map(lambda leaf, i=i: leaf[i], camera) for i in (t, t - 1))
        static[t] = static_motion(now, before, positions, frames.gbuffers.depth[t])
    motions[missing[..., 0]] = 0
    for t in range(3):
        planes = {**rgb(frames.color[t]), "Z": frames.gbuffers.depth[t, ..., 0], "mask": ~(missing | stripe)[t, ..., 0]}
        written = np.where(stripe[t], 0, motions[t])
        write(folder / "dump" / f"a.{t}.exr", planes | {"u": written[..., 0], "v": written[..., 1]})
    write_cameras(folder / "dump" / "cameras.json", known)
    return folder, missing, stripe, static


def expect(report, dump, replaced):
    _, missing, stripe, static = dump
    motion = imported(report, "dump").frames.motion
    np.testing.assert_allclose(motion[1:][replaced[1:, ..., 0]], static[1:][replaced[1:, ..., 0]], atol=1e-4)
    kept = ~replaced & (missing | stripe)
    assert (motion[kept[..., 0]] == 0).all()
    assert report.totals.get("unwritten", 0) == replaced[1:].sum() + (replaced[0].sum() if replaced[0].any() else 0)


def test_sky_follows_the_cameras(dump):
    report = load(dump[0], RECIPE % (CAMERAS, "", ""), "sky")
    replaced = dump[1] & np.array([False, True, True])[:, None, None, None]
    expect(report, dump, replaced)
    assert not report.warnings


def test_without_cameras_there_is_a_warning(dump):
    report = load(dump[0], RECIPE % ("", "", ""), "warned")
    (warning,) = report.warnings
    assert "of the background (sky) holds no motion although surfaces move" in warning and "Give the cameras" in warning


@pytest.mark.parametrize(
    ("name", "channels", "rule"),
    [
        ("zero", "", 'unwritten = "zero"'),
        ("mask", 'written = ["mask"]', ""),
        ("background", "", 'unwritten = "background"'),
    ],
)
def test_a_rule_or_a_mask_says_where(dump, name, channels, rule):
    report = load(dump[0], RECIPE % (CAMERAS, channels, rule), name)
    _, missing, stripe, _ = dump
    expect(report, dump, missing if "background" in rule else missing | stripe)
    with pytest.raises(ValueError, match=r"a\.1\.exr: \d+ pixels have no velocity: there the motion follows from"):
        load(dump[0], RECIPE % ("", channels, rule), f"none-{name}")
