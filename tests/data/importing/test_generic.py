"""The generic preset: a recipe that is odd in every respect, and recipes that are wrong."""

import dataclasses
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from essjax.data import import_dataset
from essjax.data.importing.recipe import load_recipe, make_recipe
from essjax.frames import validate_sequence
from tests.data.importing.dumps import OUR_RULES, H, W, assert_like, imported, rgb, truth, write

ODD = """
optional = ["roughness", "metallic"]
[files]
frame = "{sequence}/beauty_{frame}.exr"
motion = "{sequence}/vectors/{frame}.exr"
reference = "{sequence}/big/{frame}.exr"
metadata = "{sequence}/shot.json"
[channels]
color = ["rgb.R", "rgb.G", "rgb.B"]
base_color = ["albedo.R", "albedo.G", "albedo.B"]
normal = ["N.R", "N.G", "N.B"]
depth = ["distance"]
motion = ["v", "u"]          # y is the first channel of this file
roughness = ["rough"]
metallic = ["metal"]
reactive = ["mask"]
reference = ["R", "G", "B"]
[motion]
sign = "current-previous"
x = "left"
y = "up"
unit = "pixels"
scale = 0.5
resolution = [96, 28]
jittered = true
[depth]
kind = "distance"
scale = 0.3
background = 3000
[jitter]
source = "metadata"
sign = "image"
y = "up"
unit = "ndc"
[color]
encoding = "srgb"
pre_exposed = true
[normal]
encoding = "unsigned"
[base_color]
encoding = "srgb"
"""
CENTER, FOCAL = np.array([11.0, 8.0]), np.array([20.0, 30.0])


def srgb(linear):
    """The curve itself."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def write_odd(folder, known, sequence):
    frames, buffers = known.frames, known.frames.gbuffers
    y, x = np.mgrid[:H, :W] + 0.5
    records = {}
    for t in range(len(frames.cut)):
        jitter, exposure, digits = frames.jitter[t], 0.5 + t, f"{7 + t:03d}"
        before = frames.jitter[max(t - 1, 0)]
        seen = frames.motion[t] + jitter - before  # between the jittered images
        stored = -seen * [-1, -1] * [96 / W, 28 / H] / 0.5
        ray = np.stack([(x + jitter[0] - CENTER[0]) / FOCAL[0], (y + jitter[1] - CENTER[1]) / FOCAL[1]], -1)
        length = np.sqrt(1 + (ray**2).sum(-1))
        sky = np.isinf(buffers.depth[t])
        channels = {
            **rgb(srgb(frames.color[t] * exposure), "rgb."),
            **rgb(srgb(buffers.base_color[t]), "albedo."),
            **rgb((buffers.normal[t] + 1) / 2, "N."),
            "distance": np.where(sky[..., 0], 2e4, buffers.depth[t][..., 0] * length / 0.3),
            "metal": buffers.metallic[t][..., 0],
            "mask": buffers.roughness[t][..., 0],
        }
        write(folder / sequence / f"beauty_{digits}.exr", channels)
        write(folder / sequence / "vectors" / f"{digits}.exr", {"u": stored[..., 1], "v": stored[..., 0]})
        write(folder / sequence / "big" / f"{digits}.exr", rgb(srgb(known.reference[t] * exposure)))
        records[str(7 + t)] = {
            "jitter": (-jitter * [1, -1] / [W / 2, H / 2]).tolist(),
            "exposure": exposure,
            "camera_to_world": np.eye(4).tolist(),
            "focal": FOCAL.tolist(),
            "center": CENTER.tolist(),
        }
    (folder / sequence / "shot.json").write_text(json.dumps({"frames": records}))


@pytest.fixture
def odd(tmp_path):
    (tmp_path / "my.toml").write_text(ODD)
    return tmp_path / "my.toml"


def test_a_recipe_that_is_odd_in_every_respect(tmp_path, odd):
    known = {"b": truth(T=3), "a": truth(T=4, seed=2)}
    for name, sequence in known.items():
        write_odd(tmp_path / "dump", sequence, name)
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "generic", recipe=odd)
    assert list(report.dataset.sequences) == ["a", "b"]
    for name, expected in known.items():
        got = imported(report, name)
        validate_sequence(got, name)
        hit = np.isfinite(expected.frames.gbuffers.depth)
        assert_like(got.frames.jitter, expected.frames.jitter, "jitter")
        np.testing.assert_allclose(got.frames.motion[1:], expected.frames.motion[1:], atol=2e-5)
        assert_like(got.frames.color, expected.frames.color, "color", atol=1e-4, rtol=2e-3)
        assert_like(got.reference, expected.reference, "reference", atol=1e-4, rtol=2e-3)
        assert_like(got.frames.gbuffers.depth, expected.frames.gbuffers.depth, "depth")
        for image in ("base_color", "normal", "metallic"):
            wanted = np.where(hit, getattr(expected.frames.gbuffers, image), 0)
            assert_like(getattr(got.frames.gbuffers, image), wanted, image, atol=1e-3)
        assert_like(got.frames.reactive, expected.frames.gbuffers.roughness, "reactive", atol=1e-3)
        assert got.frames.gbuffers.roughness is None
        np.testing.assert_allclose(got.frames.exposure, 0.5 + np.arange(len(got.frames.cut)))
        np.testing.assert_allclose(got.frames.camera.focal[1], FOCAL)
    assert report.sequence.source["motion"]["jittered"] is True


def test_halton_jitter(tmp_path):
    """Oracle: elements 3, 4, 2 of Halton (2, 3) for the frames 7, 8, 9 of a cycle of three that starts at 2."""
    recipe = """
[files]
frame = "{frame}.exr"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["X", "Y"]
[jitter]
source = "halton"
length = 3
first = 2
"""
    recipe += OUR_RULES
    (tmp_path / "my.toml").write_text(recipe)
    known = truth(T=3, scale=1)
    for t in range(3):
        motion, depth = known.frames.motion[t], known.frames.gbuffers.depth[t]
        planes = {"X": motion[..., 0], "Y": motion[..., 1], "Z": depth[..., 0]}
        write(tmp_path / "dump" / f"{7 + t}.exr", {**rgb(known.frames.color[t]), **planes})
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "generic", recipe=tmp_path / "my.toml", name="walk")
    expected = np.array([[3 / 4, 1 / 9], [1 / 8, 4 / 9], [1 / 4, 2 / 3]]) - 0.5
    got = imported(report, "walk")
    np.testing.assert_allclose(got.frames.jitter, expected, atol=1e-6)
    np.testing.assert_array_equal(got.frames.motion, known.frames.motion)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            'motion.sign = "backwards"',
            r"my\.toml: \[motion\] sign: expected one of previous-current, current-previous,",
        ),
        ('motion = {y = "up", unit = "uv"}', r"\[motion\] sign: missing\. Say which it is, nothing is assumed"),
        (
            "motion.flip = true",
            r"\[motion\]: there is no key 'flip'; the keys are sign, y, unit, x, zero, scale",
        ),
        ('motion.scale = "2"', r"\[motion\] scale: expected a number, got '2'"),
        ("motion.resolution = [96]", r"\[motion\] resolution: expected \[width, height\] in pixels, got \[96\]"),
        ("motion.dilated = 1", r"\[motion\] dilated: expected a true or false, got 1"),
        ("jitter.length = 2.5", r"\[jitter\] length: expected a whole number, got 2\.5"),
        ('depth.kind = "inverse"', r"\[depth\] kind: expected one of linear, distance, reversed, forward"),
        ('chanels.color = ["R"]', r"there is no table 'chanels'; there are .*channels"),
        ('channels.color = ["R", "G"]', r"\[channels\] color: expected a list of 3 channel names, got \['R', 'G'\]"),
        ('channels.depht = ["Z"]', r"\[channels\]: there is no key 'depht'; the keys are color, base_color"),
        ('files.frame = "beauty.exr"', r"\[files\] frame: expected a path with \{frame\} in it, got 'beauty\.exr'"),
        ("jitter.first = -1", r"\[jitter\] first: expected a number at least 0, got -1"),
        ("jitter.length = 0", r"\[jitter\] length: expected a number at least 1, got 0"),
        ("jitter.length = inf", r"\[jitter\] length: expected a finite number, got inf"),
        ("motion.scale = nan", r"\[motion\] scale: expected a finite number, got nan"),
        ("motion.scale = 0", r"\[motion\] scale: expected another number than 0"),
        (f"depth.scale = {10**400}", r"\[depth\] scale: expected a finite number, got 1000"),
        ("depth.near = 0", r"\[depth\] near: expected a number above 0, got 0"),
        ("depth.near = -0.1", r"\[depth\] near: expected a number above 0, got -0\.1"),
        ("depth.near = nan", r"\[depth\] near: expected a finite number, got nan"),
        ("depth.far = nan", r"\[depth\] far: expected a number, got nan"),
        ("depth = {near = 2.0, far = 1.0}", r"\[depth\] near: expected less than far, 1, got 2"),
        ("depth.background = 0", r"\[depth\] background: expected a number above 0, got 0"),
        (
            'depth = {kind = "reversed", zero_is_background = true}',
            r"\[depth\] zero_is_background: only for the kinds linear and distance, got reversed",
        ),
        ('motion.unit = "uv"', r"\[motion\] resolution: only for the unit pixels, got uv"),
        ("motion.resolution = [true, true]", r"\[motion\] resolution: expected \[width, height\] in pixels"),
        ("scale.roughness = 0", r"\[scale\] roughness: expected a number above 0, got 0"),
        ("scale.depth = 2", r"\[scale\]: there is no key 'depth'; the keys are color, base_color, roughness"),
        ('files.frame = "/dump/{frame}.exr"', r"\[files\] frame: expected a path below the dump's folder, got '/dump"),
        ('files.metadata = ""', r"\[files\] metadata: expected a path below the dump's folder, got ''"),
        ('optional = [["metallic"]]', r"optional: expected a list of images of \[channels\]"),
        ("optional = [1]", r"optional: expected a list of images of \[channels\]"),
        ("scale = 2", r"\[scale\]: expected a table, got 2"),
        ('optional = ["depth"]', r"optional: expected a list of images of \[channels\] but color, depth, motion"),
    ],
)
def test_a_wrong_recipe_names_the_table_and_the_key(odd, change, message):
    content = tomllib.loads(ODD)
    for key, value in tomllib.loads(change).items():
        nested = isinstance(value, dict) and isinstance(content.get(key), dict) and not change.startswith("motion = ")
        content[key] = {**content[key], **value} if nested else value
    with pytest.raises(ValueError, match=message):
        make_recipe(content, str(odd))


def test_missing_parts_of_a_recipe(tmp_path, odd):
    content = tomllib.loads(ODD)
    without = lambda *keys: {k: v for k, v in content.items() if k not in keys}
    with pytest.raises(ValueError, match=r"x: \[channels\]: missing\. Expected a table"):
        make_recipe(without("channels"), "x")
    with pytest.raises(
        ValueError, match=r"x: \[channels\]: depth missing\. Every dataset needs color, depth and motion"
    ):
        channels = {k: v for k, v in content["channels"].items() if k != "depth"}
        make_recipe({**content, "channels": channels}, "x")
    with pytest.raises(ValueError, match=r"x: \[files\]: no pattern for base_color\."):
        make_recipe({**content, "files": {"color": "{frame}.exr", "metadata": "a.json"}}, "x")
    with pytest.raises(ValueError, match=r"x: \[files\] metadata: missing\. jitter\.source or color\.pre_exposed"):
        make_recipe({**content, "files": {"frame": "{frame}.exr"}}, "x")
    with pytest.raises(ValueError, match=r"the preset generic needs a recipe: --recipe my\.toml"):
        load_recipe("generic")
    with pytest.raises(ValueError, match=r"nowhere\.toml: expected a recipe in TOML, cannot read it"):
        load_recipe("generic", tmp_path / "nowhere.toml")
    odd.write_text("[files")
    with pytest.raises(ValueError, match=r"my\.toml: expected a recipe in TOML, cannot read it"):
        load_recipe("generic", odd)


def test_metadata_errors(tmp_path, odd):
    write_odd(tmp_path / "dump", truth(T=2), "a")
    path = tmp_path / "dump" / "a" / "shot.json"
    run = lambda: import_dataset(tmp_path / "dump", tmp_path / "out", "generic", recipe=odd)
    content = json.loads(path.read_text())
    content["frames"]["8"]["jitter"] = [0.1]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"sequence a, frame 8: .*shot\.json, frame 8: jitter: expected 2 numbers"):
        run()
    del content["frames"]["8"]["jitter"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"a/shot\.json, frame 8: jitter is missing"):
        run()
    for record in content["frames"].values():
        del record["camera_to_world"]
        record["jitter"] = [0.0, 0.0]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"depth\.kind is distance: that needs the camera of each frame"):
        import_dataset(tmp_path / "dump", tmp_path / "out2", "generic", recipe=odd)
    path.write_text("{}")
    with pytest.raises(ValueError, match=r"shot\.json: the field frames is missing"):
        run()


def test_exposure_is_recorded_where_the_metadata_has_it(tmp_path, odd):
    """The colour of this dump is pre-exposed: without an exposure there is no radiance."""
    write_odd(tmp_path / "dump", truth(T=2), "a")
    path = tmp_path / "dump" / "a" / "shot.json"
    content = json.loads(path.read_text())
    for record in content["frames"].values():
        del record["exposure"]
    path.write_text(json.dumps(content))
    message = "color.pre_exposed is true, but the metadata has no exposure of this frame"
    with pytest.raises(ValueError, match=message):
        import_dataset(tmp_path / "dump", tmp_path / "out", "generic", recipe=odd)
    odd.write_text(odd.read_text().replace("pre_exposed = true", "pre_exposed = false"))
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "generic", recipe=odd)
    assert imported(report, "a").frames.exposure is None


def test_presets_and_the_examples_of_the_guide_load(tmp_path):
    for preset in ("extranet", "unreal", "arm-nss"):
        assert load_recipe(preset).motion.sign == "current-previous"
    guide = Path(__file__).parents[3] / "docs" / "guides" / "importing.md"
    blocks = [block.split("```")[0] for block in guide.read_text().split("```toml\n")[1:]]
    complete = [block for block in blocks if "[files]" in block]
    assert len(complete) == 2 and make_recipe(tomllib.loads(complete[1]), "guide").packings
    recipe = make_recipe(tomllib.loads(complete[0]), "guide")
    assert set(recipe.channels) >= {"color", "depth", "motion", "base_color", "normal"}
    for rule in (
        recipe.motion,
        recipe.depth,
        recipe.jitter,
        recipe.color,
        recipe.normal,
        recipe.base_color,
        recipe.scale,
        recipe.world,
        recipe.reactive,
    ):
        for field in dataclasses.fields(rule):
            assert f"{field.name} = " in complete[0], f"the guide does not show {field.name}"
    change = tmp_path / "change.toml"
    for preset, block in zip(("unreal", "unreal", "arm-nss"), [b for b in blocks if b not in complete], strict=True):
        change.write_text(block)
        assert load_recipe(preset, change) != load_recipe(preset)
