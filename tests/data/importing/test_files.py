"""Files as people have them: byte order marks, hidden files, other names, alphabets and primaries, bad pixels."""

import shutil

import numpy as np
import pytest

from essjax.data import exr
from essjax.data.importing.primaries import REC709, to_rec709
from tests.data.importing.dumps import OUR_RULES, imported, rgb, truth, write
from tests.data.importing.test_formats import load, write_cameras

RECIPE = """
optional = ["normal"]
[files]
frame = "a.{frame}.exr"
depth = "z.{frame}.exr"
metadata = "cameras.json"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["u", "v"]
normal = ["N.R", "N.G", "N.B"]
"""


@pytest.fixture
def dump(tmp_path):
    """Three frames, 8 to 10; depth is in files of its own, padded otherwise."""
    known = truth(T=3)
    frames = known.frames
    for t in range(3):
        planes = {**rgb(frames.color[t]), **rgb(frames.gbuffers.normal[t], "N.")}
        planes |= {"u": frames.motion[t, ..., 0], "v": frames.motion[t, ..., 1]}
        write(tmp_path / "dump" / f"a.{t + 8:04d}.exr", planes)
        write(tmp_path / "dump" / f"z.{t + 8}.exr", {"Z": frames.gbuffers.depth[t, ..., 0]})
    write_cameras(tmp_path / "dump" / "cameras.json", known)
    path = tmp_path / "dump" / "cameras.json"
    path.write_text(
        path.read_text().replace('"0": {', '"8": {').replace('"1": {', '"9": {').replace('"2": {', '"10": {')
    )
    return tmp_path / "dump", known


def test_bom_hidden_files_and_paddings(dump, tmp_path):
    folder, known = dump
    path = folder / "cameras.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    (folder / "._a.0008.exr").write_bytes(b"Mac OS X")
    (folder / "._a.8.exr").write_bytes(b"Mac OS X")
    report = load(tmp_path, "\ufeff" + RECIPE + OUR_RULES)
    assert report.sequence.numbers == (8, 9, 10) and not report.warnings
    np.testing.assert_allclose(imported(report, "dump").frames.gbuffers.depth, known.frames.gbuffers.depth)


def test_names_that_no_pattern_takes_are_listed(dump, tmp_path):
    for name in ("a.-001.exr", "b.0008.exr"):
        shutil.copy(dump[0] / "a.0008.exr", dump[0] / name)
    report = load(tmp_path, RECIPE + OUR_RULES)
    assert report.warnings == ("not imported, because no pattern takes their names: a.-001.exr, b.0008.exr",)


def replace_bytes(path, old, new):
    content = path.read_bytes()
    assert old in content and len(old) == len(new)
    path.write_bytes(content.replace(old, new))


def test_headers_in_latin_1(tmp_path):
    path = tmp_path / "a.exr"
    write(path, {"R": np.arange(6).reshape(2, 3)}, {"owner": "Jerome Leveque"})
    replace_bytes(path, b"Jerome Leveque", "Jérôme Levêque".encode("latin-1"))
    planes, header = exr.read_all(path)
    np.testing.assert_array_equal(planes["R"], np.arange(6).reshape(2, 3))
    assert header["owner"] == "J?r?me Lev?que"
    replace_bytes(path, b"owner\0string", b"own\xe9r\0string")
    with pytest.raises(ValueError, match=r"a\.exr: the attribute 'ownér' in the header is not UTF-8"):
        exr.read(path)
    write(path, {"Q": np.zeros((2, 3))})
    replace_bytes(path, b"\0Q\0", b"\0\xe9\0")
    with pytest.raises(ValueError, match=r"the attribute 'channels' in the header is not UTF-8"):
        exr.read(path)


AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
AP1_TO_REC709 = [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0105], [-0.0240, -0.1290, 1.1530]]
"""The Academy's published matrix, four digits (ACEScg to linear sRGB, Bradford)."""
XYZ_TO_REC709 = [[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]]
"""IEC 61966-2-1: D65 stays D65, so an equal-energy white is not adapted."""


def test_primaries():
    np.testing.assert_allclose(to_rec709({"chromaticities": AP1}, "a"), AP1_TO_REC709, atol=2e-3)
    xyz = (1, 0, 0, 1, 0, 0, 0.3127, 0.3290)
    scale = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])  # of XYZ in units of this white
    np.testing.assert_allclose(to_rec709({"chromaticities": xyz}, "a"), XYZ_TO_REC709 * scale, atol=3e-3)
    assert to_rec709({}, "a") is None and to_rec709({"chromaticities": REC709}, "a") is None
    with pytest.raises(ValueError, match=r"a: the chromaticities .* are those of no colour space\. Export Rec\. 709"):
        to_rec709({"chromaticities": (0.3, 0.3) * 4}, "a")


def test_colour_of_other_primaries_is_converted(dump, tmp_path):
    folder, known = dump
    to_ap1 = np.linalg.inv(to_rec709({"chromaticities": AP1}, "a"))
    for t in range(3):
        planes = exr.read(folder / f"a.{t + 8:04d}.exr")
        planes |= rgb(np.asarray(known.frames.color[t]) @ to_ap1.T)
        write(folder / f"a.{t + 8:04d}.exr", planes, {"chromaticities": AP1})
    got = imported(load(tmp_path, RECIPE + OUR_RULES), "dump")
    np.testing.assert_allclose(got.frames.color, known.frames.color, atol=2e-3)


def edit(path, channel, at, value):
    planes = {name: np.array(plane, np.float32) for name, plane in exr.read(path).items()}
    planes[channel][at] = value
    write(path, planes)


def test_bad_pixels_stop_the_import_or_are_mended(dump, tmp_path):
    folder, known = dump
    hit = np.argwhere(np.isfinite(known.frames.gbuffers.depth[1, 1:-1, 1:-1, 0]))[0] + 1
    at = tuple(int(i) for i in hit)
    edit(folder / "a.0009.exr", "N.G", at, np.nan)
    with pytest.raises(
        ValueError, match=r"frame 9: normal \(N\.R, N\.G, N\.B\): expected vectors, got NaN in 1 pixels"
    ):
        load(tmp_path, RECIPE + OUR_RULES)
    edit(folder / "a.0009.exr", "R", at, np.inf)
    edit(folder / "a.0010.exr", "u", (0, 0), np.nan)
    report = load(tmp_path, RECIPE + OUR_RULES, "mended", repair=True)
    assert report.totals["repaired"] == 3
    got = imported(report, "dump")
    window = np.asarray(known.frames.color[1, at[0] - 1 : at[0] + 2, at[1] - 1 : at[1] + 2]).reshape(9, 3)
    np.testing.assert_allclose(got.frames.color[1][at], np.median(np.delete(window, 4, 0), 0), rtol=1e-3)
    corner = np.stack([known.frames.motion[2, 0, 1], known.frames.motion[2, 1, 0], known.frames.motion[2, 1, 1]])
    np.testing.assert_allclose(got.frames.motion[2, 0, 0], np.median(corner, 0), rtol=1e-5)
    edit(folder / "a.0010.exr", "u", np.s_[:4], np.nan)
    with pytest.raises(ValueError, match=r"frame 10: .*channel motion: expected finite values, got nan"):
        load(tmp_path, RECIPE + OUR_RULES, "many", repair=True)


def test_leaving_frames_out_is_no_advice_where_all_are_wrong(dump, tmp_path):
    wrong = RECIPE.replace('normal = ["N.R", "N.G", "N.B"]', 'roughness = ["rough.R"]').replace('"normal"', "")
    with pytest.raises(ValueError, match=r"frame 8: .*expected the channels rough\.R.*\(So are other frames: change"):
        load(tmp_path, wrong + OUR_RULES)
    edit(dump[0] / "a.0008.exr", "u", (1, 1), np.nan)
    with pytest.raises(ValueError, match=r"frame 8: .*\(--skip-broken leaves such frames out"):
        load(tmp_path, RECIPE + OUR_RULES, "first")
