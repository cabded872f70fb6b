"""One frame of a sequence to its EXR files: what is refused, what it looks like, what is written.

A frame is a ``Sequence`` without its time axis, leaves ``[H, W, C]``, NumPy arrays.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.buffers import RANGES
from essjax.data import exr
from essjax.data.layout import SUFFIXES, SequenceInfo, frame_path
from essjax.data.records import planes_of
from essjax.frames import Sequence, frame_images, validate_frame, validate_ranges


def validate(content: Sequence, where: str) -> None:
    """Refuse what must not be written.

    Args:
      content: of a frame.
      where: the beginning of the message.

    Raises:
      ValueError: a buffer has the wrong shape, or a value is none.
    """
    reference = np.asarray(content.reference)
    validate_frame(content.frames, where, ("color",))
    if content.native is not None:
        validate_frame(content.native, f"{where}, native", ("color",))
    if content.ranges is not None:
        validate_ranges(content.ranges, reference.shape[0], reference.shape[1], f"{where}, ranges")
    bad = ~(np.isfinite(reference) & (reference >= 0))
    if bad.any():
        raise ValueError(
            f"{where}, reference: expected finite radiance >= 0, got {reference[bad][0]}. "
            f"{int(bad.sum())} of {bad.size} values are negative, infinite or NaN: clean the frame or clamp them."
        )


def describe(content: Sequence, name: str, source: Mapping[str, Any]) -> SequenceInfo:
    """Describe what a sequence of such frames looks like.

    Raises:
      ValueError: reference or native frame have the wrong size.
    """
    shape = content.reference.shape
    height, width = content.frames.motion.shape[-3:-1]
    if len(shape) != 3 or shape[0] < height or shape[1] < width or shape[2] != 3:
        raise ValueError(
            f"sequence {name}, reference: expected [H, W, 3], at least {height} and {width} as the frames, "
            f"got {tuple(shape)}."
        )
    native = content.native
    if native is not None and native.motion.shape != (*shape[:2], 2):
        raise ValueError(
            f"sequence {name}, native frames: expected the reference's size {shape[:2]}, "
            f"got {tuple(native.motion.shape[:2])}."
        )
    present = _images(content)
    channels = tuple(suffix for suffix in SUFFIXES if suffix in present)
    ranges = content.ranges is not None
    return SequenceInfo(name, width, height, content.scale, channels, native is not None, source, ranges=ranges)


def _images(content: Sequence) -> dict[str, Any]:
    """Collect the LR images of a frame, by name."""
    masks = {name: getattr(content, name) for name in ("valid", "steady")}
    return {**frame_images(content.frames), **{name: mask for name, mask in masks.items() if mask is not None}}


def write_images(content: Sequence, root: Path, name: str, number: int, attributes: Mapping[str, Any]) -> int:
    """Write the files of frame ``number`` of sequence ``name``; returns how many values half could not hold.

    Args:
      content: that ``validate`` accepts.
      root: the dataset's folder.
      name: of the sequence.
      number: of the frame.
      attributes: of the EXR files, such as their compression.

    Raises:
      ValueError: a file cannot be written.
    """
    files = {
        "lr": planes_of(_images(content)),
        "hr": {channel: content.reference[..., i] for i, channel in enumerate("RGB")},
    }
    if content.native is not None:
        files["native"] = planes_of(frame_images(content.native))
    if content.ranges is not None:
        files["ranges"] = planes_of({each: getattr(content.ranges, each) for each in RANGES})
    return sum(
        exr.write(frame_path(root, name, kind, number), planes, attributes=attributes) for kind, planes in files.items()
    )
