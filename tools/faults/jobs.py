"""What is disturbed: small versions of the commands that write."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console

import essjax.builtin
from essjax import cli
from essjax.train.checkpoint import _damage
from experiments.run import guarded
from tests.data.importing.test_blender import write_dump
from tests.train import tiny_run
from tools.faults.process import digests, run

SCENES = ("--families", "gloss", "--sequences", "2", "--frames", "4", "--size", "16x12")


class Job(NamedTuple):
    """A command.

    Attributes:
      name: of the row.
      command: output folder -> exit code; the same again goes on where it was stopped.
      torn: output folder, digests of an undisturbed run -> what is half-written under its final name.
      result: output folder -> what has to be as in the undisturbed run.
      bytes: of the output, about: sizes of full disks.
    """

    name: str
    command: Callable[[Path], int]
    torn: Callable[[Path, dict[str, str]], list[str]]
    result: Callable[[Path], dict[str, str]]
    bytes: int


def _import(dump: Path, out: Path) -> int:
    return cli.main(["import", str(dump), str(out), "--preset", "blender"])


def _scenes(frames: list, out: Path) -> int:
    """``essjax scenes`` with frames that were made before: rendering takes long and writes nothing."""
    essjax.builtin.render_frame = lambda scene, index, *size, rendering: frames[index]
    return cli.main(["scenes", str(out), *SCENES])


def _training(out: Path) -> int:
    """Train the suite's stage of twelve steps, as a command; leaves what it ended with in ``final.json``."""

    def command(console: Console) -> int:
        end, summary = tiny_run.run(out, save_every=0.0)
        lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
        log = [{name: value for name, value in line.items() if name != "seconds"} for line in lines]
        leaves = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(end)]
        (out / "final.json").write_text(json.dumps([log, leaves, summary["steps"]]))
        return 0

    return guarded(command)


def _torn_files(out: Path, whole: dict[str, str]) -> list[str]:
    """Name images that are there and not whole, and JSON that cannot be read."""
    found = []
    for name, digest in digests(out).items():
        if name.endswith(".json"):
            try:
                json.loads((out / name).read_text())
            except ValueError:
                found.append(name)
        elif whole.get(name) != digest:
            found.append(name)
    return found


def _torn_checkpoints(out: Path, whole: dict[str, str]) -> list[str]:
    folders = [path for path in (out / "checkpoints").glob("[0-9]*") if path.name.isdecimal()]
    return [path.name for path in folders if _damage(path)]


def prepare(root: Path) -> list[Job]:
    """Make what the jobs read, in processes of their own."""
    root.mkdir(parents=True, exist_ok=True)
    dump, noise = root / "clip", root / "frames.pickle"
    if not dump.is_dir():
        run(lambda: write_dump(dump) and 0, root / "prepare.txt")
    if not noise.is_file():
        run(lambda: noise.write_bytes(pickle.dumps(_frames())) and 0, root / "prepare.txt")
    frames = pickle.loads(noise.read_bytes())
    return [
        Job("essjax import", lambda out: _import(dump, out), _torn_files, digests, 400_000),
        Job("essjax scenes", lambda out: _scenes(frames, out), _torn_files, digests, 250_000),
        Job("training", _training, _torn_checkpoints, lambda out: {"": (out / "final.json").read_text()}, 120_000),
    ]


def _frames() -> list:
    from essjax.frames import select_time
    from tests.data.test_store import sequence

    clip = sequence(T=4, H=12, W=16)
    return [select_time(clip, index) for index in range(4)]
