"""``essjax import --guess``: what names, values and pictures say, on dumps whose truth is known.

Forty-eight of them, in conventions drawn by lot, are scored by ``tools/verdicts/scramble.py``.
"""

import json
import tomllib

import numpy as np
import pytest

from essjax import cli
from essjax.data import read_dataset, read_sequence
from essjax.data.check import check_dataset
from essjax.data.importing.draft import CERTAIN, LIKELY, UNKNOWN, make_draft
from essjax.data.importing.inventory import role_of, take_stock
from tests.data.check.corrupt import SIZE
from tests.data.importing.dumps import write
from tools.verdicts.clips import render
from tools.verdicts.scramble import Lot, write_dump

WORDS = {
    "color": "beauty",
    "depth": "z",
    "motion": "velocity",
    "normal": "N",
    "base_color": "albedo",
    "reference": "gt",
}
LOT = Lot(
    kind="png", sign=-1, up=True, unit="ndc", depth="reversed", unsigned=True, buffers=False, reference=True,
    jitter="ndc", padding=3, folders=True, words=WORDS,
)  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    return read_sequence(render("fast spin", folder, width=SIZE[0], height=SIZE[1], spp=9), "clip")


def test_png_without_buffers_in_two_commands(clip, tmp_path, capsys):
    """8-bit sRGB, motion in two bytes per component, depth in four: guessed, imported, and the check finds no fault."""
    write_dump(tmp_path / "dump", clip, LOT)
    source, out = str(tmp_path / "dump"), str(tmp_path / "out")
    assert cli.main(["import", source, out, "--guess"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "--preset generic --recipe" in printed and not (tmp_path / "out").exists()
    recipe = tomllib.loads((tmp_path / "out.toml").read_text())
    assert (
        recipe["motion"] | {"zero": 0.5, "packing": [255, 255], "sign": "current-previous", "y": "up"}
        == recipe["motion"]
    )
    assert recipe["depth"]["kind"] == "reversed" and recipe["color"]["encoding"] == "srgb"
    assert "near = 0.1  # unknown: the near plane" in (tmp_path / "out.toml").read_text()
    assert cli.main(["import", source, out, "--guess"]) == 2 and "it is there already" in capsys.readouterr().out
    assert cli.main(["import", source, out, "--preset", "generic", "--recipe", str(tmp_path / "out.toml")]) == 0
    dataset = read_dataset(out)
    assert check_dataset(dataset, pairs=0).verdict != "wrong"
    frames = read_sequence(dataset, "dump").frames
    np.testing.assert_allclose(frames.motion[1:], clip.frames.motion[1:], atol=0.02)
    np.testing.assert_allclose(frames.jitter, clip.frames.jitter, atol=1e-4)
    np.testing.assert_allclose(frames.gbuffers.depth, clip.frames.gbuffers.depth, rtol=1e-4)


def test_known_dumps_are_named(tmp_path, capsys):
    write(tmp_path / "dump" / "TemplePreTonemapHDRColor.0001.exr", {"R": np.ones((4, 6))})
    assert cli.main(["import", str(tmp_path / "dump"), str(tmp_path / "out"), "--guess"]) == 0
    assert "--preset extranet" in capsys.readouterr().out and not (tmp_path / "out.toml").exists()
    (tmp_path / "empty").mkdir()
    assert cli.main(["import", str(tmp_path / "empty"), str(tmp_path / "out"), "--guess"]) == 2
    assert "expected images (.exr, .png" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "role"),
    [
        ("MotionVectors", "motion"), ("shot_mv", "motion"), ("WorldNormal", "normal"), ("N", "normal"), ("lr", "color"),
        ("zbuffer", "depth"), ("BaseColor", "base_color"), ("ObjectIndex", "stencil"), ("gt", "reference"), ("xy", ""),
    ],
)  # fmt: skip
def test_names(text, role):
    assert role_of(text) == role


def dump_of(folder, depth, normal, sequences=("a", "b")):
    """One multilayer file per frame in two folders."""
    rng = np.random.default_rng(0)
    for name in sequences:
        for t in (7, 8, 10):
            planes = {f"beauty.{c}": rng.uniform(0, 9, (12, 20)) for c in "RGB"}
            planes |= {"Z.V": depth, "velocity.X": rng.normal(size=(12, 20)), "velocity.Y": rng.normal(size=(12, 20))}
            planes |= {f"N.{c}": normal[..., i] for i, c in enumerate("XYZ")}
            write(folder / name / f"take2.{t:04d}.exr", planes)
    (folder / "a" / "shot.json").write_text(json.dumps({"frames": {"7": {"near": 0.3}}}))


def test_files_channels_and_ranges(tmp_path):
    """Sequences by folder, the frame's digits among others, layers by name; encodings by what their values are."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(12, 20, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = rng.uniform(1, 50, (12, 20))
    depth[:3] = 1e10
    dump_of(tmp_path / "dump", depth, normal)
    stock = take_stock(tmp_path / "dump")
    assert stock.sequences == ["a", "b"] and stock.numbers == [7, 8, 10] and stock.fields == {"near"}
    draft = make_draft(stock)
    assert draft.content["files"]["color"] == "{sequence}/take2.{frame}.exr"
    assert draft.content["files"]["metadata"] == "{sequence}/shot.json"
    assert draft.content["channels"]["motion"] == ["velocity.X", "velocity.Y"]
    assert draft.content["channels"]["normal"] == ["N.X", "N.Y", "N.Z"]
    assert draft.content["depth"]["kind"] == "linear" and 60 < draft.content["depth"]["background"] < 1e10
    assert draft.notes["depth.background"][0] == CERTAIN
    assert draft.content["normal"]["encoding"] == "signed" and draft.notes["normal.encoding"][0] == CERTAIN
    assert draft.content["color"]["encoding"] == "linear" and draft.notes["color.encoding"][0] == LIKELY
    dump_of(tmp_path / "other", 0.1 / rng.uniform(1, 50, (12, 20)), 0.5 * normal + 0.5, sequences=("a",))
    draft = make_draft(take_stock(tmp_path / "other"))
    assert draft.content["normal"]["encoding"] == "unsigned" and draft.content["depth"]["kind"] == "reversed"
    assert "near" not in draft.content["depth"]  # the JSON says it
    assert draft.notes["depth.kind"][0] == LIKELY
    (tmp_path / "other" / "a" / "shot.json").unlink()
    assert make_draft(take_stock(tmp_path / "other")).notes["depth.near"][0] == UNKNOWN


def test_what_is_not_found_is_said(tmp_path):
    write(tmp_path / "dump" / "picture.0001.exr", {c: np.ones((4, 6)) for c in "RGB"})
    write(tmp_path / "dump" / "picture.0002.exr", {c: np.ones((4, 6)) for c in "RGB"})
    with pytest.raises(
        ValueError, match=r"no name says which file is depth and which motion; there are picture\.\{frame"
    ):
        make_draft(take_stock(tmp_path / "dump"))
