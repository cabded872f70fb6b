"""A store bounded in bytes: what is read stays in memory while there is room; and how much memory is free."""

import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import jax

from essjax.typing import PyTree

UNKNOWN = 4 << 30
"""Bytes that count as free where the system does not say."""


def _number(path: Path, name: str = "") -> int:
    """Read the number in a file, or that in its line ``name``."""
    text = path.read_text()
    return int(dict(line.split() for line in text.splitlines())[name] if name else text)


def _groups(root: Path) -> list[tuple[Path, str, str]]:
    """Control groups this process belongs to, and those around them: folder, file of the limit, file of the use."""
    found = []
    for line in (root / "proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        top, names = root / "sys/fs/cgroup", ("memory.max", "memory.current")
        if "memory" in controllers.split(","):
            top, names = top / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
        elif controllers:
            continue
        folder = top / path.strip("/")
        found += [(each, *names) for each in (folder, *folder.parents) if each.is_relative_to(top)]
    return found


def free_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may still use without swapping: of the machine, or of its container or batch job.

    Args:
      root: where ``proc`` and ``sys`` are.
    """
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
        groups = _groups(root)
    except (OSError, ValueError, StopIteration):  # not Linux
        return UNKNOWN
    for folder, limit, usage in groups:
        try:
            # Files that were read are counted as used, though they make room at once.
            cached = _number(folder / "memory.stat", "inactive_file")
            free = min(free, _number(folder / limit) - _number(folder / usage) + cached)
        except (OSError, ValueError, KeyError):  # "max": no limit
            continue
    return max(free, 0)


class Kept:
    """Values by key, kept as long as all together stay within a bound; safe to share between threads.

    What came first stays and the rest is made again each time: where every key is asked for equally often, in random
    order, as in training, nothing found by then is worth more, and throwing out the oldest finds less.
    """

    def __init__(self, limit: int | None = None):
        """``limit``: bytes of all values together; None: as many as stay free beside them, half of what there is."""
        self._limit, self._lock = limit, threading.Lock()
        self._values: dict[Hashable, Any] = {}
        self.size = 0
        """Bytes of the values kept."""

    def find(self, key: Hashable) -> PyTree | None:
        """Return the value of ``key``, or None if it is not kept."""
        with self._lock:
            return self._values.get(key)

    def get(self, key: Hashable, make: Callable[[], PyTree]) -> PyTree:
        """Return the value of ``key``, kept or made; two threads that ask at the same time may both make it."""
        value = self.find(key)
        if value is not None:
            return value
        value = make()
        size = sum(getattr(leaf, "nbytes", 0) for leaf in jax.tree.leaves(value))
        with self._lock:
            limit = free_memory() if self._limit is None else self._limit
            if key not in self._values and self.size + size <= limit:
                self._values[key] = value
                self.size += size
            return self._values.get(key, value)
