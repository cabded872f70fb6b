"""Damaged and hostile files for every reader: one ValueError that names the file, in bounded time and memory, or none.

A batch runs in a process of its own, so that a crash of a library is seen. A checkpoint that is restored must hold the
numbers that were saved.
"""

import json
import os
import resource
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from safetensors.numpy import save_file

from essjax.data import exr, import_dataset, read_dataset, read_sequence
from essjax.data.importing.arm import arm_facts
from essjax.data.importing.facts import generic_facts
from essjax.data.importing.recipe import RECIPES, load_recipe
from essjax.tensors import read_tensors
from tests.data.fuzz_exr import ADDRESSES, mutate, seeds

SLOW = 10.0
"""Seconds after which one file counts as a hang."""
MEMORY = 1 << 30
"""Bytes: a file that makes the process grow by more counts as a huge allocation."""
HOSTILE = (None, True, -1, 0, 50, 1e999, float("nan"), "maybe", "../x", [], {}, 10**30, [[[]]], {"a": {}}, "x" * 3000)


class Reader(NamedTuple):
    """A reader and its files.

    Attributes:
      name: of the row.
      prepare: writes whole files into a folder.
      files: those of the folder that are damaged, by their names.
      read: folder -> reads them; returns what is wrong with what it read, or "".
      structured: JSON, of which values are changed as well as bytes.
    """

    name: str
    prepare: Callable[[Path], object]
    files: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    structured: bool = False


def _dataset(folder: Path) -> None:
    from essjax.data import write_dataset, write_sequence
    from tests.data.test_store import sequence

    write_sequence(folder, "a", sequence(T=3, native=True), first=8)
    write_dataset(folder, {"test": ["a"]})


def _metadata(folder: Path) -> None:
    from tests.data.importing.test_blender import write_dump

    write_dump(folder / "clip", range(8, 10))
    camera = {"camera_to_world": [[1, 0, 0, 0]] * 4, "focal": [4, 4], "center": [2, 1.5]}
    record = {"jitter": [0.1, 0], "exposure": 1.0, "cut": False, "near": 0.1, "far": None, **camera}
    (folder / "shot.json").write_text(json.dumps({"frames": {"8": record, "9": record}}))
    arm = {"Frame": 8, "CameraFarPlane": -1, "CameraNearPlane": 0.1, "NormalizedPerRatioJitter": [{"X": 0, "Y": 0}]}
    (folder / "arm.json").write_text(json.dumps({"Frames": [arm, {**arm, "Frame": 9, "CameraCut": True}]}))


def _read_metadata(folder: Path) -> None:
    shutil.rmtree(folder / "out", ignore_errors=True)
    for read in (generic_facts, arm_facts):
        path = folder / {generic_facts: "shot.json", arm_facts: "arm.json"}[read]
        facts = read(path, 4, 3)
        facts(8, {}), facts(9, {})
    import_dataset(folder / "clip", folder / "out", "blender", workers=1)


def _weights(folder: Path) -> None:
    from tests.test_tensors import checkpoint

    arrays = {"a.weight": np.ones((3, 5), np.float32), "b": np.arange(12, dtype=np.float32)}
    checkpoint(folder / "x.pth", arrays)
    save_file(arrays, folder / "x.safetensors")
    np.savez(folder / "x.npz", **arrays)  # type: ignore[arg-type]


def _read_weights(folder: Path) -> None:
    for path in sorted(folder.glob("x.*")):
        read_tensors(path)


def _recipes(folder: Path) -> None:
    for path in RECIPES.glob("*.toml"):
        shutil.copy(path, folder / path.name)


def _read_recipes(folder: Path) -> None:
    for path in sorted(folder.glob("*.toml")):
        load_recipe("generic", path)


def _images(folder: Path) -> None:
    for number, content in enumerate(seeds(folder)):
        (folder / f"{number}.exr").write_bytes(content)
    (folder / "seed.exr").unlink()


def _read_images(folder: Path) -> None:
    for path in sorted(folder.glob("*.exr")):
        exr.read(path)


def _state(scale: float):
    import jax.numpy as jnp

    from essjax.train import adam, create_state

    return create_state({"net": {"kernel": scale * jnp.arange(6.0).reshape(2, 3)}}, "net", adam())


def _checkpoints(folder: Path) -> None:
    from essjax.train import Checkpoints

    checkpoints = Checkpoints(folder / "stage")
    for step in (1, 2):
        checkpoints.save(step, _state(step), {"seconds": float(step)})
    checkpoints.close()


def _read_checkpoints(folder: Path) -> str:
    import jax

    from essjax.train import Checkpoints

    checkpoints = Checkpoints(folder / "stage")
    try:
        state, progress = checkpoints.restore(_state(0.0))
    finally:
        checkpoints.close()
    expected = _state(progress["seconds"])
    same = jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), state, expected)
    return "" if progress["seconds"] in (1.0, 2.0) and all(jax.tree.leaves(same)) else "other numbers were restored"


def _json(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*.json") if "out" not in path.parts]


READERS = (
    Reader("dataset.json, sequence.json", _dataset, _json, lambda f: read_sequence(read_dataset(f), "a") and "", True),
    Reader("metadata of dumps", _metadata, _json, _read_metadata, True),
    Reader("weights of others", _weights, lambda folder: sorted(folder.glob("x.*")), _read_weights),
    Reader("recipes", _recipes, lambda folder: sorted(folder.glob("*.toml")), _read_recipes),
    Reader("EXR images", _images, lambda folder: sorted(folder.glob("*.exr")), _read_images),
    Reader("checkpoints", _checkpoints, lambda f: [p for p in f.rglob("*") if p.is_file()], _read_checkpoints),
)  # fmt: skip


def _change(content: object, random: np.random.Generator) -> object:
    """Put something else into one place of a JSON content."""
    if isinstance(content, (dict, list)) and content and random.random() < 0.85:
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        key = keys[int(random.integers(len(keys)))]
        if random.random() < 0.05:
            del content[key]  # type: ignore[arg-type]
        else:
            content[key] = _change(content[key], random)  # type: ignore[index]
        return content
    return HOSTILE[int(random.integers(len(HOSTILE)))]


def _damage(reader: Reader, path: Path, random: np.random.Generator) -> None:
    content = path.read_bytes()
    if reader.structured and random.random() < 0.6:
        path.write_text(json.dumps(_change(json.loads(content), random)))
    elif path.suffix == ".pth" and random.random() < 0.5:  # with the archive's sums: else zip finds it first
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, member in members.items():
                archive.writestr(name, mutate(member, random) if name.endswith(".pkl") else member)
    elif random.random() < 0.05:
        path.unlink()
    else:
        path.write_bytes(mutate(content, random))


def _resident() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def batch(reader: Reader, folder: Path, seed: int, seconds: float) -> dict:
    """Damage and read until the time is over: tries, and what was lost and unclear."""
    resource.setrlimit(resource.RLIMIT_AS, (8 * ADDRESSES, 8 * ADDRESSES))
    whole, work, random = folder / "whole", folder / "work", np.random.default_rng(seed)
    shutil.rmtree(folder, ignore_errors=True)
    whole.mkdir(parents=True)
    reader.prepare(whole)
    found: dict = {"tries": 0, "lost": [], "unclear": []}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(whole, work)
        files = reader.files(work)
        path = files[int(random.integers(len(files)))]
        _damage(reader, path, random)
        began, before = time.monotonic(), _resident()
        try:
            wrong = reader.read(work)
            found["lost"] += [str(wrong)[:300]] if wrong else []
        except ValueError as error:
            if str(work) not in str(error) or "\n" in str(error) or len(str(error)) > 1000:
                found["unclear"].append(f"{path.name}: ValueError: {str(error)[:300]}")
        except Exception as error:
            found["unclear"].append(f"{path.name}: {type(error).__name__}: {str(error)[:300]}")
        took, grown = time.monotonic() - began, _resident() - before
        if took > SLOW or grown > MEMORY and found["tries"]:
            found["unclear"].append(f"{path.name}: {took:.0f} s, {grown >> 20} MB")
        found["tries"] += 1
    print("\n" + json.dumps(found), flush=True)
    return found


def command(reader: Reader, folder: Path, seed: int, seconds: float) -> Callable[[], int]:
    """Return a batch as a command; a checkpoint's warnings go where nobody looks."""

    def run() -> int:
        os.environ["JAX_PLATFORMS"] = "cpu"
        batch(reader, folder, seed, seconds)
        return 0

    return run
