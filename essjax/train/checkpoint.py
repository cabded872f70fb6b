"""Checkpoints of a stage: atomic, checked, with the data iterator's position and the run's clock.

    12/state.safetensors    the arrays, by their names in the tree
    12/progress.json        the data iterator's position and the run's clock
    12/SHA256SUMS           of both files; ``sha256sum -c SHA256SUMS`` checks them, too

A checkpoint has another name until all of it is there. One that does not fit its checksums is damaged: it is named,
and the newest whole one takes its place.
"""

import contextlib
import hashlib
import json
import logging
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from essjax.files import only_writer
from essjax.typing import PyTree

KEPT = 2
"""How many checkpoints stay."""
STATE, PROGRESS, SUMS = "state.safetensors", "progress.json", "SHA256SUMS"
_TEMPORARY = ".unfinished"


class Checkpoints:
    """The checkpoints of one stage in one folder; the newest two are kept.

    A save that is killed midway leaves only a temporary folder behind, which is not listed; the next save removes it.
    From the first save to ``close`` nobody else can save there.

    Args:
      path: the folder; made by the first save.
    """

    def __init__(self, path: Path):
        self.path = Path(path).absolute()
        self._damaged: set[int] = set()
        self._holds, self._held = False, contextlib.ExitStack()

    def _steps(self) -> list[int]:
        """Return the steps of all checkpoints, newest first."""
        there = self.path.glob("[0-9]*") if self.path.is_dir() else ()
        return sorted((int(path.name) for path in there if path.name.isdecimal() and path.is_dir()), reverse=True)

    def latest(self) -> int | None:
        """Step of the newest checkpoint, damaged or not, or None."""
        return next(iter(self._steps()), None)

    def save(self, step: int, state: PyTree, progress: dict[str, Any]) -> None:
        """Write ``state`` (arrays) and ``progress`` (JSON) as checkpoint ``step``; does nothing if it exists.

        Raises:
          ValueError: it cannot be written, or another process saves there; the checkpoints before it are as they were.
        """
        if not self._holds:
            self._held.enter_context(only_writer(self.path))
            self._holds = True
        for damaged in self._damaged:  # found so while restoring, and not needed: training goes on from another one
            shutil.rmtree(self.path / str(damaged), ignore_errors=True)
        self._damaged.clear()
        if step in self._steps():
            return
        temporary = self.path / f"{step}{_TEMPORARY}"
        try:
            for leftover in self.path.glob(f"*{_TEMPORARY}"):
                shutil.rmtree(leftover)
            temporary.mkdir(parents=True)
            save_file(_named(state), temporary / STATE)
            (temporary / PROGRESS).write_text(json.dumps(progress), encoding="utf-8")
            sums = "".join(f"{digest}  {name}\n" for name, digest in _checksums(temporary).items())
            (temporary / SUMS).write_text(sums, encoding="utf-8")
            temporary.rename(self.path / str(step))
        except (OSError, SafetensorError) as error:
            shutil.rmtree(temporary, ignore_errors=True)
            before = self.latest()
            rest = f"checkpoint {before} is as it was" if before is not None else "there is none before it"
            raise ValueError(
                f"{self.path / str(step)}: cannot write the checkpoint ({error}); {rest}. Is the disk full? Make room "
                "and run the same command with --resume."
            ) from error
        for old in self._steps()[KEPT:]:
            shutil.rmtree(self.path / str(old), ignore_errors=True)

    def restore(self, like: PyTree) -> tuple[PyTree, dict[str, Any]]:
        """Restore the newest whole checkpoint, with the structure, shapes and types of ``like``.

        Newer ones that are damaged are logged as warnings, and removed by the next ``save``.

        Raises:
          ValueError: there is none, all are damaged, or it was written for other shapes (another width, say).
        """
        damages = []
        for step in self._steps():
            damage = _damage(self.path / str(step))
            if not damage:
                return self._restore(step, like)
            self._damaged.add(step)
            damages.append(f"checkpoint {step} is damaged ({damage})")
            others = [other for other in self._steps() if other < step]
            if others:
                _log.warning("%s: %s; trying checkpoint %d.", self.path, damages[-1], others[0])
        if not damages:
            raise ValueError(f"{self.path}: expected a checkpoint, found none. Train first, or check --out.")
        raise ValueError(
            f"{self.path}: expected a whole checkpoint, but {' and '.join(damages)}. Copy the folder back from a "
            "backup, or delete it and train again."
        )

    def _restore(self, step: int, like: PyTree) -> tuple[PyTree, dict[str, Any]]:
        folder = self.path / str(step)
        arrays, progress = load_file(folder / STATE), json.loads((folder / PROGRESS).read_bytes())
        wanted = _named(like)
        different = [name for name in {**wanted, **arrays} if _kind(wanted.get(name)) != _kind(arrays.get(name))]
        if different:
            name = next((name for name in different if ".variables" in name), different[0])  # users know those
            found, asked = (_kind(tree.get(name)) for tree in (arrays, wanted))
            more = f", and {len(different) - 1} more" if different[1:] else ""
            raise ValueError(
                f"{self.path}: checkpoint {step} does not fit this configuration ({name} is {found} there, {asked} "
                f"here{more}). Use the settings that it was trained with, or another --out."
            )
        leaves = [jnp.asarray(arrays[name]) for name in wanted]
        return jax.tree.unflatten(jax.tree.structure(like), leaves), progress

    def close(self) -> None:
        """Let others save in the folder."""
        self._held.close()
        self._holds = False


_log = logging.getLogger(__name__)


def _named(tree: PyTree) -> dict[str, np.ndarray]:
    """Arrays by their names in the tree, in its order."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf, order="C") for path, leaf in leaves}


def _kind(array: np.ndarray | None) -> str:
    """Type and shape, ``"float32[2, 3]"``."""
    return "absent" if array is None else f"{array.dtype}{list(array.shape)}"


def _checksums(folder: Path) -> dict[str, str]:
    """Relative name -> SHA-256 of every file in ``folder``, but for the list of them."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / SUMS)
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _damage(folder: Path) -> str:
    """Say what is wrong with a checkpoint's files; "" if nothing is."""
    try:
        lines = (folder / SUMS).read_bytes().decode().splitlines()
        found = _checksums(folder)
    except FileNotFoundError:
        return f"it has no {SUMS}: an older essjax wrote it, or it was not copied whole"
    except (OSError, UnicodeDecodeError) as error:
        return f"{SUMS if isinstance(error, UnicodeDecodeError) else error.filename} cannot be read"
    if found == (expected := dict(reversed(line.split("  ", 1)) if "  " in line else (line, "") for line in lines)):
        return ""
    changed = sorted(name for name in {**found, **expected} if found.get(name) != expected.get(name))
    missing = [name for name in changed if not os.path.exists(folder / name)]
    return f"{missing[0]} is missing" if missing else f"{changed[0]} is not what was written"
