"""Values that a recipe does not explain: counted where they are clipped, refused where there are many."""

import dataclasses
import json

import numpy as np
import OpenEXR
import pytest

from essjax.data import import_dataset
from essjax.data.importing.facts import FrameFacts, generic_facts
from essjax.data.importing.images import Stored, buffer, radiance, read_images, view_depth
from essjax.data.importing.recipe import ScaleRule, make_recipe
from tests.data.importing.dumps import OUR_RULES, H, W, imported, rgb, truth, write

RECIPE = """
[files]
frame = "{frame}.exr"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["X", "Y"]
base_color = ["albedo.R", "albedo.G", "albedo.B"]
normal = ["N.X", "N.Y", "N.Z"]
roughness = ["rough"]
"""
RECIPE += OUR_RULES
NOWHERE = np.zeros(2, np.float32)


def recipe(**tables):
    content = {
        "files": {"frame": "{frame}.exr"},
        "channels": {
            "color": ["R", "G", "B"], "depth": ["Z"], "motion": ["X", "Y"], "base_color": ["a.R", "a.G", "a.B"],
            "normal": ["N.X", "N.Y", "N.Z"], "roughness": ["rough"], "reactive": ["mask"],
        },
        "motion": {"sign": "previous-current", "y": "down", "unit": "pixels"},
        "depth": {"kind": "linear"},
    }  # fmt: skip
    return make_recipe({**content, **tables}, "x")


def plane(*values):
    """``[1, n, 1]``."""
    return np.asarray(values, np.float32)[None, :, None]


def run(folder, change, extra=""):
    """Import two frames after ``change(channels)``."""
    known = truth(T=2, scale=1)
    buffers = known.frames.gbuffers
    for t in range(2):
        channels = {
            **rgb(known.frames.color[t]),
            **rgb(buffers.base_color[t], "albedo."),
            "Z": buffers.depth[t][..., 0],
            "rough": buffers.roughness[t][..., 0],
            **{f"N.{name}": buffers.normal[t][..., i] for i, name in enumerate("XYZ")},
            **{name: known.frames.motion[t][..., i] for i, name in enumerate("XY")},
        }
        write(folder / "dump" / f"{t}.exr", {**channels, **change(channels)})
    (folder / "my.toml").write_text(RECIPE + extra)
    report = import_dataset(folder / "dump", folder / "out", "generic", recipe=folder / "my.toml", name="a")
    return known, report


def test_radiance_beyond_half_is_counted(tmp_path):
    """It was flattened before anybody counted; now all three channels of a frame and of its reference are."""
    known, report = run(tmp_path, lambda c: {n: c[n] * 1e6 + 1e6 for n in "RGB"})
    assert report.totals["clamped"] == 2 * 2 * 3 * H * W and report.totals["infinite"] == 0
    assert imported(report, "a").frames.color.max() == 65504
    (tmp_path / "second").mkdir()
    known, report = run(tmp_path / "second", lambda c: {n: c[n] * 1e6 for n in "RGB"}, "[scale]\ncolor = 1e-6\n")
    assert report.totals["clamped"] == 0
    np.testing.assert_allclose(imported(report, "a").frames.color, known.frames.color, rtol=1e-3)


def test_infinite_and_negative_radiance():
    color, counts = radiance(np.float32([[[np.inf, -1.0, 7e4]]]), recipe(), FrameFacts())
    np.testing.assert_array_equal(color[0, 0], np.float32([65504, 0, 7e4]))
    assert counts == {"negative": 1, "infinite": 1}
    assert radiance(np.float32([[[np.inf, 0, 0]]]), recipe(color={"encoding": "srgb"}), FrameFacts())[0].max() == 65504


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        (
            ("rough",),
            r"frame 0: roughness \(rough\): expected values in \[0, 1\], found .* to 2\d\d\.?\d*, outside in ",
        ),
        (
            ("albedo.R", "albedo.G", "albedo.B"),
            r"base_color \(albedo\.R, .*\[scale\] base_color in the recipe.*0\.0039216",
        ),
    ],
)
def test_buffers_in_bytes_are_refused(tmp_path, channels, message):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, lambda c: {name: c[name] * 255 for name in channels})


def test_buffers_in_bytes_with_their_scale(tmp_path):
    bytes_ = ("rough", "albedo.R", "albedo.G", "albedo.B")
    scale = "[scale]\nroughness = 0.00392156862745098\nbase_color = 0.00392156862745098\n"
    known, report = run(tmp_path, lambda c: {name: c[name] * 255 for name in bytes_}, scale)
    got, expected = imported(report, "a").frames.gbuffers, known.frames.gbuffers
    hit = np.isfinite(expected.depth)
    np.testing.assert_allclose(got.roughness, np.where(hit, expected.roughness, 0), atol=1e-3)
    np.testing.assert_allclose(got.base_color, np.where(hit, expected.base_color, 0), atol=1e-3)
    assert report.totals["outside"] == 0


def test_a_small_excess_is_counted_and_clipped():
    stored, hit = np.full((10, 10, 1), 0.5, np.float32), np.ones((10, 10, 1), bool)
    stored[0, :4] = 30.0
    stored[1:9] = -0.01  # a denoiser's
    hit[9] = False
    stored[9] = 99.0  # sky: whatever it holds
    image, outside = buffer("roughness", stored, hit, recipe())
    assert outside == 84 and not image[9].any()
    np.testing.assert_array_equal(image[0, 3:5, 0], [1.0, 0.5])
    image, outside = buffer("reactive", stored[:9], hit[:9], recipe())
    assert outside == 84
    with pytest.raises(ValueError, match=r"reactive \(mask\): .*found -0\.01 to 99, outside in 14\.0% of the pixels"):
        buffer("reactive", stored, hit, recipe())
    scaled = dataclasses.replace(recipe(), scale=ScaleRule(roughness=1 / 30))
    np.testing.assert_allclose(buffer("roughness", stored, hit, scaled)[0][0, 0], 1.0)


def normals(count=400):
    vectors = np.random.default_rng(3).normal(size=(20, count // 20, 3))
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def test_normals_in_the_other_encoding_are_refused():
    known, hit = normals(), np.ones((20, 20, 1), bool)
    unsigned = recipe(normal={"encoding": "unsigned"})
    message = r"normal \(N\.X, N\.Y, N\.Z\): read as signed, .*none has a negative.*\[normal\] encoding unsigned,"
    with pytest.raises(ValueError, match=message):
        buffer("normal", 0.5 * known + 0.5, hit, recipe())
    message = r"read as unsigned, their lengths are .*some components are negative.*\[normal\] encoding signed,"
    with pytest.raises(ValueError, match=message):
        buffer("normal", known, hit, unsigned)
    with pytest.raises(ValueError, match=r"read as signed, their lengths are 3\.00 to 3\.00 instead of 1"):
        buffer("normal", 3 * known, hit, recipe())
    for stored, rule in ((known, recipe()), (0.5 * known + 0.5, unsigned)):
        np.testing.assert_allclose(buffer("normal", stored, hit, rule)[0], known, atol=1e-5)


def test_normals_that_are_right_are_not_refused():
    """One wall: no negative component, but unit length. Shorter ones at silhouettes, none on the sky."""
    wall, hit = np.zeros((20, 20, 3), np.float32), np.ones((20, 20, 1), bool)
    wall[..., 2] = 1
    wall[:8] *= 0.6
    wall[-2:] = -1
    hit[-2:] = False
    image, _ = buffer("normal", wall, hit, recipe())
    np.testing.assert_array_equal(image[..., 2], np.where(hit[..., 0], 1, 0))
    small = buffer("normal", 0.3 * wall[:3], hit[:3], recipe())[0]  # too few to say
    np.testing.assert_allclose(small[..., 2], 1, rtol=1e-6)


def test_ids_of_32_bits_keep_apart(tmp_path):
    """float32 would merge the first two."""
    ids = np.uint32([[16777216, 16777217, 2**31 - 1]])
    OpenEXR.File({}, {"id": ids}).write(str(tmp_path / "a.exr"))
    stored = read_images({"stencil": Stored(tmp_path / "a.exr", ("id",))})[0]["stencil"]
    image, _ = buffer("stencil", stored, np.ones((1, 3, 1), bool), recipe())
    np.testing.assert_array_equal(image[..., 0], ids)
    for bad in (3e9, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"stencil: expected ids up to 2147483647, got .*Renumber the objects"):
            buffer("stencil", np.float64([[[bad], [5]]]), np.ones((1, 2, 1), bool), recipe())


def test_depth_that_says_background_by_0_or_where_half_ends():
    depth = lambda stored, **rule: view_depth(stored, recipe(depth=rule), FrameFacts(), NOWHERE)[0, :, 0].tolist()
    assert depth(plane(0, 2, 65504), kind="linear", zero_is_background=True) == [np.inf, 2, np.inf]
    assert depth(plane(0, 2), kind="linear") == [0, 2]
    assert depth(plane(0, -2, -500, -65504), kind="linear", scale=-0.5, background=100, zero_is_background=True) == [
        np.inf, 1, np.inf, np.inf,
    ]  # fmt: skip
    assert depth(plane(-3, -4), kind="linear", scale=-1) == [3, 4]
    assert depth(plane(0, 0.5), kind="reversed", near=0.25) == [np.inf, 0.5]


def test_planes_of_the_metadata(tmp_path):
    """A number written as a text is one; no number, or a far plane before the near one, is refused."""
    path = tmp_path / "shot.json"
    frames = {"1": {"near": "0.25", "far": None}, "2": {"near": "close"}, "3": {"near": 2, "far": 1}, "4": {"near": 0}}
    path.write_text(json.dumps({"frames": frames}))
    facts, rule = generic_facts(path, W, H), recipe(depth={"kind": "reversed"})
    np.testing.assert_array_equal(view_depth(plane(0.5), rule, facts(1, {}), NOWHERE), 0.5)
    with pytest.raises(ValueError, match=r"shot\.json, frame 2: near: expected a number or null, got 'close'"):
        facts(2, {})
    for number, near, far in ((3, 2, "1"), (4, 0, "inf")):
        with pytest.raises(ValueError, match=rf"expected 0 < near < far of the planes, got near {near} and far {far}"):
            view_depth(plane(0.5), rule, facts(number, {}), NOWHERE)


def test_brackets_in_file_names_are_no_wildcards(tmp_path):
    run(tmp_path, lambda c: {})
    dump = tmp_path / "dump"
    for path in list(dump.glob("*.exr")):
        path.rename(dump / f"[x] {path.name}")
    (tmp_path / "my.toml").write_text(RECIPE.replace('"{frame}.exr"', '"[x] {frame}.exr"'))
    report = import_dataset(dump, tmp_path / "out2", "generic", recipe=tmp_path / "my.toml", name="a")
    assert report.sequence.numbers == (0, 1)
