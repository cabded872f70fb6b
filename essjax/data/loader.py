"""Batches of training clips from any source of sequences: a list, a dataset on disk, or scenes rendered live."""

import dataclasses
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import grain
import jax
import numpy as np

from essjax.data.augment import crop as crop_sequence
from essjax.data.augment import crop_images, crop_origin, flip, start_with_cut
from essjax.data.layout import Dataset
from essjax.data.memory import Kept
from essjax.data.read import read_frame, select_records
from essjax.frames import Sequence, frame_size, select_time
from essjax.sizes import MAX_STEP, Size, crop_steps


class Source(Protocol):
    """Anything with a length that gives ``Sequence``s by index, NumPy leaves ``[T, H, W, C]``: a list will do."""

    def __len__(self) -> int:
        """Return the number of sequences."""
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


class DiskSource:
    """The segments of a split, read frame by frame when asked for; safe to share between threads.

    Lengths, cuts and sizes come from the metadata. Frames stay in memory, as float32, while there is room for them.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        *,
        native: bool = False,
        ranges: bool = False,
        memory: int | None = None,
    ):
        """See ``disk_source``."""
        self._dataset, self._segments = dataset, dataset.segments(split)
        self._options = {"native": native, "ranges": ranges}
        self._records = [select_records(dataset.sequences[s.sequence], s.first, s.last) for s in self._segments]
        self._kept = Kept(memory)
        self._pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="essjax-read")

    def __len__(self) -> int:
        return len(self._segments)

    def __getitem__(self, index: int) -> Sequence:
        if not 0 <= index < len(self):
            raise IndexError(index)
        return self.window(index, 0, len(self._records[index]))

    def cuts(self, index: int) -> np.ndarray:
        """Bool ``[T]``: which frames of sequence ``index`` are cuts; the first one always is."""
        return np.array([n == 0 or bool(record.get("cut")) for n, record in enumerate(self._records[index])])

    def outline(self, index: int) -> tuple[Size, Size, Any]:
        """Sizes of the frames and references of sequence ``index``, and what it must have in common with the others."""
        info, records = self._dataset.info, self._records[index]
        optional = {(record.get("camera") is None, record.get("exposure") is None) for record in records}
        return info.size, info.output, optional

    def window(self, index: int, start: int, length: int, box: tuple[int, int, int, int] | None = None) -> Sequence:
        """Return what slicing sequence ``index`` in time, then ``crop``, gives, bit by bit; only these frames are read.

        Args:
          index: of the sequence.
          start: its first frame that is wanted.
          length: frames.
          box: top, left, height and width in LR pixels, or None for whole frames.

        Raises:
          ValueError: a file is missing or damaged.
        """
        info = self._dataset.sequences[self._segments[index].sequence]
        records = self._records[index][start : start + length]

        def read(record: Any) -> Sequence:
            make = partial(read_frame, self._dataset.path, info, record, **self._options)
            frame = self._kept.get((info.name, record["number"]), make)
            # Copied, so that a frame that is not kept is gone before the others are read.
            return frame if box is None else jax.tree.map(np.array, crop_images(frame, *box))

        kept = [self._kept.find((info.name, record["number"])) for record in records]
        others = self._pool.map(read, [record for record, frame in zip(records, kept, strict=True) if frame is None])
        parts = [
            next(others) if frame is None else frame if box is None else crop_images(frame, *box) for frame in kept
        ]
        found = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        found = found if box is None else crop_origin(found, *box[:2])
        return start_with_cut(found) if start == 0 else found


def disk_source(
    dataset: Dataset, split: str, *, native: bool = False, ranges: bool = False, memory: int | None = None
) -> DiskSource:
    """Offer the segments of a split, read when first used; ``dataset.segments(split)`` says which frames are scored.

    Args:
      dataset: from ``read_dataset``.
      split: its name.
      native: read the native frames too, where there are any.
      ranges: read the sample ranges too, where there are any.
      memory: bytes of decoded frames that stay in memory, others are read again each time; None: half of what is free.

    Raises:
      ValueError: there is no such split.
    """
    return DiskSource(dataset, split, native=native, ranges=ranges, memory=memory)


def cuts_of(source: Source, index: int) -> np.ndarray:
    """Bool ``[T]``: which frames of sequence ``index`` are cuts."""
    return source.cuts(index) if isinstance(source, DiskSource) else np.asarray(source[index].frames.cut)


def windows(source: Source, length: int) -> list[tuple[int, int]]:
    """All ``(sequence, start)`` of ``length`` frames in a row, cuts or not.

    Raises:
      ValueError: there is none.
    """
    lengths = [len(cuts_of(source, index)) for index in range(len(source))]
    found = [(index, start) for index, frames in enumerate(lengths) for start in range(frames - length + 1)]
    if not found:
        raise ValueError(
            f"clips: no {length} frames in a row in {len(source)} sequences (the longest has {max(lengths, default=0)} "
            "frames). Use a smaller length or longer sequences."
        )
    return found


def _outline(source: Source, index: int) -> tuple[Size, Size, Any]:
    """(height, width) of the frames and references of a sequence, and what all sequences must have in common."""
    if isinstance(source, DiskSource):
        return source.outline(index)
    sequence = dataclasses.replace(source[index], native=None)
    shape = sequence.frames.motion.shape
    if len(shape) != 4:
        raise ValueError(f"clips: expected sequences [T, H, W, C], got motion {shape} in sequence {index}.")
    return frame_size(sequence.frames), sequence.size, (sequence.scale, jax.tree.structure(sequence))


def check_alike(source: Source, crop: tuple[int, int] | None) -> None:
    """All sequences must hold the same buffers at the same scale, and be of one size or fit the crop."""
    first = _outline(source, 0)
    for index in range(len(source)):
        (height, width), output, kind = _outline(source, index)
        if crop is not None and (crop[0] > height or crop[1] > width or min(crop) < 1):
            raise ValueError(
                f"clips: a crop of {crop[1]}x{crop[0]} does not fit into sequence {index} of {width}x{height}."
            )
        if crop is not None and crop != (height, width):
            _check_crop(crop, (height, width), output, index)
        if crop is None and (height, width) != first[0]:
            raise ValueError(f"clips: sequence {index} has another size than sequence 0. Give a crop that fits both.")
        if kind != first[2]:
            raise ValueError(
                f"clips: sequence {index} has another scale or other buffers than sequence 0, or only one of them has "
                "cameras or an exposure."
            )


def _check_crop(crop: Size, size: Size, output: Size, index: int) -> None:
    """Raise a ValueError unless the reference's part of every crop of these frames can be a whole number of pixels."""
    steps = crop_steps(size, output)
    where = f"clips: sequence {index} of {size[1]}x{size[0]} with references of {output[1]}x{output[0]}"
    if steps is None:
        raise ValueError(
            f"{where}: crops need a ratio with denominators of at most {MAX_STEP}, such as 1.5 or 4/3. Train on whole "
            "frames (no crop), or on data of another ratio."
        )
    if any(side % step and side != whole for side, step, whole in zip(crop, steps, size, strict=True)):
        raise ValueError(
            f"{where}: expected a crop of multiples of {steps[1]}x{steps[0]}, so that the reference's part is whole, "
            f"got {crop[1]}x{crop[0]}."
        )


def _cut_out(source: Source, index: int, start: int, length: int, box: tuple[int, int, int, int] | None) -> Sequence:
    if isinstance(source, DiskSource):
        return dataclasses.replace(source.window(index, start, length, box), native=None)
    clip: Sequence = select_time(dataclasses.replace(source[index], native=None), slice(start, start + length))
    return clip if box is None else crop_sequence(clip, *box)


class View(NamedTuple):
    """The part of each frame of a sequence that a clip shows.

    Attributes:
      box: top, left, height and width in LR pixels, or None for whole frames.
      flips: directions, see ``flip``.
    """

    box: tuple[int, int, int, int] | None
    flips: tuple[str, ...]


def draw_view(
    source: Source, index: int, crop: tuple[int, int] | None, flips: bool, random: np.random.Generator
) -> View:
    """Draw a view of sequence ``index``: ``crop`` (height, width) anywhere in its frames, mirrored or not."""
    (height, width), output, _ = _outline(source, index)
    size = crop or (height, width)
    # At multiples of the ratio's denominator, so that the reference's part is whole.
    steps = (1, 1) if size == (height, width) else crop_steps((height, width), output) or (1, 1)
    top, left = (
        step * random.integers(0, (whole - side) // step + 1)
        for whole, side, step in zip((height, width), size, steps, strict=True)
    )
    chosen = random.random(2) < 0.5
    directions = zip(("horizontal", "vertical"), chosen, strict=True)
    box = None if size == (height, width) else (int(top), int(left), *size)
    return View(box, tuple(direction for direction, yes in directions if flips and yes))


def cut_clip(source: Source, index: int, start: int, length: int, view: View) -> Sequence:
    """``length`` frames of sequence ``index`` from ``start``, ``[length, h, w, C]``; cuts stay as they are."""
    clip = _cut_out(source, index, start, length, view.box)
    for direction in view.flips:
        clip = flip(clip, direction)
    return clip


def make_clip(
    source: Source,
    index: int,
    start: int,
    length: int,
    crop: tuple[int, int] | None,
    flips: bool,
    random: np.random.Generator,
) -> Sequence:
    """One clip ``[length, h, w, C]``: a window in time, a random one in space, random flips; frame 0 is a cut."""
    return start_with_cut(cut_clip(source, index, start, length, draw_view(source, index, crop, flips, random)))


def stack_clips(batch: Any) -> Sequence:
    """Clips ``[T, h, w, C]`` as one batch ``[T, B, h, w, C]``."""
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
    ``get_state()`` and ``set_state(state)``: a resumed iterator continues exactly. Of a ``disk_source`` each clip
    reads the frames that it shows, unless they are still in memory; any other source gives all its sequences first, so
    that nothing is rendered while training waits.

    Args:
      source: a list of sequences, ``disk_source`` or any ``Source``.
      length: frames per clip; the first is a cut, and so is any that is one in its sequence.
      batch: clips per batch.
      crop: (height, width) in LR pixels, at random whole LR pixels; the reference is cut to match. None: whole frames.
      flips: mirror half of the clips left-right and half top-bottom.
      seed: of shuffling, crops and flips.
      epochs: passes over all clips; None: without end.
      threads: that prepare batches; at most as many as are held ready.
      prefetch: batches held ready.

    Raises:
      ValueError: no window is long enough, the crop does not fit, or sequences differ in buffers or size; when a clip
        is taken, a file that is missing or damaged.
    """
    if length < 1 or batch < 1:
        raise ValueError(f"clips: expected length >= 1 and batch >= 1, got {length} and {batch}.")
    found = windows(source, length)
    check_alike(source, crop)

    def cut_out(window: tuple[int, int], random: np.random.Generator) -> Sequence:
        return make_clip(source, *window, length, crop, flips, random)

    return (
        grain.MapDataset.source(found)
        .seed(seed)
        .shuffle()
        .repeat(epochs)
        .random_map(cut_out)
        .batch(batch, drop_remainder=True, batch_fn=stack_clips)
        .to_iter_dataset(grain.ReadOptions(num_threads=min(threads, prefetch), prefetch_buffer_size=prefetch))
    )
