"""``Sequence``s to a dataset folder, frame by frame."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import OpenEXR

from essjax.cameras import Camera
from essjax.data import exr
from essjax.data.layout import (
    AGREE,
    KINDS,
    SUFFIXES,
    SequenceInfo,
    frame_path,
    read_sequence_info,
    split_planes,
    write_sequence_info,
)
from essjax.frames import (
    RANGE_CHANNELS,
    Frame,
    SampleRanges,
    Sequence,
    frame_images,
    select_time,
    validate_frame,
    validate_ranges,
)

FAST = {"compression": OpenEXR.RLE_COMPRESSION}
"""For imports, which ZIP would dominate: lossless in a third of its time, for a quarter more disk (path-traced)."""


def _plain(content: Any) -> Any:
    """As JSON gives it back: tuples become lists."""
    return json.loads(json.dumps(content))


def _camera_record(camera: Camera | None) -> dict | None:
    if camera is None:
        return None
    return {field.name: np.asarray(getattr(camera, field.name)).tolist() for field in dataclasses.fields(camera)}


def _frame_record(number: int, frame: Frame, native: Frame | None) -> dict:
    record = {
        "number": number,
        "jitter": np.asarray(frame.jitter).tolist(),
        "cut": bool(frame.cut),
        "exposure": float(frame.exposure),
        "camera": _camera_record(frame.camera),
    }
    if native is not None:
        record |= {
            "native_jitter": np.asarray(native.jitter).tolist(),
            "native_camera": _camera_record(native.camera),
        }
    return record


def _planes(images: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {
        key: plane for name, image in images.items() for key, plane in split_planes(name, np.asarray(image)).items()
    }


class _Extra(NamedTuple):
    """What a frame may have beside its images and its reference."""

    masks: Mapping[str, Any] = {}
    native: Frame | None = None
    ranges: SampleRanges | None = None


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
    an unfinished sequence again resumes it; ``number in writer`` says which frames are there.
    """

    def __init__(self, root: str | os.PathLike, name: str, *, source: Mapping[str, Any] | None = None):
        """Open or resume.

        Args:
          root: the dataset's folder.
          name: of the sequence, and of its folder.
          source: what makes these frames (settings, seeds); JSON types.

        Raises:
          ValueError: the name is not a folder name, or the sequence there was made from another source.
        """
        if not name or name != Path(name).name or name.startswith("."):
            raise ValueError(f"sequence name: expected a plain folder name, got {name!r}.")
        self.root, self.name, self.source = Path(root), name, _plain(dict(source or {}))
        self.info: SequenceInfo | None = None
        if (self.root / name / "sequence.json").is_file():
            self.info = read_sequence_info(root, name)
            self._check_source(self.info.source)

    def _check_source(self, found: Mapping[str, Any]) -> None:
        keys = [key for key in {**self.source, **found} if self.source.get(key) != found.get(key)]
        if keys:
            pairs = "; ".join(f"{key}: asked {self.source.get(key)!r}, found {found.get(key)!r}" for key in keys)
            raise ValueError(
                f"{self.root / self.name}: holds frames made with other settings ({pairs}). "
                "Choose another output folder, or delete this one."
            )

    def __contains__(self, number: int) -> bool:
        return self.info is not None and number in self.info.numbers

    @property
    def complete(self) -> bool:
        """Whether the sequence is finished."""
        return self.info is not None and self.info.complete

    def _describe(self, frame: Frame, reference: Any, extra: _Extra) -> SequenceInfo:
        height, width = frame.motion.shape[-3:-1]
        scale = reference.shape[0] // height
        if reference.shape != (scale * height, scale * width, 3) or scale < 1:
            raise ValueError(
                f"sequence {self.name}, reference: expected [s*{height}, s*{width}, 3] with a whole s, "
                f"got {tuple(reference.shape)}."
            )
        native, ranges = extra.native, extra.ranges
        if native is not None and native.motion.shape != (*reference.shape[:2], 2):
            raise ValueError(
                f"sequence {self.name}, native frames: expected the reference's size {reference.shape[:2]}, "
                f"got {tuple(native.motion.shape[:2])}."
            )
        present = {**frame_images(frame), **extra.masks}
        channels = tuple(name for name in SUFFIXES if name in present)
        return SequenceInfo(
            self.name, width, height, scale, channels, native is not None, self.source, ranges=ranges is not None
        )

    def _check_next(self, number: int, described: SequenceInfo, cut: bool) -> SequenceInfo:
        info = self.info or described
        for field in AGREE:
            if getattr(info, field) != getattr(described, field):
                raise ValueError(
                    f"sequence {self.name}, frame {number}: {field} changes from {getattr(info, field)} to "
                    f"{getattr(described, field)}; all frames of a sequence must agree."
                )
        if info.frames and number != info.numbers[-1] + 1 and not (cut and number > info.numbers[-1]):
            raise ValueError(
                f"sequence {self.name}: expected frame {info.numbers[-1] + 1} next, got {number}. Motion links each "
                "frame to the one before; after a gap the frame must be a cut."
            )
        return info

    def write(
        self,
        number: int,
        frame: Frame,
        reference: Any,
        *,
        valid: Any = None,
        steady: Any = None,
        native: Frame | None = None,
        ranges: SampleRanges | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        """Write one frame; nothing happens if it is already complete.

        Args:
          number: original frame number; consecutive, unless the frame is a cut.
          frame: leaves ``[H, W, C]``, with colour.
          reference: ``[s*H, s*W, 3]``.
          valid: ``[H, W, 1]`` or None.
          steady: ``[H, W, 1]`` or None.
          native: leaves ``[s*H, s*W, C]`` or None.
          ranges: leaves ``[s*H, s*W, C]`` or None.
          notes: numbers about this frame to keep in its record; ``clamped``, the count of values beyond half's range
            that were clamped, is added.

        Raises:
          ValueError: invalid content, or it does not fit to the frames before; names sequence, frame and channel.
        """
        if number in self:
            return
        masks = {name: mask for name, mask in (("valid", valid), ("steady", steady)) if mask is not None}
        extra = _Extra(masks, native, ranges)
        frame, reference, extra = jax.tree.map(np.asarray, (frame, reference, extra))
        self._validate(number, frame, reference, extra)
        self._check_next(number, self._describe(frame, reference, extra), bool(frame.cut))
        self.commit(self._write_images(number, frame, reference, extra, notes or {}, {}))

    def prepare(
        self, number: int, frame: Frame, reference: Any, *, notes: Mapping[str, Any] | None = None
    ) -> PreparedFrame:
        """The first half of ``write``: check a frame and write its images. Threads may prepare frames side by side.

        Raises:
          ValueError: invalid content.
        """
        frame, reference = jax.tree.map(np.asarray, (frame, reference))
        self._validate(number, frame, reference, _Extra())
        return self._write_images(number, frame, reference, _Extra(), notes or {}, FAST)

    def commit(self, prepared: PreparedFrame, *, cut: bool = False, save: bool = True) -> None:
        """The second half of ``write``: list a prepared frame; one thread, in the order of the frames.

        Args:
          prepared: from ``prepare``.
          cut: the frame is a cut, whatever it says itself: the frame before it was left out.
          save: write ``sequence.json`` now. It grows with the frames, so a long import saves only now and then.

        Raises:
          ValueError: it does not fit to the frames before. Its images are removed.
        """
        cut = cut or prepared.record["cut"]
        try:
            info = self._check_next(prepared.number, prepared.described, cut)
        except ValueError:
            self.discard(prepared.number)
            raise
        self.info = dataclasses.replace(info, frames=(*info.frames, {**prepared.record, "cut": cut}))
        if save:
            self.save()

    def save(self) -> None:
        """Write ``sequence.json``, if there is a frame."""
        if self.info is not None:
            write_sequence_info(self.root, self.info)

    def discard(self, number: int) -> None:
        """Remove the images of a frame that is not listed."""
        for kind in KINDS:
            self._path(kind, number).unlink(missing_ok=True)

    def _validate(self, number: int, frame: Frame, reference: np.ndarray, extra: _Extra) -> None:
        where = f"sequence {self.name}, frame {number}"
        validate_frame(frame, where, ("color",))
        if extra.native is not None:
            validate_frame(extra.native, f"{where}, native", ("color",))
        if extra.ranges is not None:
            validate_ranges(extra.ranges, reference.shape[0], reference.shape[1], f"{where}, ranges")
        if not (np.isfinite(reference).all() and reference.min() >= 0):
            raise ValueError(f"{where}, reference: expected finite radiance >= 0, got {reference.min()}. Clamp it.")

    def _write_images(
        self,
        number: int,
        frame: Frame,
        reference: np.ndarray,
        extra: _Extra,
        notes: Mapping,
        attributes: Mapping,
    ) -> PreparedFrame:
        described = self._describe(frame, reference, extra)
        (self.root / self.name).mkdir(parents=True, exist_ok=True)
        files = {
            "lr": _planes({**frame_images(frame), **extra.masks}),
            "hr": {name: reference[..., i] for i, name in enumerate("RGB")},
        }
        if extra.native is not None:
            files["native"] = _planes(frame_images(extra.native))
        if extra.ranges is not None:
            files["ranges"] = _planes({name: getattr(extra.ranges, name) for name in RANGE_CHANNELS})
        clamped = sum(
            exr.write(self._path(kind, number), planes, attributes=attributes) for kind, planes in files.items()
        )
        record = _plain({**_frame_record(number, frame, extra.native), "notes": {**notes, "clamped": clamped}})
        return PreparedFrame(number, described, record)

    def _path(self, kind: str, number: int) -> Path:
        return frame_path(self.root, self.name, kind, number)

    def finish(self) -> SequenceInfo:
        """Mark the sequence as complete: from now on it can be read."""
        if self.info is None:
            raise ValueError(f"{self.root / self.name}: expected at least one frame before finish().")
        if not self.info.complete:
            self.info = dataclasses.replace(self.info, complete=True)
            self.save()
        return self.info


def write_sequence(
    root: str | os.PathLike, name: str, sequence: Sequence, *, first: int = 0, source: Mapping[str, Any] | None = None
) -> SequenceInfo:
    """Write a whole sequence, leaves ``[T, H, W, C]``; ``write_dataset`` then makes a dataset of it.

    Args:
      root: the dataset's folder.
      name: of the sequence.
      sequence: without a batch axis.
      first: number of its first frame.
      source: where it comes from.
    """
    if sequence.frames.motion.ndim != 4:
        raise ValueError(
            f"sequence {name}: expected leaves [T, H, W, C] without a batch axis, got motion "
            f"{tuple(sequence.frames.motion.shape)}. Write the sequences of a batch one by one."
        )
    writer = SequenceWriter(root, name, source=source)
    sequence = jax.tree.map(np.asarray, sequence)
    for index in range(sequence.frames.motion.shape[0]):
        at: Sequence = select_time(sequence, index)
        extra = {name: getattr(at, name) for name in ("valid", "steady", "native", "ranges")}
        writer.write(first + index, at.frames, at.reference, **extra)
    return writer.finish()
