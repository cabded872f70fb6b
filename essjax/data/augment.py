"""Crops and flips of NumPy sequences that keep every convention: images, motion, jitter, normals, cameras, masks."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

from essjax.buffers import BUFFERS, OPTIONAL_GBUFFERS, RANGES
from essjax.cameras import Camera
from essjax.frames import Frame, SampleRanges, Sequence, frame_images, frame_size, gbuffers_of

_AXES = {"horizontal": 0, "vertical": 1}
_MIRRORED = {name: buffer.channels for name, buffer in BUFFERS.items() if buffer.directed}
"""Images whose component along the flipped axis changes sign, with their number of components."""


def _map_images(frame: Frame, transform: Callable[[str, np.ndarray], np.ndarray]) -> Frame:
    images = {name: transform(name, np.asarray(image)) for name, image in frame_images(frame).items()}
    return dataclasses.replace(
        frame,
        color=images.get("color"),
        gbuffers=gbuffers_of(images),
        motion=images["motion"],
        reactive=images.get("reactive"),
    )


def _window(image: Any, top: int, left: int, height: int, width: int) -> Any:
    return image[..., top : top + height, left : left + width, :]


def _stays_inside(frame: Frame) -> np.ndarray:
    """1 where the previous position lies within the frame."""
    height, width = frame.motion.shape[-3:-1]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    previous = np.stack([x, y], axis=-1) + np.asarray(frame.jitter)[..., None, None, :] + frame.motion
    inside = (previous >= 0) & (previous <= np.asarray([width, height]))
    return np.asarray(inside.all(axis=-1, keepdims=True), np.float32)


def start_with_cut(sequence: Sequence) -> Sequence:
    """Let the sequence begin as if nothing came before: frame 0 is a cut, and a hole unless it already was a cut.

    Args:
      sequence: NumPy leaves ``[T, ..., H, W, C]``; not changed.
    """
    cut = np.array(sequence.frames.cut)
    was_cut, valid = cut[0].copy(), sequence.valid
    cut[0] = True
    if valid is not None:
        valid = np.array(valid)
        valid[0] *= was_cut[..., None, None, None]
    native = sequence.native
    if native is not None:
        native = dataclasses.replace(native, cut=cut)
    return dataclasses.replace(
        sequence, frames=dataclasses.replace(sequence.frames, cut=cut), valid=valid, native=native
    )


def crop_images(sequence: Sequence, top: int, left: int, height: int, width: int) -> Sequence:
    """Do the first half of ``crop``: only the images, as views; for ``crop_origin`` to finish.

    Args:
      sequence: NumPy leaves ``[H, W, C]``, or with a time axis; native frames are dropped.
      top: first row, LR pixels.
      left: first column, LR pixels.
      height: LR pixels.
      width: LR pixels.

    Raises:
      ValueError: the reference's part is no whole number of pixels.
    """
    (down, across), (high, wide) = frame_size(sequence.frames), sequence.size

    def small(image: Any) -> Any:
        return _window(image, top, left, height, width)

    if any(side * wide % across for side in (left, width)) or any(side * high % down for side in (top, height)):
        raise ValueError(
            f"crop: {width}x{height} at ({left}, {top}) of frames of {across}x{down} is no whole number of pixels of a "
            f"reference of {wide}x{high}. Crop at multiples of the ratio's denominators."
        )

    def enlarged(image: Any) -> Any:
        return _window(image, top * high // down, left * wide // across, height * high // down, width * wide // across)

    return Sequence(
        frames=_map_images(sequence.frames, lambda _, image: small(image)),
        reference=enlarged(sequence.reference),
        valid=None if sequence.valid is None else small(sequence.valid),
        steady=None if sequence.steady is None else small(sequence.steady),
        ranges=None if sequence.ranges is None else jax.tree.map(enlarged, sequence.ranges),
    )


def crop_origin(sequence: Sequence, top: int, left: int) -> Sequence:
    """Do the second half of ``crop``: principal point and ``valid`` of the images that ``crop_images`` cut out."""
    frames, valid = sequence.frames, sequence.valid
    if frames.camera is not None:
        center = frames.camera.center - np.asarray([left, top], np.float32)
        frames = dataclasses.replace(frames, camera=dataclasses.replace(frames.camera, center=center))
    valid = None if valid is None else valid * _stays_inside(frames)
    return dataclasses.replace(sequence, frames=frames, valid=valid)


def crop(sequence: Sequence, top: int, left: int, height: int, width: int) -> Sequence:
    """Cut a window out of all frames, the matching one out of reference and ranges; native frames are dropped.

    The principal point moves with the window; pixels whose previous position leaves the window become holes in
    ``valid``.

    Args:
      sequence: NumPy leaves ``[T, ..., H, W, C]``.
      top: first row, LR pixels.
      left: first column, LR pixels.
      height: LR pixels.
      width: LR pixels.

    Raises:
      ValueError: the window does not fit, or the reference's part is no whole number of pixels.
    """
    rows, columns = sequence.frames.motion.shape[-3:-1]
    if not (0 <= top <= rows - height and 0 <= left <= columns - width and height > 0 and width > 0):
        raise ValueError(f"crop: {width}x{height} at ({left}, {top}) does not fit into frames of {columns}x{rows}.")
    return crop_origin(crop_images(sequence, top, left, height, width), top, left)


def _flip_camera(camera: Camera, component: int, size: int) -> Camera:
    mirror = np.ones(4, np.float32)
    mirror[component] = -1.0
    center = np.array(camera.center, np.float32)
    center[..., component] = size - center[..., component]
    return Camera(
        camera_to_world=mirror[:, None] * np.asarray(camera.camera_to_world) * mirror,
        focal=camera.focal,
        center=center,
    )


def _flip_frame(frame: Frame, component: int) -> Frame:
    sign = np.ones(2, np.float32)
    sign[component] = -1
    size = frame.motion.shape[-2 if component == 0 else -3]
    return dataclasses.replace(
        _map_images(frame, lambda name, image: _mirror(name, image, component)),
        jitter=frame.jitter * sign,
        camera=None if frame.camera is None else _flip_camera(frame.camera, component, size),
    )


def _flip_ranges(ranges: SampleRanges, component: int) -> SampleRanges:
    images = {name: np.asarray(getattr(ranges, name)) for name in RANGES}
    return SampleRanges(**{name: _mirror(name, image, component) for name, image in images.items()})


def _mirror(name: str, image: np.ndarray, component: int) -> np.ndarray:
    """Flip an image, and the sign of that component where it is a vector."""
    flipped = np.flip(image, -2 if component == 0 else -3)
    if name not in _MIRRORED:
        return flipped
    sign = np.ones(_MIRRORED[name], image.dtype)
    sign[component] = -1
    return flipped * sign


def flip(sequence: Sequence, direction: str) -> Sequence:
    """Mirror the images left to right ("horizontal") or top to bottom ("vertical"), and the world with them.

    The world is mirrored in x (or y) and so is camera space: ``camera_to_world' = M C M``, a proper rotation again,
    so positions still project to their pixels. Motion, jitter, normals and positions change sign along that axis.
    A jitter of -0.5 becomes +0.5.

    Args:
      sequence: NumPy leaves ``[T, ..., H, W, C]``.
      direction: "horizontal" or "vertical".

    Raises:
      ValueError: another direction.
    """
    if direction not in _AXES:
        raise ValueError(f"direction: expected horizontal or vertical, got {direction!r}.")
    component = _AXES[direction]
    axis = -2 if component == 0 else -3
    masks = {name: getattr(sequence, name) for name in ("valid", "steady")}
    return Sequence(
        frames=_flip_frame(sequence.frames, component),
        reference=np.flip(sequence.reference, axis),
        native=None if sequence.native is None else _flip_frame(sequence.native, component),
        ranges=None if sequence.ranges is None else _flip_ranges(sequence.ranges, component),
        **{name: None if mask is None else np.flip(mask, axis) for name, mask in masks.items()},
    )


def without_buffers(frame: Frame, names: Iterable[str]) -> Frame:
    """Remove optional G-buffers and the reactive mask by name: the frame as an engine without them would give it.

    Raises:
      ValueError: an unknown name, or one that every frame must have.
    """
    names, optional = list(names), (*OPTIONAL_GBUFFERS, "reactive")
    unknown = [name for name in names if name not in optional]
    if unknown:
        raise ValueError(f"without_buffers: expected some of {', '.join(optional)}, got {', '.join(unknown)}.")
    gbuffers = dataclasses.replace(frame.gbuffers, **{name: None for name in names if name != "reactive"})
    return dataclasses.replace(frame, gbuffers=gbuffers, **({"reactive": None} if "reactive" in names else {}))
