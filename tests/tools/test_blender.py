"""What the Blender script does without Blender: jitter, camera shift, meta.json, and that the importer takes it."""

import json
import runpy
from argparse import ArgumentTypeError
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest

from essjax import scenes
from essjax.data import import_dataset, read_sequence

SCRIPT = Path(__file__).parents[2] / "tools" / "blender" / "clip.py"
clip = SimpleNamespace(**runpy.run_path(str(SCRIPT)))
W, H = 20, 12


def test_jitter_is_that_of_the_built_in_scenes():
    assert clip.jitter(0) == (-0.5, -0.5) and clip.jitter(2) == pytest.approx((0.158038, -0.298014))
    np.testing.assert_allclose([clip.jitter(n) for n in range(40)], scenes.jitter_sequence(40), atol=1e-6)


@pytest.mark.parametrize(
    ("width", "height", "fit", "expected"),
    [
        (480, 270, "AUTO", (0.25 / 480, 0.4 / 480)),
        (480, 270, "HORIZONTAL", (0.25 / 480, 0.4 / 480)),
        (480, 270, "VERTICAL", (0.25 / 270, 0.4 / 270)),
        (270, 480, "AUTO", (0.25 / 480, 0.4 / 480)),
        (270, 480, "HORIZONTAL", (0.25 / 270, 0.4 / 270)),
    ],
)
def test_shift_of_a_sample_to_the_right_and_upwards(width, height, fit, expected):
    """Blender's unit is the side that the sensor is fitted to, its y is up; jitter's y is down."""
    assert clip.camera_shift((0.25, -0.4), width, height, fit) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("width", "height", "fit", "expected"),
    [
        (96, 54, "AUTO", 36.0),
        (96, 54, "HORIZONTAL", 36.0),
        (96, 54, "VERTICAL", 20.0 * 96 / 54),
        (54, 96, "AUTO", 36.0 * 54 / 96),
        (54, 96, "HORIZONTAL", 36.0),
    ],
)
def test_sensor_across_the_width(width, height, fit, expected):
    assert clip.sensor_width(width, height, fit, (36.0, 20.0)) == pytest.approx(expected)


def test_arguments():
    assert clip.parse_size("480x270") == (480, 270)
    assert list(clip.parse_frames("3:5")) == [3, 4, 5]
    with pytest.raises(ValueError, match=r"--size: expected WIDTHxHEIGHT such as 480x270, got '480'"):
        clip.parse_size("480")
    with pytest.raises(ValueError, match=r"--frames: expected FIRST:LAST such as 1:64, from 0 up, got '5:3'"):
        clip.parse_frames("5:3")
    with pytest.raises(ArgumentTypeError, match="expected a whole number above 0, got 0"):
        clip.positive("0")


def record(frame):
    matrix = np.eye(4)
    matrix[0, 3] = 0.1 * frame
    return {
        "jitter": list(clip.jitter(frame)),
        "camera_to_world": matrix.tolist(),
        "lens_mm": 30.0,
        "sensor_width_mm": 36.0,
    }


def write_images(folder, frame):
    """A wall, passes named as Blender 5 does."""
    ones = np.ones((H, W), np.float32)
    passes = {
        "Combined": {c: 0.5 * ones for c in "RGBA"},
        "Depth": {"Z": 4 * ones},
        "Normal": {"X": 0 * ones, "Y": 0 * ones, "Z": ones},
        "Vector": {c: 0 * ones for c in "XYZW"},
        "basecolor": {c: 0.3 * ones for c in "RGB"},
    }
    parts = [
        OpenEXR.Part({}, {f"V.{name}.{c}": plane for c, plane in planes.items()}, f"V.{name}")
        for name, planes in passes.items()
    ]
    lr, hr = clip.image_paths(folder, frame)
    OpenEXR.File(parts).write(str(lr))
    reference = {f"V.Combined.{c}": np.full((2 * H, 2 * W), 0.5, np.float16) for c in "RGB"}
    OpenEXR.File({}, reference).write(str(hr))


def test_a_clip_is_resumed_and_imported(tmp_path):
    """Interrupted after frame 9; frame 10 follows, in the order of numbers and not of text."""
    folder, source = tmp_path / "clip", {"scene": "demo", "hr_samples": 64}
    folder.mkdir()
    path = folder / "meta.json"
    for frames in ((8, 9), (9, 10)):
        meta = clip.open_meta(path, (W, H), 2, source)
        for frame in frames:
            if not clip.is_done(folder, meta, frame):
                write_images(folder, frame)
                clip.add_frame(path, meta, frame, record(frame))
    assert list(json.loads(path.read_text())["frames"]) == ["8", "9", "10"]
    clip.image_paths(folder, 9)[1].rename(folder / "moved")
    assert clip.is_done(folder, meta, 8) and not clip.is_done(folder, meta, 9) and not clip.is_done(folder, meta, 11)
    (folder / "moved").rename(clip.image_paths(folder, 9)[1])
    assert len(list(folder.iterdir())) == 7

    sequence = read_sequence(import_dataset(folder, tmp_path / "out", "blender").dataset, "clip")
    assert sequence.reference.shape == (3, 2 * H, 2 * W, 3)
    np.testing.assert_allclose(sequence.frames.jitter, [clip.jitter(n) for n in (8, 9, 10)], atol=1e-7)
    camera = sequence.frames.camera
    assert camera is not None
    np.testing.assert_allclose(camera.focal[1], 30 / 36 * W)
    np.testing.assert_allclose(camera.camera_to_world[:, 0, 3], [0.8, 0.9, 1.0], atol=1e-6)


def test_a_clip_is_not_continued_with_other_settings(tmp_path):
    path = tmp_path / "meta.json"
    clip.add_frame(path, clip.open_meta(path, (W, H), 2, {"hr_samples": 64}), 1, record(1))
    with pytest.raises(
        ValueError, match=r"meta\.json: .*display_size: asked \[60, 36\], found \[40, 24\]\)\. Choose another"
    ):
        clip.open_meta(path, (W, H), 3, {"hr_samples": 64})
    with pytest.raises(ValueError, match=r"source: asked \{'hr_samples': 8\}, found \{'hr_samples': 64\}"):
        clip.open_meta(path, (W, H), 2, {"hr_samples": 8})
    path.write_text('{"render')
    with pytest.raises(ValueError, match=r"meta\.json: not JSON .*Delete the clip"):
        clip.open_meta(path, (W, H), 2, {"hr_samples": 64})
