"""Clips that follow each other: every slot of a batch walks through one shot after the other, in one crop of each."""

import sys
import threading
from bisect import bisect_right
from typing import NamedTuple

import grain
import numpy as np

from essjax.data.augment import start_with_cut
from essjax.data.loader import Source, View, check_alike, cut_clip, cuts_of, draw_view, stack_clips
from essjax.frames import Sequence


class _Shot(NamedTuple):
    """Frames without a cut after the first: of which sequence, the first one, how many."""

    sequence: int
    first: int
    frames: int


class _Visit(NamedTuple):
    """A slot's walk through a shot: the first frame it shows and what it sees of all of them."""

    sequence: int
    first: int
    view: View


def _shots(source: Source, length: int) -> list[_Shot]:
    """All that hold ``length`` frames.

    Raises:
      ValueError: there is none.
    """
    found, longest = [], 0
    for index in range(len(source)):
        cut = np.array(cuts_of(source, index))
        cut[0] = True
        ends = [*np.flatnonzero(cut), len(cut)]
        shots = [_Shot(index, int(first), int(end - first)) for first, end in zip(ends, ends[1:], strict=False)]
        longest = max(longest, *(shot.frames for shot in shots))
        found += [shot for shot in shots if shot.frames >= length]
    if not found:
        raise ValueError(
            f"successive clips: no {length} consecutive frames without a cut in {len(source)} sequences (the longest "
            f"shot has {longest} frames). Use a smaller length or longer sequences."
        )
    return found


class _Slot:
    """One slot of the batches; made as far as it was asked for, so that every place can be asked for."""

    def __init__(self, shots: list[_Shot], draw, step: int, length: int, random: np.random.Generator):
        self._shots, self._draw, self._step, self._length = shots, draw, step, length
        self._random, self._lock = random, threading.Lock()
        self._visits: list[_Visit] = []
        self._ends: list[int] = []  # how many windows there are up to the end of each visit
        self._order: list[int] = []

    def __getitem__(self, number: int) -> tuple[_Visit, int]:
        """Find the visit that shows window ``number`` of the slot, and which of that visit's windows it is."""
        with self._lock:
            while not self._ends or self._ends[-1] <= number:
                self._extend()
            visit = bisect_right(self._ends, number)
            return self._visits[visit], number - (self._ends[visit - 1] if visit else 0)

    def _extend(self) -> None:
        if not self._order:  # every shot once, then all again in another order
            self._order = self._random.permutation(len(self._shots)).tolist()
        shot = self._shots[self._order.pop()]
        windows, spare = divmod(shot.frames - self._length, self._step)
        first, windows = shot.first + int(self._random.integers(spare + 1)), windows + 1
        if not self._visits:  # the first visit begins anywhere: else all slots would start anew in the same steps
            skipped = int(self._random.integers(windows))
            first, windows = first + skipped * self._step, windows - skipped
        self._visits.append(_Visit(shot.sequence, first, self._draw(shot.sequence, self._random)))
        self._ends.append(windows + (self._ends[-1] if self._ends else 0))


def successive_clips(
    source: Source,
    *,
    length: int,
    batch: int,
    overlap: int = 1,
    crop: tuple[int, int] | None = None,
    flips: bool = True,
    seed: int = 0,
    threads: int = 2,
    prefetch: int = 4,
) -> grain.IterDataset[Sequence]:
    """Batches of clips without end, for training that carries its history from one to the next (``train.Recurrent``).

    As ``clips``, but clip b of a batch follows clip b of the batch before: the same sequence, crop and flips, and its
    first frames are the last ones of that clip, so that runs of every phase go on without a gap. Where a shot ends,
    the slot begins another one: that clip's frame 0 is a cut. Each slot sees all shots before any of them again; the
    frames left over at the end of a shot are spread by chance over its beginning and its end.

    Args:
      source: see ``clips``.
      length: frames per clip, more than ``overlap``. A shot of n frames gives (n - overlap) // (length - overlap) clips
        in a row.
      batch: see ``clips``.
      overlap: frames that a clip shares with the next one: the period - 1 where one frame in a period is rendered.
      crop: see ``clips``; drawn for each shot.
      flips: see ``clips``; drawn for each shot.
      seed: see ``clips``.
      threads: see ``clips``.
      prefetch: see ``clips``.

    Raises:
      ValueError: see ``clips``.
    """
    if length <= overlap or batch < 1:
        raise ValueError(
            f"successive clips: expected length > {overlap} (the overlap) and batch >= 1, got {length} and {batch}."
        )
    shots = _shots(source, length)
    check_alike(source, crop)

    def draw(sequence: int, random: np.random.Generator) -> View:
        return draw_view(source, sequence, crop, flips, random)

    step = length - overlap
    slots = [_Slot(shots, draw, step, length, np.random.default_rng([seed, slot])) for slot in range(batch)]

    def make(number: int) -> Sequence:
        parts = []
        for slot in slots:
            visit, window = slot[number]
            clip = cut_clip(source, visit.sequence, visit.first + window * step, length, visit.view)
            parts.append(clip if window else start_with_cut(clip))
        return stack_clips(parts)

    return (
        grain.MapDataset.range(sys.maxsize)
        .map(make)
        .to_iter_dataset(grain.ReadOptions(num_threads=min(threads, prefetch), prefetch_buffer_size=prefetch))
    )
