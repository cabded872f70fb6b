"""Ways to break a clip that is right, each with the fix that a user has to be told."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from essjax.frames import Sequence

VISIBLE, PIXELS = 0.25, 100
"""Pixels by which motion must change, and in how many pixels of the clip, for a picture to show it."""
NEAR = 0.1


class Corruption(NamedTuple):
    """A way to break a sequence.

    Attributes:
      apply: ``sequence -> sequence``, leaves ``[T, H, W, C]``.
      fixes: parts of fixes that undo it; one of them must be told, and nothing else.
      visible: whether ``(good, broken)`` differ in anything that data could show.
    """

    apply: Callable[[Sequence], Sequence]
    fixes: tuple[str, ...]
    visible: Callable[[Sequence, Sequence], bool]


def _frames(sequence: Sequence, **changes) -> Sequence:
    return dataclasses.replace(sequence, frames=dataclasses.replace(sequence.frames, **changes))


def _buffers(sequence: Sequence, **changes) -> Sequence:
    return _frames(sequence, gbuffers=dataclasses.replace(sequence.frames.gbuffers, **changes))


def _motion_moves(good: Sequence, broken: Sequence) -> bool:
    change = np.linalg.norm(good.frames.motion[1:] - broken.frames.motion[1:], axis=-1)
    return int((change > VISIBLE).sum()) >= PIXELS


def _differs(good: Sequence, broken: Sequence) -> bool:
    return True


def _motion(x: float, y: float, *fixes: str) -> Corruption:
    scale = np.array([x, y], np.float32)
    return Corruption(lambda s: _frames(s, motion=s.frames.motion * scale), fixes, _motion_moves)


def _ndc(sequence: Sequence) -> Sequence:
    height, width = sequence.frames.motion.shape[1:3]
    return _frames(sequence, motion=sequence.frames.motion / np.array([width / 2, -height / 2], np.float32))


def _jitter(scale: float, *fixes: str) -> Corruption:
    return Corruption(lambda s: _frames(s, jitter=s.frames.jitter * np.float32(scale)), fixes, _differs)


def _reversed_as_forward(sequence: Sequence) -> Sequence:
    """Decode a reversed infinite depth, d = near / z, as if it were forward, z = near / (1 - d)."""
    stored = NEAR / sequence.frames.gbuffers.depth
    return _buffers(sequence, depth=(NEAR / np.maximum(1 - stored, 1e-6)).astype(np.float32))


def _unit(vectors: np.ndarray, there: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(there, vectors / np.maximum(length, 1e-6), 0).astype(np.float32)


def _normals(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Sequence], Sequence]:
    def apply(sequence: Sequence) -> Sequence:
        normal = sequence.frames.gbuffers.normal
        return _buffers(sequence, normal=_unit(change(normal), (normal != 0).any(axis=-1, keepdims=True)))

    return apply


def _still_object(sequence: Sequence) -> Sequence:
    """Take the motion from the largest object that moves."""
    ids = sequence.frames.gbuffers.stencil
    lengths = np.linalg.norm(sequence.frames.motion, axis=-1, keepdims=True)
    moved = {i: float(lengths[1:][ids[1:] == i].sum()) for i in np.unique(ids[ids > 0])}
    chosen = max(moved, key=lambda i: moved[i], default=0)
    return _frames(sequence, motion=np.where((ids == chosen) & (ids > 0), 0, sequence.frames.motion).astype(np.float32))


def _still_sky(sequence: Sequence) -> Sequence:
    sky = np.isinf(sequence.frames.gbuffers.depth)
    return _frames(sequence, motion=np.where(sky, 0, sequence.frames.motion).astype(np.float32))


CORRUPTIONS = {
    "x flipped": _motion(-1, 1, "motion.X has the wrong sign"),
    "y flipped": _motion(1, -1, "motion.Y has the wrong sign"),
    "both flipped": _motion(-1, -1, "motion points the wrong way"),
    "times 2": _motion(2, 2, "multiply it by 0.5", "in pixels of the reference"),
    "times 1/2": _motion(0.5, 0.5, "multiply it by 2 "),
    "NDC": Corruption(_ndc, ("motion is in NDC",), _motion_moves),
    "jitter negated": _jitter(-1, "jitter has the wrong sign"),
    "jitter halved": _jitter(0.5, "jitter is too short"),
    "jitter absent": _jitter(0, "the frames are jittered"),
    "depth reversed": Corruption(_reversed_as_forward, ("depth is reversed",), _differs),
    "normals signed, read as unsigned": Corruption(
        _normals(lambda n: 2 * n - 1), ("normals are in [-1, 1]",), _differs
    ),
    "normals unsigned, read as signed": Corruption(
        _normals(lambda n: (n + 1) / 2), ("normals are encoded in [0, 1]",), _differs
    ),
    "one object still": Corruption(_still_object, ("has no motion of its own",), _motion_moves),
    "sky still": Corruption(_still_sky, ("nobody wrote the motion of the background",), _motion_moves),
}  # fmt: skip
"""Name -> corruption."""
