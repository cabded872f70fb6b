"""``essjax check``: good datasets are green, and a corrupted one gets the fix that undoes the corruption.

The oracle is the corruption itself: each takes a dataset that is known to be right, breaks one convention, and knows
what a user has to type to put it right again.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from essjax import cli
from essjax.data import exr, import_dataset, read_dataset
from essjax.data.check import check_dataset
from essjax.data.check.pairs import steps
from essjax.data.check.values import ValuesCheck, judge_values
from essjax.generate import Clip, generate

CHESS = Path(__file__).parents[3] / "shared" / "data" / "chess_blender"
NAME = "train-corridor-0000"
SIZE = W, H = 64, 36


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A camera that flies through a corridor: motion in x and y, disocclusions, all buffers."""
    folder = tmp_path_factory.mktemp("good")
    generate(folder, [Clip("train", "corridor", 0, 7, spp=9)], *SIZE)
    return folder


@pytest.fixture(scope="module")
def chess(tmp_path_factory):
    """Eight frames of the real clip."""
    if not CHESS.is_dir():
        pytest.skip("the path-traced chess clip is not here")
    dump = tmp_path_factory.mktemp("dump")
    meta = json.loads((CHESS / "meta.json").read_text())
    meta["frames"] = {number: record for number, record in meta["frames"].items() if 12 <= int(number) < 20}
    (dump / "meta.json").write_text(json.dumps(meta))
    for number in meta["frames"]:
        for kind in ("lr", "hr"):
            (dump / f"{kind}.{int(number):04d}.exr").symlink_to(CHESS / f"{kind}.{int(number):04d}.exr")
    folder = tmp_path_factory.mktemp("chess")
    import_dataset(dump, folder, "blender", name="chess")
    return folder


@pytest.fixture
def copy(good, tmp_path):
    return shutil.copytree(good, tmp_path / "copy")


def write_raw(path, planes):
    """Without ``exr.write``'s checks: what a user's own tool would leave there."""
    OpenEXR.File({}, {name: np.ascontiguousarray(plane) for name, plane in planes.items()}).write(str(path))


def edit(folder, change, kind="lr", only=None):
    """Apply ``change(planes, number)``, which returns new planes, to the files of a dataset."""
    for path in sorted(folder.glob(f"*/{kind}.*.exr")):
        number = int(path.name.split(".")[1])
        if only is None or number in only:
            planes = exr.read(path)
            write_raw(path, {**planes, **change(planes, number)})


def edit_records(folder, change):
    """Apply ``change(record, number)`` in place to the record of every frame."""
    for path in folder.glob("*/sequence.json"):
        content = json.loads(path.read_text())
        for record in content["frames"]:
            change(record, record["number"])
        path.write_text(json.dumps(content))


def motion(change):
    """A corruption: ``change(x, y)`` returns the motion that the dataset will state."""

    def corrupt(folder):
        def planes(p, number):
            x, y = change(p["motion.X"], p["motion.Y"])
            return {"motion.X": np.float32(x), "motion.Y": np.float32(y)}

        edit(folder, planes)

    return corrupt


def jitter(change):
    return lambda folder: edit_records(folder, lambda record, _: record.update(jitter=change(*record["jitter"])))


def jitters(folder):
    content = json.loads(next(folder.glob("*/sequence.json")).read_text())
    return {record["number"]: np.array(record["jitter"]) for record in content["frames"]}


def jitter_in_motion(folder):
    known = jitters(folder)

    def add(planes, number):
        x, y = known[number] - known.get(number - 1, known[number])
        return {"motion.X": planes["motion.X"] + np.float32(x), "motion.Y": planes["motion.Y"] + np.float32(y)}

    edit(folder, add)


def uv(folder):
    info = read_dataset(folder).info
    motion(lambda x, y: (x / info.width, y / info.height))(folder)


CONVENTIONS = {
    "x flipped": (
        motion(lambda x, y: (-x, y)),
        "motion, references",
        "motion.X has the wrong sign: negate it at import",
    ),
    "y flipped": (
        motion(lambda x, y: (x, -y)),
        "motion, references",
        "motion.Y has the wrong sign: negate it at import",
    ),
    "both flipped": (motion(lambda x, y: (-x, -y)), "motion, references", "negate X and Y at import"),
    "twice": (motion(lambda x, y: (2 * x, 2 * y)), "motion, references", "multiply it by 0.5 at import"),
    "half": (motion(lambda x, y: (x / 2, y / 2)), "motion, references", "multiply it by 2 at import"),
    "swapped": (motion(lambda x, y: (y, x)), "motion, references", "exchange them at import"),
    "UV": (uv, "motion, references", "motion is in UV units: multiply X by"),
    "jitter in motion": (
        jitter_in_motion,
        "motion, references",
        "has the jitter in it: subtract jitter(t) - jitter(t-1)",
    ),
    "jitter negated": (jitter(lambda x, y: (-x, -y)), "jitter, references", "negate x and y at import"),
    "jitter x flipped": (jitter(lambda x, y: (-x, y)), "jitter, references", "jitter x has the wrong sign"),
    "jitter swapped": (jitter(lambda x, y: (y, x)), "jitter, references", "jitter x and y are swapped"),
    "jitter lost": (jitter(lambda x, y: (0.9 * x - 0.5, y)), "jitter, references", "in [-0.5, 0.5)"),
}
"""Corruption, the row that must say "wrong", a part of its fix."""
BRIEF = ("x flipped", "y flipped", "both flipped", "twice", "jitter negated")
"""The same on the real clip, which takes longer."""


def rows(folder, **options):
    return {finding.check: finding for finding in check_dataset(read_dataset(folder), **options).findings}


def assert_wrong(folder, row, fix, **options):
    finding = rows(folder, **options)[row]
    assert finding.verdict == "wrong" and fix in finding.fix, finding


def test_a_good_dataset_is_green(good):
    report = check_dataset(read_dataset(good))
    assert {finding.check: finding.verdict for finding in report.findings if finding.verdict != "ok"} == {}
    assert report.verdict == "ok" and (report.looked_at, report.frames) == (7, 7)


def test_a_value_that_breaks_every_warp_is_still_only_named(copy):
    """NaN and infinities must not spread into the other checks."""
    bad = {"color.G": np.nan, "motion.X": np.inf, "depth.Z": np.nan}
    edit(copy, lambda planes, number: {name: put(planes[name], value) for name, value in bad.items()}, only=[3])
    verdicts = {name: finding.verdict for name, finding in rows(copy).items()}
    assert verdicts.pop("values") == "wrong" and set(verdicts.values()) == {"ok"}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_broken_convention_gets_its_fix(copy, name):
    corrupt, row, fix = CONVENTIONS[name]
    corrupt(copy)
    assert_wrong(copy, row, fix, pairs=4)


def test_the_chess_clip_is_green_and_motion_gains_6_db(chess):
    """Oracle for the gain: measured when the clip was made, 33.5 dB against 26.7 on the surface."""
    found = rows(chess)
    assert {name: row.verdict for name, row in found.items() if row.verdict != "ok"} == {}
    assert found["motion, references"].numbers["gain"] > 6
    assert f"{found['motion, references'].numbers['gain']:+.1f} dB" in found["motion, references"].found


@pytest.mark.parametrize("name", BRIEF)
def test_a_broken_chess_clip_gets_its_fix(chess, tmp_path, name):
    folder = shutil.copytree(chess, tmp_path / "copy")
    corrupt, row, fix = CONVENTIONS[name]
    corrupt(folder)
    assert_wrong(folder, row, fix, pairs=3)


def test_a_clip_without_motion_is_not_decidable(copy):
    first = {kind: exr.read(copy / NAME / f"{kind}.0000.exr") for kind in ("lr", "hr")}
    ones = {"valid.Y": np.ones((H, W), np.uint32), "steady.Y": np.ones((H, W), np.uint32)}
    still = {"motion.X": np.zeros((H, W), np.float32), "motion.Y": np.zeros((H, W), np.float32)}
    edit(copy, lambda planes, number: {**first["lr"], **ones, **still})
    edit(copy, lambda planes, number: first["hr"], kind="hr")
    records = json.loads((copy / NAME / "sequence.json").read_text())["frames"]
    edit_records(copy, lambda record, number: record.update(jitter=[0, 0], camera=records[0]["camera"]))
    found = rows(copy)
    for name in ("motion, references", "motion, rendered frames", "jitter, references", "jitter, frame to frame"):
        assert found[name].verdict == "not decidable"
    assert "the motion is < 0.25 px" in found["motion, references"].found
    assert found["duplicated frames"].verdict == "ok"  # nothing moves: frames may be equal


def shift_reference(planes, number):
    """By half a reference pixel to the right and down: a quarter of a rendered pixel."""
    moved = {}
    for name, plane in planes.items():
        plane = 0.5 * (plane + np.roll(plane, 1, 1))
        moved[name] = np.float16(0.5 * (plane + np.roll(plane, 1, 0)))
    return moved


def test_a_shifted_reference(copy):
    edit(copy, shift_reference, kind="hr")
    finding = rows(copy)["sub-pixel shift"]
    assert finding.verdict == "wrong" and "resized with aligned corners" in finding.fix
    np.testing.assert_allclose([finding.numbers["x"], finding.numbers["y"]], 0.25, atol=0.08)
    assert f"move the reference by ({-2 * finding.numbers['x']:+.1f}, " in finding.fix


def test_reversed_depth(copy):
    edit(copy, lambda planes, number: {"depth.Z": np.float32(0.1) / planes["depth.Z"]})
    assert_wrong(copy, "depth", "depth is reversed")
    edit_records(copy, lambda record, number: record.update(camera=None))  # by what hides what
    assert_wrong(copy, "depth", "depth is reversed")


def test_order_of_depth_without_cameras(copy):
    edit_records(copy, lambda record, number: record.update(camera=None))
    finding = rows(copy)["depth"]
    assert finding.verdict == "ok" and "what hides is nearer in" in finding.found


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
    finding = rows(copy)["normals"]
    assert finding.verdict == "warning" and "look away from the camera" in finding.found


def put(plane, value):
    changed = plane.copy()
    changed[20, 30] = value
    return changed


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


def test_command_prints_writes_and_returns_a_code(copy, tmp_path, capsys):
    arguments = [str(a) for a in (copy, "--json", tmp_path / "out.json", "--pictures", tmp_path / "pictures")]
    assert cli.main(["check", *arguments, "--pairs", "2"]) == 0
    assert "looked at 3 of 7 frames" in " ".join(capsys.readouterr().out.split())
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == [f"{NAME}.0006.as-stated.png"]
    CONVENTIONS["x flipped"][0](copy)
    assert cli.main(["check", *arguments, "--pairs", "2"]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "motion, references: motion.X has the wrong sign: negate it at import" in output
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["verdict"] == "wrong" and content["findings"][0]["fix"].startswith("motion.X has the wrong sign")
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {
        f"{NAME}.0006.as-stated.png",
        f"{NAME}.0006.x-flipped.png",
    }
    assert cli.main(["check", str(tmp_path)]) == 2 and "dataset.json: not found" in capsys.readouterr().out
