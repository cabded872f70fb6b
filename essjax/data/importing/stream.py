"""Write clips into a dataset: frames are converted by threads, side by side, and listed in order, a few at a time."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np

from essjax.data.layout import SequenceInfo
from essjax.data.store import PreparedFrame, SequenceWriter
from essjax.frames import Frame

SAVE_EVERY = 16
"""Frames between two writes of ``sequence.json``: what a killed import loses at most."""
OnFrame = Callable[[int, int], Any]
"""Called with (frames done, frames in all)."""


class Converted(NamedTuple):
    """A frame in essjax's conventions.

    Attributes:
      frame: leaves ``[H, W, C]``.
      reference: ``[s*H, s*W, 3]``.
      counts: what had to be repaired, name -> pixels or values.
    """

    frame: Frame
    reference: np.ndarray
    counts: Mapping[str, int]


class Clip(Protocol):
    """One sequence of a dump; a frozen dataclass with a field ``name``."""

    @property
    def name(self) -> str:
        """Of the sequence to write."""
        ...

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of its frames, ascending."""
        ...

    @property
    def source(self) -> Mapping[str, Any]:
        """What the dataset keeps about where it comes from; JSON types."""
        ...

    def convert(self, number: int) -> Converted:
        """Read and convert one frame; called by several threads. A ValueError that names the file: it is broken."""
        ...


class Written(NamedTuple):
    """A finished sequence, and broken frame -> what is wrong with it; "" if an earlier run found out."""

    info: SequenceInfo
    skipped: Mapping[int, str]


def write_clip(
    root: str | os.PathLike,
    clip: Clip,
    *,
    skip_broken: bool = False,
    workers: int | None = None,
    on_frames: Callable[[int], Any] = lambda count: None,
) -> Written:
    """Convert a clip into a finished sequence; resumes behind the last frame that is there.

    Memory holds ``2 * workers`` frames, whatever the clip's length.

    Args:
      root: the dataset's folder.
      clip: the frames.
      skip_broken: leave broken frames out; the next one becomes a cut. They stop the import otherwise.
      workers: threads; None: one per core.
      on_frames: called with the number of frames that are done since the last call.

    Raises:
      ValueError: a frame is broken (and ``skip_broken`` is off), or no frame is left.
    """
    writer = SequenceWriter(root, clip.name, source=clip.source)
    last = writer.info.numbers[-1] if writer.info else clip.numbers[0] - 1
    pending = [] if writer.complete else [number for number in clip.numbers if number > last]
    on_frames(len(clip.numbers) - len(pending))
    reasons: dict[int, str] = {}
    with closing(_prepared(clip, writer, pending, workers or os.cpu_count() or 1)) as frames, _saved_at_last(writer):
        for index, (number, future) in enumerate(frames):
            try:
                cut = writer.info is None or writer.info.numbers[-1] != number - 1
                writer.commit(future.result(), cut=cut, save=index % SAVE_EVERY == 0)
            except ValueError as error:
                writer.discard(number)
                if not skip_broken:
                    message = f"sequence {clip.name}, frame {number}: {error} (--skip-broken leaves such frames out.)"
                    raise ValueError(message) from error
                reasons[number] = str(error)
            on_frames(1)
    if writer.info is None:
        raise ValueError(f"sequence {clip.name}: all frames are broken. The first: {next(iter(reasons.values()))}")
    info = writer.finish()
    left_out = sorted(set(clip.numbers) - set(info.numbers))
    return Written(info, {number: reasons.get(number, "") for number in left_out})


@contextmanager
def _saved_at_last(writer: SequenceWriter) -> Iterator[None]:
    """However it ends, the frames so far are listed."""
    try:
        yield
    finally:
        writer.save()


def _prepared(
    clip: Clip, writer: SequenceWriter, numbers: list[int], workers: int
) -> Generator[tuple[int, Future[PreparedFrame]], None, None]:
    """Frames whose images are written, in order, ``2 * workers`` on their way."""

    def work(number: int) -> PreparedFrame:
        converted = clip.convert(number)
        return writer.prepare(number, converted.frame, converted.reference, notes=converted.counts)

    waiting: deque[tuple[int, Future[PreparedFrame]]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for number in numbers:
                waiting.append((number, pool.submit(work, number)))
                if len(waiting) == 2 * workers:
                    yield waiting.popleft()
            while waiting:
                yield waiting.popleft()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
            for number, _ in waiting:  # written, but not listed
                writer.discard(number)
