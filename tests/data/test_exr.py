"""EXR files: what goes in comes out, and nothing that is missing or damaged goes unnoticed."""

import numpy as np
import OpenEXR
import pytest

from essjax.data import exr
from essjax.files import atomic


def planes(height=5, width=7):
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 3, (height, width, 3)).astype(np.float32)
    return image, {f"color.{suffix}": image[..., i] for i, suffix in enumerate("RGB")}


def test_round_trip_of_strided_views_keeps_every_pixel_in_place(tmp_path):
    """Oracle: rounding to half by NumPy. The raw package scrambles such views."""
    image, channels = planes()
    channels["normal.X"] = image[::-1, ::-1, 0]
    channels["normal.Y"] = image[:, :, 1].T.copy().T
    exr.write(tmp_path / "a.exr", channels)
    back = exr.read(tmp_path / "a.exr")
    assert set(back) == set(channels)
    for name, plane in channels.items():
        assert back[name].dtype == np.float16 and back[name].flags.c_contiguous
        np.testing.assert_array_equal(back[name], plane.astype(np.float16))


def test_depth_position_and_motion_stay_float32_and_ids_stay_integers(tmp_path):
    value = np.float32(123.456789)
    ids = np.array([[0, 70000], [1, 2**31]], np.int64)
    plane = np.full((2, 2), value)
    exr.write(tmp_path / "a.exr", {"depth.Z": plane, "world_position.X": plane, "motion.Y": -plane, "stencil.Y": ids})
    back = exr.read(tmp_path / "a.exr")
    np.testing.assert_array_equal(back["depth.Z"], plane)
    np.testing.assert_array_equal(back["world_position.X"], plane)
    np.testing.assert_array_equal(back["motion.Y"], -plane)
    assert back["stencil.Y"].dtype == np.uint32
    np.testing.assert_array_equal(back["stencil.Y"], ids)


def test_radiance_beyond_half_is_clamped_and_counted_but_depth_may_be_infinite(tmp_path):
    color = np.array([[1e6, 65504.0, 2.0]], np.float32)
    clamped = exr.write(tmp_path / "a.exr", {"color.R": color, "depth.Z": np.full((1, 3), np.inf, np.float32)})
    back = exr.read(tmp_path / "a.exr")
    assert clamped == 1
    np.testing.assert_array_equal(back["color.R"], [[65504.0, 65504.0, 2.0]])
    assert np.isposinf(back["depth.Z"]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_radiance_is_refused(tmp_path, value):
    with pytest.raises(ValueError, match=r"a\.exr, channel color\.R: expected finite values, got .* in 1 of 4 pixels"):
        exr.write(tmp_path / "a.exr", {"color.R": np.array([[0.0, value], [1.0, 2.0]])})
    assert list(tmp_path.iterdir()) == []


def test_bad_arrays_are_refused(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(ValueError, match=r"channel stencil\.Y: expected ids in \[0, 2\^32\), got -1\.\.3"):
        exr.write(path, {"stencil.Y": np.array([[-1, 3]])})
    with pytest.raises(ValueError, match=r"channel R: expected one \[H, W\] plane, got shape \(2, 2, 1\)"):
        exr.write(path, {"R": np.zeros((2, 2, 1))})
    with pytest.raises(ValueError, match=r"channel R: expected float or integer values, got complex128"):
        exr.write(path, {"R": np.zeros((2, 2), complex)})
    with pytest.raises(ValueError, match="expected channels of one size"):
        exr.write(path, {"R": np.zeros((2, 2)), "G": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="got no channels"):
        exr.write(path, {})
    with pytest.raises(ValueError, match=r"missing/a\.exr: cannot write the file"):
        exr.write(tmp_path / "missing" / "a.exr", {"R": np.zeros((2, 2))})


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, {"R": np.ones((2, 2))})
    with pytest.raises(RuntimeError, match="interrupted"), atomic(path) as temporary:
        temporary.write_bytes(b"half a file")
        raise RuntimeError("interrupted")
    np.testing.assert_array_equal(exr.read(path)["R"], np.ones((2, 2)))
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_missing_channels_are_named(tmp_path):
    exr.write(tmp_path / "a.exr", planes()[1])
    with pytest.raises(ValueError, match=r"a\.exr: expected the channels depth\.Z, motion\.X; the file has color\.B, "):
        exr.read(tmp_path / "a.exr", ["motion.X", "depth.Z", "color.R"])


def test_files_that_are_not_there_or_not_exr(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(ValueError, match=r"a\.exr: expected an EXR file, found nothing"):
        exr.read(path)
    with pytest.raises(ValueError, match="found a folder"):
        exr.read(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="found an empty file"):
        exr.read(path)
    path.write_bytes(b"\x89PNG and so on")
    with pytest.raises(ValueError, match="found a file that begins with b'.x89PNG'"):
        exr.read(path)
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n")
    with pytest.raises(ValueError, match=r"a\.exr: this is a Git LFS pointer.*git lfs pull"):
        exr.read(path)


def test_truncation_anywhere_raises(tmp_path):
    """The raw package prints a warning and returns fewer channels."""
    rng = np.random.default_rng(1)
    path = tmp_path / "a.exr"
    exr.write(path, {name: rng.uniform(0, 1, (40, 30)) for name in ("color.R", "color.G", "depth.Z")})
    content = path.read_bytes()
    for share in (0.01, 0.05, 0.2, 0.5, 0.9, 0.999):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=r"a\.exr: .*(damaged|begins)"):
            exr.read(path)


def test_one_damaged_part_of_many_is_noticed(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "a.exr"
    parts = [
        OpenEXR.Part({}, {f"V.{n}.X": rng.uniform(0, 1, (64, 16)).astype("f").repeat(4, 1)}, f"V.{n}") for n in "abc"
    ]
    OpenEXR.File(parts).write(str(path))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = bytes(400)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"truncated or damaged: the channels V\.b\.X cannot be read"):
        exr.read(path)


def test_of_many_channels_the_closest_names_are_shown(tmp_path):
    """A file of an engine: which of its 40 was meant?"""
    plane = np.zeros((2, 2), np.float32)
    names = [f"FinalImagePass{i:02d}.{suffix}" for i in range(10) for suffix in "RGBA"]
    exr.write(tmp_path / "a.exr", dict.fromkeys([*names, "velocity.X", "velocity.Y"], plane))
    with pytest.raises(
        ValueError, match=r"channels Velocity\.V; the file has 42, the closest are velocity\.X, velocity\.Y, F"
    ):
        exr.read(tmp_path / "a.exr", ["Velocity.V"])
