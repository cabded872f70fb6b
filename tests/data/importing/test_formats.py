"""PNG, NumPy arrays, safetensors and packed buffers: each written by its definition, imported, compared."""

import json

import cv2
import numpy as np
import pytest

from essjax.data import import_dataset, png
from essjax.data.importing import convert
from tests.data.importing.dumps import OUR_RULES, H, W, assert_like, imported, rgb, truth, write

META = 'metadata = "cameras.json"'


def write_png(path, image):
    """``[H, W, C]`` uint8 or uint16 in the order R, G, B, A."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = image.shape[-1]
    order = [2, 1, 0, 3][:channels] if channels > 1 else [0]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., order]))


def srgb(linear):
    """The sRGB curve (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.clip(linear, 0, None) ** (1 / 2.4) - 0.055)


def pack(values, count, low, high):
    """Bytes of values in [0, 1), high byte first: each holds what those before it leave, by long division."""
    rest, digits = values * high, []
    for _ in range(count):
        digits.append(np.floor(rest))
        rest = (rest - digits[-1]) * low
    return np.stack(digits, axis=-1).astype(np.uint8)


def write_cameras(path, known):
    """The metadata of the guide."""
    camera = known.frames.camera
    records = {
        str(t): {
            "camera_to_world": camera.camera_to_world[t].tolist(),
            "focal": camera.focal[t].tolist(),
            "center": camera.center[t].tolist(),
        }
        for t in range(len(known.frames.cut))
    }
    path.write_text(json.dumps({"frames": records}))


def load(tmp_path, text, name="out", **options):
    """Import ``tmp_path / "dump"`` by a recipe of this text."""
    (tmp_path / "my.toml").write_text(text)
    return import_dataset(tmp_path / "dump", tmp_path / name, "generic", recipe=tmp_path / "my.toml", **options)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_keeps_16_bits(tmp_path, channels):
    """Values that differ in their low bytes only."""
    image = 0x1200 + np.random.default_rng(0).integers(0, 256, (5, 7, channels)).astype(np.uint16)
    write_png(tmp_path / "a.png", image)
    planes = png.read(tmp_path / "a.png")
    assert list(planes) == list("Y" if channels == 1 else "RGBA"[:channels])
    np.testing.assert_array_equal(np.stack(list(planes.values()), axis=-1), image)


def test_grey_with_alpha_and_damage(tmp_path):
    from PIL import Image

    path = tmp_path / "a.png"
    Image.fromarray(np.dstack([np.full((4, 6), 9, np.uint8), np.arange(24, dtype=np.uint8).reshape(4, 6)])).save(path)
    np.testing.assert_array_equal(png.read(path)["A"], np.arange(24).reshape(4, 6))
    with pytest.raises(ValueError, match=r"a\.png: expected the channels R; the file has Y, A"):
        png.read(path, ["R"])
    content = path.read_bytes()
    for damaged in (content[:-20], content[:50] + b"\x7f" + content[51:]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.png: the file is truncated or damaged"):
            png.read(path)
    path.write_bytes(b"GIF89a")
    with pytest.raises(ValueError, match=r"expected a PNG file, found a file that begins with b'GIF8'"):
        png.read(path)


@pytest.mark.parametrize(("low", "high", "count"), [(255, 255, 2), (256, 255, 2), (256, 256, 4), (255, 256, 3)])
def test_unpacking_undoes_long_division(low, high, count):
    values = np.random.default_rng(1).uniform(0, 0.99, (3, 5, 2)).astype(np.float32)
    stored = pack(values, count, low, high).reshape(3, 5, -1)
    got = convert.unpack(stored, 2, low, high)
    np.testing.assert_allclose(got, values, atol=1.01 / (high * low ** (count - 1)) + 1e-7)
    assert convert.unpack(np.array([[[18, 52]]], np.uint8), 1, 256, 256)[0, 0, 0] == 0x1234 / 65536  # by hand


PNG_RECIPE = """
[files]
color = "color.{frame}.png"
depth = "depth.{frame}.png"
motion = "motion.{frame}.png"
reference = "final.{frame}.png"
[channels]
color = ["R", "G", "B"]
depth = ["R", "G", "B", "A"]
motion = ["R", "G", "B", "A"]
reference = ["R", "G", "B"]
[motion]
sign = "current-previous"
y = "up"
unit = "ndc"
packing = [255, 255]
zero = 0.5
scale = 2
[depth]
kind = "reversed"
near = 0.5
packing = [256, 256]
[color]
encoding = "srgb"
"""


def png_dump(folder, known, sky_moves=True):
    """8-bit sRGB colour, 16-bit packed motion, 32-bit packed reversed depth."""
    frames = known.frames
    for t in range(len(frames.cut)):
        for name, image in (("color", frames.color[t]), ("final", known.reference[t])):
            write_png(folder / f"{name}.{t:03d}.png", np.rint(255 * srgb(image / 2)).astype(np.uint8))
        ndc = frames.motion[t] * [-2 / W, 2 / H]
        sky = np.isinf(frames.gbuffers.depth[t])
        stored = 0.5 + 0.5 * np.where(sky & (not sky_moves), 0.0, ndc)
        write_png(folder / f"motion.{t:03d}.png", pack(stored, 2, 255, 255).reshape(H, W, 4))
        write_png(folder / f"depth.{t:03d}.png", pack(0.5 / frames.gbuffers.depth[t], 4, 256, 256).reshape(H, W, 4))


def test_a_clip_of_png(tmp_path):
    known = truth()
    png_dump(tmp_path / "dump", known)
    report = load(tmp_path, PNG_RECIPE)
    got = imported(report, "dump")
    assert got.scale == 2 and not report.warnings
    half_steps = np.array([0.51, 0.51]) / 255**2 * [2 * W, 2 * H]  # of 1 in the packed value, pixels
    assert (np.abs(got.frames.motion - known.frames.motion) <= half_steps + 1e-5).all()
    np.testing.assert_allclose(got.frames.gbuffers.depth, known.frames.gbuffers.depth, rtol=1e-5)
    step = np.abs(np.diff(convert.srgb_to_linear(np.linspace(0, 1, 256)))).max()
    np.testing.assert_allclose(got.frames.color, known.frames.color / 2, atol=step)


def write_safetensors(path, arrays):
    """The format: the header's length, a JSON header, raw arrays."""
    codes = {np.dtype(np.float32): "F32", np.dtype(np.float16): "F16", np.dtype(bool): "BOOL"}
    header, data = {"__metadata__": {"Length": "x"}}, b""
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array).tobytes()
        offsets = [len(data), len(data) + len(raw)]
        header[name] = {"dtype": codes[array.dtype], "shape": list(array.shape), "data_offsets": offsets}
        data += raw
    text = json.dumps(header).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def test_arm_gym(tmp_path):
    """[T, C, H, W]; motion current - previous as (y, x) pixels; forward depth; jitter (y, x); log exposure."""
    known = truth()
    frames, near = known.frames, 0.5
    first = lambda image: np.moveaxis(np.asarray(image, np.float32), -1, 1)
    T = len(frames.cut)
    cut = np.zeros((T, 1), bool)
    cut[2] = True
    arrays = {
        "colour_linear": first(frames.color).astype(np.float16),
        "depth": first(1 - near / frames.gbuffers.depth),
        "motion_lr": first(-frames.motion[..., ::-1]),
        "ground_truth_linear": first(known.reference).astype(np.float16),
        "jitter": frames.jitter[:, ::-1, None, None].astype(np.float32),
        "exposure": np.full((T, 1), np.log(3.0), np.float32),
        "zNear": np.full((T, 1), near, np.float32),
        "zFar": np.full((T, 1), 5000.0, np.float32),
        "infinite_zFar": np.ones((T, 1), bool),
        "camera_cut": cut,
    }
    write_safetensors(tmp_path / "dump" / "0007.safetensors", arrays)
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "arm-gym")
    got = imported(report, "0007")
    assert report.sequence.numbers == tuple(range(T)) and got.frames.cut.tolist() == [True, False, True, False]
    for name in ("color", "motion", "jitter"):
        assert_like(getattr(got.frames, name), getattr(frames, name), name)
    np.testing.assert_allclose(got.frames.gbuffers.depth, frames.gbuffers.depth, rtol=1e-4)
    np.testing.assert_allclose(got.frames.exposure, 3.0, rtol=1e-6)
    assert_like(got.reference, known.reference, "reference")


@pytest.mark.parametrize("channels", [34, 35])
def test_stssnet(tmp_path, channels):
    """One array of halves per frame, blue first: colour at 0, base colour 21, metallic 24, ..., motion near the end."""
    known = truth(H=38, W=40, T=3)
    frames, buffers = known.frames, known.frames.gbuffers
    for t in range(3):
        total = np.zeros((38, 40, channels), np.float16)
        sky = np.isinf(buffers.depth[t])
        total[..., 0:3], total[..., 21:24] = frames.color[t][..., ::-1], buffers.base_color[t][..., ::-1]
        total[..., 24:25], total[..., 25:26] = buffers.metallic[t], buffers.roughness[t]
        total[..., 26:27] = np.where(sky, 6e4, buffers.depth[t])
        total[..., 27:30] = (buffers.normal[t] * [1, -1, 1])[..., ::-1]
        total[..., channels - 2], total[..., channels - 3] = -frames.motion[t][..., 0], frames.motion[t][..., 1]
        for folder, name, image in (
            ("NPY", f"compressed.{t + 5:04d}.NoWarp.npy", total),
            ("HR", f"compressedHR.{t + 5:04d}.npy", known.reference[t][..., ::-1].astype(np.float16)),
        ):
            (tmp_path / "dump" / folder).mkdir(parents=True, exist_ok=True)
            np.save(tmp_path / "dump" / folder / name, image)
    got = imported(import_dataset(tmp_path / "dump", tmp_path / "out", "stssnet"), "dump")
    assert got.scale == 2
    for name in ("color", "motion"):
        assert_like(getattr(got.frames, name), getattr(frames, name), name, atol=1e-3)
    for name in ("base_color", "normal", "depth", "roughness", "metallic"):
        assert_like(getattr(got.frames.gbuffers, name), getattr(buffers, name), name, atol=2e-3)
    assert_like(got.reference, known.reference, "reference", atol=1e-3)


def test_arrays_per_frame_and_a_wrong_shape(tmp_path):
    known = truth(T=2)
    folder = tmp_path / "dump"
    folder.mkdir()
    for t in range(2):
        frame = known.frames
        np.save(folder / f"color{t}.npy", np.moveaxis(frame.color[t], -1, 0)[None])  # [1, C, H, W]
        np.savez(folder / f"rest{t}.npz", z=frame.gbuffers.depth[t][..., 0], mv=frame.motion[t])
    recipe = """
[files]
color = "color{frame}.npy"
frame = "rest{frame}.npz"
[channels]
color = ["0", "1", "2"]
depth = ["z.0"]
motion = ["mv.0", "mv.1"]
"""
    got = imported(load(tmp_path, recipe + OUR_RULES), "dump")
    assert_like(got.frames.color, known.frames.color, "color")
    assert_like(got.frames.motion, known.frames.motion, "motion")
    np.save(folder / "color0.npy", np.zeros((3, 4, 5, 6)))
    with pytest.raises(ValueError, match=r"color0\.npy, channel 0: expected an image \[H, W\].*leave \{frame\} out"):
        load(tmp_path, recipe + OUR_RULES, "again")
    with pytest.raises(ValueError, match=r"expected the channel q\.0; the file has z\.0, mv\.0"):
        np.save(folder / "color0.npy", known.frames.color[0])
        load(tmp_path, recipe.replace("z.0", "q.0") + OUR_RULES, "third")


def test_motion_and_depth_at_the_size_of_the_reference(tmp_path):
    """Read at the display pixel in which the sample lies: the one at (x, y) = floor(2 (i + 0.5 + jitter))."""
    known, rng = truth(T=2), np.random.default_rng(5)
    big_motion, big_depth = rng.normal(size=(2, 2 * H, 2 * W, 2)), rng.uniform(1, 9, (2, 2 * H, 2 * W, 1))
    jitter = [0.3, -0.4]
    for t in range(2):
        planes = {"Z": big_depth[t, ..., 0], "u": big_motion[t, ..., 0], "v": big_motion[t, ..., 1]}
        write(tmp_path / "dump" / f"big.{t}.exr", planes)
        write(tmp_path / "dump" / f"color.{t}.exr", rgb(known.frames.color[t]))
    (tmp_path / "dump" / "j.json").write_text(json.dumps({"frames": {str(t): {"jitter": jitter} for t in range(2)}}))
    recipe = """
[files]
color = "color.{frame}.exr"
frame = "big.{frame}.exr"
metadata = "j.json"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["u", "v"]
[jitter]
source = "metadata"
"""
    got = imported(load(tmp_path, recipe + OUR_RULES), "dump")
    column, row = 2 * 5 + 1, 2 * 3 + 0  # pixel (5, 3): 2 (5.5 + 0.3) = 11.6, 2 (3.5 - 0.4) = 6.2
    np.testing.assert_allclose(got.frames.motion[1, 3, 5], big_motion[1, row, column] / 2, rtol=1e-6)
    np.testing.assert_allclose(got.frames.gbuffers.depth[1, 3, 5], big_depth[1, row, column], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "channels", "expected"),
    [("mask", '["R"]', 0.25), ("transmittance", '["R"]', 0.75), ("radiance", '["R", "G", "B"]', 1.0)],
)
def test_separate_translucency_becomes_reactive(tmp_path, kind, channels, expected):
    known = truth(T=1)
    frames = known.frames
    layer = np.zeros((H, W, 3))
    layer[2, 3, 0] = 0.25
    planes = {**rgb(frames.color[0]), "Z": frames.gbuffers.depth[0, ..., 0]} | rgb(layer, "glass.")
    planes |= {"u": frames.motion[0, ..., 0], "v": frames.motion[0, ..., 1]}
    write(tmp_path / "dump" / "a.0.exr", planes)
    recipe = f"""
[files]
frame = "a.{{frame}}.exr"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["u", "v"]
reactive = {channels.replace('"R"', '"glass.R"').replace('"G"', '"glass.G"').replace('"B"', '"glass.B"')}
[reactive]
kind = "{kind}"
"""
    got = imported(load(tmp_path, recipe + OUR_RULES), "dump")
    assert got.frames.reactive[0, 2, 3, 0] == pytest.approx(expected)
    assert got.frames.reactive[0, 0, 0, 0] == (1.0 if kind == "transmittance" else 0.0)
