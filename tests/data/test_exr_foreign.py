"""EXR files as others write them: windows, parts, tiles, compression, deep and subsampled data, damaged headers."""

import numpy as np
import OpenEXR
import pytest

from essjax.data import exr
from tests.data.fuzz_exr import fuzz


def window(x0, y0, x1, y1):
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def ramp(height=6, width=8):
    """Every pixel has its own value."""
    return np.arange(height * width, dtype=np.float32).reshape(height, width)


def write(path, channels, **header):
    OpenEXR.File(header, channels).write(str(path))
    return path


def test_overscan_is_cut_away(tmp_path):
    """The display window is the image: pixels 2..5 x 1..4 of those stored."""
    path = write(tmp_path / "a.exr", {"Z": ramp()}, dataWindow=window(-2, -1, 5, 4), displayWindow=window(0, 0, 3, 3))
    np.testing.assert_array_equal(exr.read(path)["Z"], ramp()[1:5, 2:6])
    moved = write(
        tmp_path / "b.exr", {"Z": ramp()}, dataWindow=window(7, 9, 14, 14), displayWindow=window(7, 9, 14, 14)
    )
    np.testing.assert_array_equal(exr.read(moved)["Z"], ramp())


def test_a_part_of_the_image_is_refused(tmp_path):
    path = write(tmp_path / "a.exr", {"Z": ramp()}, dataWindow=window(2, 1, 9, 6), displayWindow=window(0, 0, 15, 9))
    with pytest.raises(
        ValueError, match=r"a\.exr: the file holds the pixels 2\.\.9 x 1\.\.6 .*image 0\.\.15 x 0\.\.9.*crop"
    ):
        exr.read(path)


def test_parts_of_different_sizes_are_cut_to_the_image_or_refused(tmp_path):
    parts = lambda *shapes: [
        OpenEXR.Part({"displayWindow": window(0, 0, 3, 2)}, {f"{n}.X": ramp(*shape)}, n)
        for n, shape in zip("ab", shapes, strict=True)
    ]
    OpenEXR.File(parts((3, 4), (6, 8))).write(str(tmp_path / "a.exr"))
    back = exr.read(tmp_path / "a.exr", ["b.X"])
    np.testing.assert_array_equal(back["a.X"], ramp(3, 4))
    np.testing.assert_array_equal(back["b.X"], ramp()[:3, :4])
    OpenEXR.File(parts((3, 4), (2, 4))).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr: the file holds the pixels 0\.\.3 x 0\.\.1 "):
        exr.read(tmp_path / "a.exr")


def test_a_channel_name_in_two_parts_gets_the_parts_name(tmp_path):
    """Multi-view and multi-part files repeat R, G, B; the raw names would overwrite each other."""
    parts = [OpenEXR.Part({}, {"R": ramp() + i, f"only{i}": ramp()}, view) for i, view in enumerate(("left", "right"))]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    back = exr.read(tmp_path / "a.exr", ["left.R", "right.R"])
    assert set(back) == {"left.R", "right.R", "only0", "only1"}
    np.testing.assert_array_equal(back["right.R"], ramp() + 1)


def test_views_in_one_part_are_channels(tmp_path):
    path = write(tmp_path / "a.exr", {"R": ramp(), "right.R": -ramp()}, multiView=["left", "right"])
    np.testing.assert_array_equal(exr.read(path)["right.R"], -ramp())


@pytest.mark.parametrize("name", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24"])
def test_lossless_compressions_and_types(tmp_path, name):
    expected = {"a": ramp(20, 9), "b": ramp(20, 9).astype(np.float16), "c": ramp(20, 9).astype(np.uint32) + 2**31}
    path = write(tmp_path / "a.exr", dict(expected), compression=getattr(OpenEXR, f"{name}_COMPRESSION"))
    back = exr.read(path)
    for key, plane in expected.items():
        assert back[key].dtype == plane.dtype
        np.testing.assert_array_equal(back[key], plane)


def test_tiles(tmp_path):
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    path = write(tmp_path / "a.exr", {"Z": ramp(20, 33)}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(exr.read(path)["Z"], ramp(20, 33))


def test_deep_files_are_refused(tmp_path):
    samples = np.empty((6, 8), object)
    for y, x in np.ndindex(6, 8):
        samples[y, x] = np.ones(1 + x % 3, np.float32)
    path = write(tmp_path / "a.exr", {"Z": samples}, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(ValueError, match=r"a\.exr.*: deep data has many values per pixel\. Export it flattened"):
        exr.read(path)


def test_subsampled_channels_are_refused(tmp_path):
    """The package cannot write them, so the header of a good file is changed: xSampling 2."""
    path = write(tmp_path / "a.exr", {"RY": ramp()}, compression=OpenEXR.ZIPS_COMPRESSION)
    content = path.read_bytes()
    at = content.index(b"RY\0") + 3 + 4 + 4 + 4  # pixel type, linearity and padding, xSampling
    assert content[at : at + 4] == b"\1\0\0\0"
    path.write_bytes(content[:at] + b"\2" + content[at + 1 :])
    with pytest.raises(
        ValueError, match=r"a\.exr: the channels RY are subsampled \(luminance-chroma\)\. Export as RGB"
    ):
        exr.read(path)


def patched(content, name, at, value):
    """The file with 4 bytes of an attribute's value replaced."""
    start = content.index(name + b"\0")
    start = content.index(b"\0", start + len(name) + 1) + 1 + 4 + at  # the type's name and the size
    return content[:start] + value + content[start + 4 :]


@pytest.mark.parametrize(
    ("name", "at", "value"),
    [
        (b"dataWindow", 8, (2**31 - 2).to_bytes(4, "little")),  # a width of 2^31
        (b"dataWindow", 12, (10**6).to_bytes(4, "little")),  # a million rows
        (b"dataWindow", 8, (-5 % 2**32).to_bytes(4, "little")),  # it ends before it begins
        (b"channels", 0, b"\xff\xfe\xfd\xfc"),  # a name that is not UTF-8
        (b"compression", 0, b"\xc8\0\0\0"),
    ],
)
def test_damaged_headers(tmp_path, name, at, value):
    path = write(tmp_path / "a.exr", {"depth.Z": ramp(), "R": ramp()})
    path.write_bytes(patched(path.read_bytes(), name, at, value))
    with pytest.raises(ValueError, match=r"a\.exr: (the file is damaged|the file is truncated|the file holds)"):
        exr.read(path)


def test_tiles_that_only_a_damaged_header_declares(tmp_path):
    """Found by the fuzzer: such a file of 3 kB made the library allocate 18 GB and take minutes."""
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    path = write(tmp_path / "a.exr", {"R": ramp()}, type=OpenEXR.tiledimage, tiles=tiles)
    path.write_bytes(patched(path.read_bytes(), b"tiles", 4, (2**26 + 8).to_bytes(4, "little")))
    with pytest.raises(ValueError, match=r"a\.exr: the file is damaged \(tiles of 8x67108872\)"):
        exr.read(path)


def test_mutated_files_only_raise_value_errors():
    """4 seconds of a fixed seed; see fuzz_exr for longer runs."""
    (result,) = fuzz(4.0, seed=1)
    assert "failure" not in result, result
    assert result["refused"] > 100 and result["read"] > 10
