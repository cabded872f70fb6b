"""Write clips into a dataset: frames are converted by threads, side by side, and listed in order, a few at a time."""

import hashlib
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from essjax.data.layout import SequenceInfo
from essjax.data.store import DISAGREES, PreparedFrame, SequenceWriter
from essjax.frames import Frame, Sequence
from essjax.stopping import finishing

SAVE_EVERY = 16
"""Frames between two writes of ``sequence.json``: what a killed import loses at most."""
SKIP = " (--skip-broken leaves such frames out.)"
"""A hint."""
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

    @property
    def content(self) -> Sequence:
        """As it is written: without a time axis."""
        return Sequence(frames=self.frame, reference=self.reference)


class Clip(Protocol):
    """One sequence of a dump; a frozen dataclass with a field ``name``."""

    @property
    def name(self) -> str:
        """Name the sequence to write."""
        ...

    @property
    def numbers(self) -> tuple[int, ...]:
        """Number its frames, ascending."""
        ...

    @property
    def source(self) -> Mapping[str, Any]:
        """Return what the dataset keeps about where it comes from; JSON types."""
        ...

    def files(self, number: int) -> list[Path]:
        """List the files that one frame is read from, there or not."""
        ...

    def said(self, number: int) -> str:
        """Return what is known about one frame beside its files, as far as it matters to it."""
        ...

    def convert(self, number: int) -> Converted:
        """Read and convert one frame; called by several threads. A ValueError that names the file: it is broken."""
        ...


class OpenClip(NamedTuple):
    """A clip, the writer of its sequence, and the frames that are still to be written."""

    clip: Clip
    writer: SequenceWriter
    pending: list[int]


def made_from(clip: Clip, number: int) -> str:
    """Make a short text that changes with the name, size or date of a file of the frame, and with its metadata."""
    files = [(path.name, *_size_and_date(path)) for path in clip.files(number)]
    return hashlib.blake2b(repr((files, clip.said(number))).encode(), digest_size=8).hexdigest()


def _size_and_date(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except FileNotFoundError:
        return -1, -1
    return stat.st_size, stat.st_mtime_ns


class BrokenFrame(ValueError):
    """A frame that cannot be used, whatever the disk: ``--skip-broken`` leaves it out.

    Its text does not name sequence and frame, which whoever catches it does.
    """

    def __init__(self, name: str, number: int, error: ValueError, made_from: str):
        super().__init__(str(error).removeprefix(f"sequence {name}, frame {number}").lstrip(":, "))
        self.made_from = made_from


class Written(NamedTuple):
    """A finished sequence, and broken frame -> what is wrong with it."""

    info: SequenceInfo
    skipped: Mapping[int, str]


def open_clip(root: str | os.PathLike, clip: Clip) -> OpenClip:
    """Open the sequence that a clip is to be written to; nothing is written yet.

    A sequence may be there: part of the clip, all of it, or all but the frames that were rendered since. Broken frames
    behind its last frame are tried again.

    Args:
      root: the dataset's folder.
      clip: the frames.

    Raises:
      ValueError: the sequence there was made in another way or from other frames, which a second import cannot mend.
    """
    writer = SequenceWriter(root, clip.name, source=clip.source)
    if writer.info is None:
        return OpenClip(clip, writer, list(clip.numbers))
    last, numbers = writer.info.numbers[-1], set(clip.numbers)
    known = {record["number"]: record for record in (*writer.info.skipped, *writer.info.frames)}
    for number, record in known.items():
        if number not in numbers and "reason" not in record:
            _refuse(writer, f"frame {number} was imported before, and is not there any more")
        if number in numbers and number <= last and record.get("made_from") != made_from(clip, number):
            was = f", left out as broken ({record['reason']})," if "reason" in record else ""
            _refuse(writer, f"frame {number}{was} was changed since the import before: its files or its metadata")
    writer.skipped = {number: record for number, record in writer.skipped.items() if number in numbers}
    between = [number for number in clip.numbers if number < last and number not in known]
    if between:
        _refuse(writer, f"frame {between[0]} was not there at the import before, but frame {last} was")
    return OpenClip(clip, writer, [number for number in clip.numbers if number > last])


def _refuse(writer: SequenceWriter, what: str) -> None:
    raise ValueError(
        f"{writer.folder}: {what}. An import only goes on behind the last frame: delete that folder, or choose another "
        "output folder, and import again."
    )


def write_clip(
    opened: OpenClip,
    *,
    skip_broken: bool = False,
    workers: int | None = None,
    on_frames: Callable[[int], Any] = lambda count: None,
) -> Written:
    """Convert a clip into a finished sequence; goes on after the last frame that is there, see ``open_clip``.

    Memory holds ``2 * workers`` frames, whatever the clip's length.

    Args:
      opened: the clip.
      skip_broken: leave broken frames out; the next one becomes a cut. They stop the import otherwise.
      workers: threads; None: one per core.
      on_frames: called with the number of frames that are done since the last call.

    Raises:
      ValueError: a frame is broken (and ``skip_broken`` is off); no frame is left, or most differ
        from the first in size or channels; a file cannot be written.
      OSError: a file cannot be read or written.
      Interrupted: a signal came; the frames so far are there.
    """
    clip, writer, pending = opened
    on_frames(len(clip.numbers) - len(pending))
    frames = _prepared(opened, workers or os.cpu_count() or 1)
    left = len(pending)

    def saved() -> str:
        done = len(clip.numbers) - left
        return f"{done} of {len(clip.numbers)} frames of {clip.name} are there. Run the same command again to resume."

    with finishing(saved) as section, closing(frames), _saved_at_last(writer):
        for index, (number, future) in enumerate(frames):
            try:
                _commit(writer, number, future, save=index % SAVE_EVERY == 0)
            except BrokenFrame as error:
                if not skip_broken:
                    raise ValueError(f"sequence {clip.name}, frame {number}: {error}{hint(opened, number)}") from error
                writer.skip(number, str(error), error.made_from)
            left -= 1
            on_frames(1)
            if section.asked:
                break
    skipped = {number: writer.skipped[number]["reason"] for number in sorted(writer.skipped)}
    if writer.info is None:
        raise ValueError(f"sequence {clip.name}: all frames are broken. The first: {next(iter(skipped.values()))}")
    others = [reason for reason in skipped.values() if DISAGREES in reason]
    if len(others) > len(writer.info.frames):
        raise ValueError(
            f"{len(others)} frames are not like the {len(writer.info.frames)} at the beginning: {others[0]} Remove or "
            f"replace the wrong ones, delete {writer.folder}, and import again."
        )
    return Written(writer.finish(), skipped)


def hint(opened: OpenClip, broken: int) -> str:
    """Say what helps against a broken frame: leaving it out does not where all frames share its defect."""
    clip, writer, pending = opened
    others = [number for number in pending if number > broken]
    if writer.info is not None or not others:
        return SKIP
    for number in (others[0], others[-1]):
        try:
            writer.describe(number, clip.convert(number).content)
            return SKIP
        except ValueError:
            continue
    return " (So are other frames: change the recipe or the dump.)"


def _commit(writer: SequenceWriter, number: int, future: Future[PreparedFrame], *, save: bool) -> None:
    prepared = future.result()
    cut = writer.info is None or writer.info.numbers[-1] != number - 1
    try:
        writer.commit(prepared, cut=cut, save=save)
    except ValueError as error:
        raise BrokenFrame(writer.name, number, error, prepared.record["made_from"]) from error
    writer.skipped.pop(number, None)


@contextmanager
def _saved_at_last(writer: SequenceWriter) -> Iterator[None]:
    """However it ends, the frames so far are listed."""
    before = writer.info
    try:
        yield
    finally:
        if writer.info is not before:
            writer.save()


def _prepared(opened: OpenClip, workers: int) -> Generator[tuple[int, Future[PreparedFrame]], None, None]:
    """Frames whose images are written, in order, ``2 * workers`` on their way."""
    clip, writer, numbers = opened

    def work(number: int) -> PreparedFrame:
        before = made_from(clip, number)  # a file that changes while it is read counts as changed
        try:
            converted = clip.convert(number)
            writer.describe(number, converted.content)
        except ValueError as error:
            raise BrokenFrame(clip.name, number, error, before) from error
        try:
            return writer.prepare(number, converted.content, notes=converted.counts, made_from=before)
        except BaseException:
            writer.discard(number)
            raise

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
