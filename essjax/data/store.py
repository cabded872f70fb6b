"""``Sequence``s to a dataset folder, frame by frame: the ledger of what is there, and how it may go on."""

import dataclasses
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import OpenEXR

from essjax.data import encode
from essjax.data.json_files import is_name
from essjax.data.layout import AGREE, KINDS, OPEN, SequenceInfo, frame_path, read_sequence_info, write_sequence_info
from essjax.data.records import differences, digest, frame_record, plain
from essjax.frames import Sequence, select_time

FAST = {"compression": OpenEXR.RLE_COMPRESSION}
"""For imports, which ZIP would dominate: lossless in a third of its time, for a quarter more disk (path-traced)."""
DISAGREES = "all frames of a sequence must agree"
"""Part of the message about a frame of another size or with other channels than those before."""


class PreparedFrame(NamedTuple):
    """A frame whose images are on disk, but which the sequence does not list yet.

    Attributes:
      number: original frame number.
      described: what a sequence of such frames looks like.
      record: its entry in ``sequence.json``.
    """

    number: int
    described: SequenceInfo
    record: Mapping[str, Any]


class SequenceWriter:
    """Writes one sequence frame by frame; what is already complete on disk is kept.

    A frame counts as complete once ``sequence.json`` lists it, which happens after its images are in place. Opening
    a sequence again resumes it, or goes on behind its last frame; ``number in writer`` says which frames are there.

    A folder that holds images but no ``sequence.json`` was not written here and is refused: it may be somebody's
    renders.

    Attributes:
      info: the sequence so far; None before its first frame.
      skipped: frames that were left out: number -> ``number``, ``reason``, ``made_from``.
    """

    def __init__(self, root: str | os.PathLike, name: str, *, source: Mapping[str, Any] | None = None):
        """Open or resume.

        Args:
          root: the dataset's folder.
          name: of the sequence, and of its folder.
          source: what makes these frames (settings, seeds); JSON types.

        Raises:
          ValueError: the name is not a folder name, the sequence there was made from another source, or the images
            there are not of a sequence.
        """
        if not is_name(name):
            raise ValueError(f"sequence name: expected a plain folder name, got {name!r}.")
        self.root, self.name, self.source = Path(root), name, plain(dict(source or {}))
        self.info: SequenceInfo | None = None
        self.skipped: dict[int, Mapping[str, Any]] = {}
        self._mine: set[int] = set()  # frames whose images this writer may remove
        self._lock = threading.Lock()
        self._claimed = (self.folder / "sequence.json").is_file()
        if self._claimed:
            info = read_sequence_info(root, name)
            self._check_source(info.source)
            self.info = info if info.frames else None
            self.skipped = {record["number"]: record for record in info.skipped}
        else:
            self._check_foreign()

    @property
    def folder(self) -> Path:
        """Return the folder of the sequence."""
        return self.root / self.name

    def _check_source(self, found: Mapping[str, Any]) -> None:
        if self.source != found:
            raise ValueError(
                f"{self.folder}: holds frames made with other settings "
                f"({'; '.join(differences(self.source, found))}). Choose another output folder, or delete this one."
            )

    def _check_foreign(self) -> None:
        for kind in KINDS:
            for path in sorted(self.folder.glob(f"{kind}.*.exr")):
                raise ValueError(
                    f"{self.folder}: expected a new folder or one of an essjax dataset, found images without a "
                    f"sequence.json ({path.name}, ...), which would be overwritten. Choose another output folder."
                )

    def _claim(self, described: SequenceInfo) -> None:
        """Leave a ``sequence.json`` without frames before the first image: what follows is ours, even if killed."""
        with self._lock:
            if not self._claimed:
                self.folder.mkdir(parents=True, exist_ok=True)
                write_sequence_info(self.root, described)
                self._claimed = True

    def __contains__(self, number: int) -> bool:
        return self.info is not None and number in self.info.numbers

    @property
    def complete(self) -> bool:
        """Whether the sequence is finished."""
        return self.info is not None and self.info.complete

    def _check_next(self, number: int, described: SequenceInfo, cut: bool, said: Mapping[str, Any]) -> SequenceInfo:
        info = self.info or described
        for field in (*AGREE, "native"):
            if getattr(info, field) != getattr(described, field):
                raise ValueError(
                    f"sequence {self.name}, frame {number}: {field} changes from {getattr(info, field)} to "
                    f"{getattr(described, field)}; {DISAGREES}."
                )
        for key in OPEN if info.frames else ():
            if (said[key] is None) != (info.frames[0][key] is None):
                there, here = ("has one", "has none") if said[key] is None else ("has none", "has one")
                raise ValueError(
                    f"sequence {self.name}, frame {number}: {key}: frame {info.numbers[0]} {there}, this one {here}; "
                    f"{DISAGREES}. Give it for all, or for none."
                )
        if info.frames and number != info.numbers[-1] + 1 and not (cut and number > info.numbers[-1]):
            raise ValueError(
                f"sequence {self.name}: expected frame {info.numbers[-1] + 1} next, got {number}. Motion links each "
                "frame to the one before; after a gap the frame must be a cut."
            )
        return info

    def write(self, number: int, content: Sequence, *, notes: Mapping[str, Any] | None = None) -> None:
        """Write one frame. Nothing happens if it is already complete, with the same content.

        Args:
          number: original frame number; consecutive, unless the frame is a cut.
          content: without a time axis: leaves ``[H, W, C]``, with colour.
          notes: numbers about this frame to keep in its record; ``clamped``, the count of values beyond half's range
            that were clamped, is added.

        Raises:
          ValueError: invalid content, it does not fit to the frames before, or the frame is complete with other
            content (not noticed where an older essjax wrote it); names sequence, frame and channel.
        """
        content = jax.tree.map(np.asarray, content)
        made_from = digest(content)
        if self._is_there(number, made_from):
            return
        frame = content.frames
        self._check_next(number, self.describe(number, content), bool(frame.cut), vars(frame))
        self.commit(self._write_images(number, content, notes or {}, {}, made_from))

    def _is_there(self, number: int, made_from: str) -> bool:
        if number not in self:
            return False
        assert self.info is not None
        found = self.info.frames[self.info.numbers.index(number)].get("made_from", made_from)
        if found != made_from:
            raise ValueError(
                f"{self.folder}: frame {number} is there already, with other content. Choose another name or output "
                "folder, or delete this one."
            )
        return True

    def describe(self, number: int, content: Sequence) -> SequenceInfo:
        """Describe what a sequence of such frames looks like; nothing is written.

        Raises:
          ValueError: invalid content.
        """
        content = jax.tree.map(np.asarray, content)
        encode.validate(content, f"sequence {self.name}, frame {number}")
        return encode.describe(content, self.name, self.source)

    def prepare(
        self, number: int, content: Sequence, *, notes: Mapping[str, Any] | None = None, made_from: str = ""
    ) -> PreparedFrame:
        """Do the first half of ``write``: write the images of a frame that ``describe`` accepts.

        Threads may prepare frames side by side.

        Args:
          number: see ``write``.
          content: see ``write``.
          notes: see ``write``.
          made_from: what the frame was made from, a short text to recognise a change by.

        Raises:
          ValueError: the images cannot be written.
        """
        return self._write_images(number, jax.tree.map(np.asarray, content), notes or {}, FAST, made_from)

    def skip(self, number: int, reason: str, made_from: str) -> None:
        """Keep in ``sequence.json`` that a frame was left out, why, and what it was made from (see ``prepare``)."""
        self.skipped[number] = {"number": number, "reason": reason, "made_from": made_from}

    def commit(self, prepared: PreparedFrame, *, cut: bool = False, save: bool = True) -> None:
        """Do the second half of ``write``: list a prepared frame; one thread, in the order of the frames.

        Args:
          prepared: from ``prepare``.
          cut: the frame is a cut, whatever it says itself: the frame before it was left out.
          save: write ``sequence.json`` now. It grows with the frames, so a long import saves only now and then.

        Raises:
          ValueError: it does not fit to the frames before. Its images are removed.
        """
        cut = cut or prepared.record["cut"]
        try:
            info = self._check_next(prepared.number, prepared.described, cut, prepared.record)
        except ValueError:
            self.discard(prepared.number)
            raise
        frames = (*info.frames, {**prepared.record, "cut": cut})
        self.info = dataclasses.replace(info, frames=frames, complete=False)
        if save:
            self.save()

    def save(self) -> None:
        """Write ``sequence.json``, if there is a frame."""
        if self.info is not None:
            self.info = dataclasses.replace(self.info, skipped=tuple(self.skipped.values()))
            write_sequence_info(self.root, self.info)

    def discard(self, number: int) -> None:
        """Remove the images of a frame that is not listed, if this writer wrote them."""
        if number in self._mine and number not in self:
            for kind in KINDS:
                frame_path(self.root, self.name, kind, number).unlink(missing_ok=True)

    def _write_images(
        self, number: int, content: Sequence, notes: Mapping, attributes: Mapping, made_from: str
    ) -> PreparedFrame:
        described = encode.describe(content, self.name, self.source)
        self._claim(described)
        self._mine.add(number)
        clamped = encode.write_images(content, self.root, self.name, number, attributes)
        record = frame_record(number, content.frames, content.native, made_from)
        return PreparedFrame(number, described, plain({**record, "notes": {**notes, "clamped": clamped}}))

    def finish(self) -> SequenceInfo:
        """Mark the sequence as complete: from now on it can be read."""
        if self.info is None:
            raise ValueError(f"{self.folder}: expected at least one frame before finish().")
        if not self.info.complete or self.info.skipped != tuple(self.skipped.values()):
            self.info = dataclasses.replace(self.info, complete=True)
            self.save()
        return self.info


def write_sequence(
    root: str | os.PathLike, name: str, sequence: Sequence, *, first: int = 0, source: Mapping[str, Any] | None = None
) -> SequenceInfo:
    """Write a whole sequence, leaves ``[T, H, W, C]``; ``write_dataset`` then makes a dataset of it.

    Called again it goes on where it was interrupted, and changes nothing where the sequence is there already.

    Args:
      root: the dataset's folder.
      name: of the sequence.
      sequence: without a batch axis.
      first: number of its first frame.
      source: where it comes from.

    Raises:
      ValueError: invalid content, or a sequence with other frames or of another source is there.
    """
    if sequence.frames.motion.ndim != 4:
        raise ValueError(
            f"sequence {name}: expected leaves [T, H, W, C] without a batch axis, got motion "
            f"{tuple(sequence.frames.motion.shape)}. Write the sequences of a batch one by one."
        )
    writer = SequenceWriter(root, name, source=source)
    sequence = jax.tree.map(np.asarray, sequence)
    length = sequence.frames.motion.shape[0]
    others = [number for number in (writer.info.numbers if writer.info else ()) if not first <= number < first + length]
    if others:
        raise ValueError(
            f"{writer.folder}: holds frame {others[0]}, which is not among the frames {first}..{first + length - 1} to "
            "write. Choose another name or output folder, or delete this one."
        )
    for index in range(length):
        writer.write(first + index, select_time(sequence, index))
    return writer.finish()
