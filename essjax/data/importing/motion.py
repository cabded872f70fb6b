"""The motion of one frame of a dump: decoded, converted, and taken from the cameras where nobody wrote any."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from essjax.cameras import Camera, pixel_positions, static_motion
from essjax.data.importing import convert
from essjax.data.importing.facts import FrameFacts
from essjax.data.importing.rules import MotionRule
from essjax.typing import Jitter, Motion, Plane

NOTHING = 1e-5
"""Stored values this close to ``zero`` say that nothing moves: half a step of 16 bits."""
MOVES = 0.25
"""Pixels: surfaces that move less say nothing about a background that does not move."""


@jax.jit
def camera_motion(camera: Camera, previous: Camera, jitter: Jitter, depth: Plane) -> Motion:
    """Motion of a static world, at the jittered samples."""
    height, width = depth.shape[:2]
    return static_motion(camera, previous, pixel_positions(height, width, jitter), depth)


class Moved(NamedTuple):
    """Motion in essjax's convention.

    Attributes:
      motion: ``[H, W, 2]``.
      unwritten: pixels that take it from the cameras.
      still: background pixels that hold none although surfaces move, and that no camera helps.
    """

    motion: np.ndarray
    unwritten: int
    still: int


def frame_motion(
    stored: np.ndarray,
    mask: np.ndarray | None,
    rule: MotionRule,
    facts: FrameFacts,
    jitter: np.ndarray,
    previous_jitter: np.ndarray | None,
    depth: np.ndarray,
    path: Path,
) -> Moved:
    """Convert the motion of a frame.

    Args:
      stored: ``[s*H, s*W, 2]``, unpacked.
      mask: ``[H, W, 1]``, above 0.5 where motion was written; or None.
      rule: of the recipe.
      facts: of the frame.
      jitter: ``[2]`` pixels.
      previous_jitter: of the frame before; None: a cut.
      depth: ``[H, W, 1]`` metres, background +inf.
      path: of the file, for messages.

    Raises:
      ValueError: the encoding is another one, or motion is missing where only cameras could say it, and there are none.
    """
    (height, width), own = depth.shape[:2], stored.shape[:2]
    stored = convert.at_samples(stored, width, height, jitter)
    written = np.ones((height, width, 1), bool)
    if rule.encoding != "plain":
        stored, written = convert.decode_velocity(stored, rule.encoding)
    stored = stored - np.float32(rule.zero)
    background = ~np.isfinite(depth)
    nothing = (np.abs(stored) <= NOTHING).all(axis=-1, keepdims=True)
    if mask is not None:
        written = written & (mask > 0.5)
    if rule.unwritten == "zero":
        written = written & ~nothing
    elif rule.unwritten == "background":
        written = written & ~background
    pixels = convert.to_pixels(stored * np.float32(rule.scale), rule.unit, width, height, x=rule.x, y=rule.y)
    if rule.unit == "pixels":
        of_width, of_height = rule.resolution or (own[1], own[0])
        pixels = pixels * np.asarray([width / of_width, height / of_height], np.float32)
    motion = convert.to_previous(pixels, rule.sign)
    if rule.jittered and previous_jitter is not None:
        motion = convert.without_jitter(motion, jitter, previous_jitter)
    cameras = facts.camera is not None and facts.previous is not None
    still = background & nothing & written
    if not still.any() or still.sum() < background.sum() or previous_jitter is None:
        still = np.zeros_like(still)
    elif cameras:
        written, still = written & ~still, np.zeros_like(still)
    elif not _moves(motion, ~background):
        still = np.zeros_like(still)
    unwritten = int((~written).sum())
    if not unwritten or previous_jitter is None:
        return Moved(np.where(written, motion, 0.0).astype(np.float32), unwritten, int(still.sum()))
    if not cameras:
        raise ValueError(
            f"{path}: {unwritten} pixels have no velocity: there the motion follows from the cameras, which the file's "
            "header does not hold. Let the engine write velocity for everything, or give the cameras ([files] "
            "metadata)."
        )
    static = np.asarray(camera_motion(facts.camera, facts.previous, jitter, depth))
    return Moved(np.where(written, motion, static), unwritten, int(still.sum()))


def _moves(motion: np.ndarray, where: np.ndarray) -> bool:
    lengths = np.linalg.norm(motion, axis=-1)[where[..., 0]]
    return bool(lengths.size and np.median(lengths) > MOVES)
