"""Ways to break a good dataset, each with the fix that a user has to be told."""

import json
from pathlib import Path

import numpy as np
import OpenEXR

from essjax.data import exr, read_dataset, read_sequence, write_dataset, write_sequence
from essjax.data.check import check_dataset

CHESS = Path(__file__).parents[4] / "shared" / "data" / "chess_blender"
NAME = "train-corridor-0000"
SIZE = W, H = 64, 36


def rows(folder, **options):
    return {finding.check: finding for finding in check_dataset(read_dataset(folder), **options).findings}


def assert_wrong(folder, row, fix, **options):
    finding = rows(folder, **options)[row]
    assert finding.verdict == "wrong" and fix in finding.fix, finding


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


def put(plane, value):
    changed = plane.copy()
    changed[20, 30] = value
    return changed


def rewrite(good, folder, change, frames=None):
    """A dataset of the same sequence after ``change``."""
    sequence = read_sequence(read_dataset(good), NAME, frames)
    write_sequence(folder, NAME, change(sequence))
    return write_dataset(folder, {"train": [NAME]}).path


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


def root(folder):
    """Unreal 5's texture, read as Unreal 4's: of each axis the square root is left, in units of half the image."""
    half = np.array([W / 2, H / 2])
    encode = lambda v, size: np.sign(v) * np.sqrt(2 * np.abs(v) / size) * size
    motion(lambda x, y: (encode(x, half[0]), encode(y, half[1])))(folder)


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
    "Unreal 5": (root, "motion, references", "encoding 'unreal5' in [motion]"),
    "jitter in motion": (
        jitter_in_motion,
        "motion, references",
        "has the jitter in it: subtract jitter(t) - jitter(t-1)",
    ),
    "jitter negated": (jitter(lambda x, y: (-x, -y)), "jitter, references", "negate x and y at import"),
    "jitter x flipped": (jitter(lambda x, y: (-x, y)), "jitter, references", "jitter x has the wrong sign"),
    "jitter swapped": (jitter(lambda x, y: (y, x)), "jitter, references", "jitter x and y are swapped"),
    "jitter out of range": (jitter(lambda x, y: (0.9 * x - 0.5, y)), "jitter, references", "in [-0.5, 0.5)"),
}
"""Corruption, the row that must say "wrong", a part of its fix."""
