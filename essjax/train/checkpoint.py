"""Checkpoints of a stage: orbax, atomic, with the data iterator's position and the run's clock."""

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from essjax.typing import PyTree


class Checkpoints:
    """The checkpoints of one stage in one folder; the newest two are kept.

    A save that is killed midway leaves only a temporary folder behind, which is not listed and is removed here.

    Args:
      path: the folder; made if absent.
    """

    def __init__(self, path: Path):
        path = Path(path).absolute()
        path.mkdir(parents=True, exist_ok=True)
        for leftover in path.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(leftover, ignore_errors=True)
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self.path = path
        self._manager = ocp.CheckpointManager(path, options=options)

    def latest(self) -> int | None:
        """Step of the newest complete checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, step: int, state: PyTree, progress: dict[str, Any]) -> None:
        """Write ``state`` (arrays) and ``progress`` (JSON) as checkpoint ``step``; does nothing if it exists."""
        if step in self._manager.all_steps():
            return
        args = ocp.args.Composite(state=ocp.args.StandardSave(state), progress=ocp.args.JsonSave(progress))
        self._manager.save(step, args=args)
        self._manager.wait_until_finished()

    def restore(self, like: PyTree) -> tuple[PyTree, dict[str, Any]]:
        """Restore the newest checkpoint, with the structure, shapes and types of ``like``.

        Raises:
          ValueError: there is none, or it was written for other shapes (another width, say).
        """
        step = self.latest()
        if step is None:
            raise ValueError(f"{self.path}: expected a checkpoint, found none. Train first, or check --out.")
        args = ocp.args.Composite(
            state=ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like)),
            progress=ocp.args.JsonRestore(),
        )
        try:
            restored = self._manager.restore(step, args=args)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{self.path}: checkpoint {step} does not fit this configuration ({str(error).splitlines()[0]}). "
                "Use the settings that it was trained with, or another --out."
            ) from error
        # Copied from the host: orbax ties arrays to their device, which is another program to JAX, compiled once more.
        state = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), restored["state"])
        return state, restored["progress"]

    def close(self) -> None:
        """Release the manager's threads."""
        self._manager.close()
