"""Checkpoints of a stage: orbax, atomic, checked, with the data iterator's position and the run's clock.

    12/state/           arrays, as orbax writes them
    12/arrays.json      their names, types and shapes
    12/progress.json    the data iterator's position and the run's clock
    12/SHA256SUMS       of every file above; ``sha256sum -c SHA256SUMS`` checks them, too

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
import orbax.checkpoint as ocp

from essjax.files import only_writer
from essjax.typing import PyTree

KEPT = 2
"""How many checkpoints stay."""
SUMS = "SHA256SUMS"
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
        self._orbax = ocp.Checkpointer(ocp.StandardCheckpointHandler())
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
            self._orbax.save(temporary / "state", args=ocp.args.StandardSave(state))
            for name, content in (("arrays", _described(state)), ("progress", progress)):
                (temporary / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")
            sums = "".join(f"{digest}  {name}\n" for name, digest in _checksums(temporary).items())
            (temporary / SUMS).write_text(sums, encoding="utf-8")
            temporary.rename(self.path / str(step))
        except Exception as error:  # orbax's own errors are of many kinds and have many lines
            shutil.rmtree(temporary, ignore_errors=True)
            before = self.latest()
            rest = f"checkpoint {before} is as it was" if before is not None else "there is none before it"
            raise ValueError(
                f"{self.path / str(step)}: cannot write the checkpoint ({_reason(error)}); {rest}. Is the disk full? "
                "Make room and run the same command with --resume."
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
        arrays, progress = (json.loads((folder / f"{name}.json").read_bytes()) for name in ("arrays", "progress"))
        wanted = _described(like)
        different = [name for name in {**wanted, **arrays} if wanted.get(name) != arrays.get(name)]
        if different:  # asked first: orbax answers with pages
            name = next((name for name in different if ".variables" in name), different[0])  # users know those
            found, asked = (tree.get(name, "absent") for tree in (arrays, wanted))
            more = f", and {len(different) - 1} more" if different[1:] else ""
            raise ValueError(
                f"{self.path}: checkpoint {step} does not fit this configuration ({name} is {found} there, {asked} "
                f"here{more}). Use the settings that it was trained with, or another --out."
            )
        target = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        try:
            restored = self._orbax.restore(folder / "state", args=ocp.args.StandardRestore(target))
        except Exception as error:
            raise ValueError(
                f"{folder}: cannot read the checkpoint ({_reason(error)}), though its checksums fit. Another version "
                "of orbax-checkpoint may have written it."
            ) from error
        # Copied from the host: orbax ties arrays to their device, which is another program to JAX, compiled once more.
        return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), restored), progress

    def close(self) -> None:
        """Release orbax's threads and the folder."""
        self._orbax.close()
        self._held.close()
        self._holds = False


_log = logging.getLogger(__name__)


def _reason(error: Exception) -> str:
    """First line of what orbax says, or where it says nothing the kind of its error."""
    text = str(error).strip()
    return text.splitlines()[0][:200] if text else type(error).__name__


def _described(tree: PyTree) -> dict[str, str]:
    """Name -> type and shape of every array, ``"float32[2, 3]"``."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}" for path, leaf in leaves}


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
