"""Clips of ever new scenes: while one round of sequences is trained on, the next one is made."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from essjax.frames import Sequence


class Rounds:
    """An iterator of batches that changes its sequences after so many batches, for ``train.train``.

    A thread makes the next round meanwhile; where it is not ready in time, the change waits for it. So what comes
    depends on the rounds and on nothing else, and a resumed iterator continues exactly.
    """

    def __init__(self, make: Callable[[int], Iterator[Sequence]], batches: int):
        """Nothing is made before the first batch is asked for.

        Args:
          make: round number, from 0, -> its iterator of batches (``iter(data.clips(...))``, without end); called in
            another thread for all rounds but the first.
          batches: of each round.

        Raises:
          ValueError: no batches.
        """
        if batches < 1:
            raise ValueError(f"rounds: expected at least 1 batch of each, got {batches}.")
        self._make, self._batches = make, batches
        self._round, self._taken = 0, 0
        self._current: Any = None
        self._next: Future | None = None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="essjax-rounds")

    def __iter__(self):
        """Itself."""
        return self

    def __next__(self) -> Sequence:
        """Return the next batch; what making its round raised is raised here."""
        if self._taken == self._batches:
            self._current = self._ahead().result()
            self._round, self._taken, self._next = self._round + 1, 0, None
        if self._current is None:
            self._current = self._make(self._round)
        self._ahead()
        self._taken += 1
        return next(self._current)

    def _ahead(self) -> Future:
        """Start making the next round."""
        if self._next is None:
            self._next = self._worker.submit(self._make, self._round + 1)
        return self._next

    def get_state(self) -> dict[str, Any]:
        """Where it is, to be saved beside a checkpoint; JSON can hold it if the rounds' own states can be held."""
        inner = None if self._current is None else self._current.get_state()
        return {"round": self._round, "taken": self._taken, "inner": inner}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue after a saved state: its round is made again."""
        self._next, self._current = None, None
        self._round, self._taken = state["round"], state["taken"]
        if state["inner"] is not None:
            self._current = self._make(self._round)
            self._current.set_state(state["inner"])
