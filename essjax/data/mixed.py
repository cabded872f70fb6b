"""Batches of several tasks in turn: of several rates, of frames with and without some buffers."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from essjax.frames import Sequence


class Mixed:
    """An iterator of (task, batch), for ``train.train``; a resumed one continues exactly.

    Every task comes once before any comes again, in an order of chance, so each has its share of the steps.
    """

    def __init__(self, parts: Mapping[str, Iterator[Sequence]], *, seed: int = 0):
        """Nothing is read yet.

        Args:
          parts: task -> its batches, without end; iterators with ``get_state`` and ``set_state``.
          seed: of the order.

        Raises:
          ValueError: no task.
        """
        if not parts:
            raise ValueError("mixed batches: expected at least one task, got none.")
        self._parts, self._seed, self._taken = dict(parts), seed, 0

    def __iter__(self):
        """Itself."""
        return self

    def __next__(self) -> tuple[str, Sequence]:
        """Return the next task and its next batch."""
        turn, place = divmod(self._taken, len(self._parts))
        order = np.random.default_rng([self._seed, turn]).permutation(len(self._parts))
        task = list(self._parts)[order[place]]
        self._taken += 1
        return task, next(self._parts[task])

    def get_state(self) -> dict[str, Any]:
        """Where it is, to be saved beside a checkpoint."""
        parts: dict[str, Any] = self._parts
        return {"taken": self._taken, "parts": {task: part.get_state() for task, part in parts.items()}}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue after a saved state.

        Raises:
          ValueError: it was saved of other tasks.
        """
        if set(state["parts"]) != set(self._parts):
            raise ValueError(
                f"mixed batches: expected a state of the tasks {', '.join(self._parts)}, got one of "
                f"{', '.join(state['parts'])}. Resume with the settings that it was trained with."
            )
        self._taken = state["taken"]
        parts: dict[str, Any] = self._parts
        for task, inner in state["parts"].items():
            parts[task].set_state(inner)
