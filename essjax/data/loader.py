"""Batches of training clips from any source of sequences: read from disk or rendered live, held in memory."""

import dataclasses
import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol

import grain
import jax
import numpy as np

from essjax.data.augment import crop as crop_sequence
from essjax.data.augment import flip, start_with_cut
from essjax.data.layout import Dataset
from essjax.data.read import read_segment
from essjax.frames import Sequence, select_time


class Source(Protocol):
    """Anything with a length that gives ``Sequence``s by index, NumPy leaves ``[T, H, W, C]``: a list will do."""

    def __len__(self) -> int:
        """Number of sequences."""
        ...

    def __getitem__(self, index: int) -> Sequence:
        """Sequence ``index``."""
        ...


class CachedSource:
    """A source whose sequences are made on first use and then kept in memory; safe to share between threads."""

    def __init__(self, makers: Iterable[Callable[[], Sequence]]):
        """``makers``: one function per sequence."""
        self._makers = list(makers)
        self._cache: dict[int, Sequence] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._makers)

    def __getitem__(self, index: int) -> Sequence:
        if not 0 <= index < len(self):
            raise IndexError(index)
        with self._lock:
            if index not in self._cache:
                self._cache[index] = jax.tree.map(np.asarray, self._makers[index]())
            return self._cache[index]


def disk_source(dataset: Dataset, split: str, *, native: bool = False, ranges: bool = False) -> CachedSource:
    """The segments of a split, read when first used; ``dataset.segments(split)`` says which frames are scored."""
    read = partial(read_segment, dataset, native=native, ranges=ranges)
    return CachedSource([partial(read, segment) for segment in dataset.segments(split)])


def windows(source: Source, length: int) -> list[tuple[int, int]]:
    """All ``(sequence, start)`` such that ``length`` frames from ``start`` hold no cut after their first frame.

    Raises:
      ValueError: there is none.
    """
    found = []
    for index in range(len(source)):
        cut = np.asarray(source[index].frames.cut)
        starts = range(len(cut) - length + 1)
        found += [(index, start) for start in starts if not cut[start + 1 : start + length].any()]
    if not found:
        longest = max((len(source[index].frames.cut) for index in range(len(source))), default=0)
        raise ValueError(
            f"clips: no {length} consecutive frames without a cut in {len(source)} sequences (the longest has "
            f"{longest} frames). Use a smaller length or longer sequences."
        )
    return found


def _check_alike(source: Source, crop: tuple[int, int] | None) -> None:
    """All sequences must hold the same buffers at the same scale, and be of one size or fit the crop."""
    bare = [dataclasses.replace(source[index], native=None) for index in range(len(source))]
    for index, sequence in enumerate(bare):
        shape = sequence.frames.motion.shape
        if len(shape) != 4:
            raise ValueError(f"clips: expected sequences [T, H, W, C], got motion {shape} in sequence {index}.")
        height, width = shape[1:3]
        if crop is not None and (crop[0] > height or crop[1] > width or min(crop) < 1):
            raise ValueError(
                f"clips: a crop of {crop[1]}x{crop[0]} does not fit into sequence {index} of {width}x{height}."
            )
        if crop is None and sequence.frames.motion.shape[1:] != bare[0].frames.motion.shape[1:]:
            raise ValueError(f"clips: sequence {index} has another size than sequence 0. Give a crop that fits both.")
        if sequence.scale != bare[0].scale or jax.tree.structure(sequence) != jax.tree.structure(bare[0]):
            raise ValueError(f"clips: sequence {index} has another scale or other buffers than sequence 0.")


def make_clip(
    sequence: Sequence,
    start: int,
    length: int,
    crop: tuple[int, int] | None,
    flips: bool,
    random: np.random.Generator,
) -> Sequence:
    """One clip ``[length, h, w, C]``: a window in time, a random one in space, random flips; frame 0 is a cut."""
    clip: Sequence = select_time(dataclasses.replace(sequence, native=None), slice(start, start + length))
    height, width = clip.frames.motion.shape[-3:-1]
    size = crop or (height, width)
    top, left = random.integers(0, height - size[0] + 1), random.integers(0, width - size[1] + 1)
    chosen = random.random(2) < 0.5
    if size != (height, width):
        clip = crop_sequence(clip, int(top), int(left), *size)
    for direction, yes in zip(("horizontal", "vertical"), chosen, strict=True):
        if flips and yes:
            clip = flip(clip, direction)
    return start_with_cut(clip)


def _stack(batch: Any) -> Sequence:
    return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *batch)


def clips(
    source: Source,
    *,
    length: int,
    batch: int,
    crop: tuple[int, int] | None = None,
    flips: bool = True,
    seed: int = 0,
    epochs: int | None = None,
    threads: int = 2,
    prefetch: int = 4,
) -> grain.IterDataset[Sequence]:
    """Shuffled batches of clips, time-major: ``Sequence`` with NumPy leaves ``[length, batch, h, w, C]``.

    The order and every random choice follow from ``seed``, whatever the number of threads. ``iter(clips(...))`` has
    ``get_state()`` and ``set_state(state)``: a resumed iterator continues exactly. All sequences are brought into
    memory first, so that nothing is read or rendered while training waits.

    Args:
      source: a list of sequences, ``disk_source`` or any ``Source``.
      length: frames per clip; a cut is at most its first frame.
      batch: clips per batch.
      crop: (height, width) in LR pixels, at random whole LR pixels; the reference is cut to match. None: whole frames.
      flips: mirror half of the clips left-right and half top-bottom.
      seed: of shuffling, crops and flips.
      epochs: passes over all clips; None: without end.
      threads: that prepare batches.
      prefetch: batches held ready.

    Raises:
      ValueError: no window is long enough, the crop does not fit, or sequences differ in buffers or size.
    """
    if length < 1 or batch < 1:
        raise ValueError(f"clips: expected length >= 1 and batch >= 1, got {length} and {batch}.")
    found = windows(source, length)
    _check_alike(source, crop)

    def cut_out(window: tuple[int, int], random: np.random.Generator) -> Sequence:
        return make_clip(source[window[0]], window[1], length, crop, flips, random)

    return (
        grain.MapDataset.source(found)
        .seed(seed)
        .shuffle()
        .repeat(epochs)
        .random_map(cut_out)
        .batch(batch, drop_remainder=True, batch_fn=_stack)
        .to_iter_dataset(grain.ReadOptions(num_threads=threads, prefetch_buffer_size=prefetch))
    )
