"""Automatic labels of ghosting and aliasing pixels, from the ranges over all samples of a pixel (Guo et al. 2022).

"Classifier Guided Temporal Supersampling for Real-time Rendering", supplementary section 2; equation numbers are its.
D is its reversed depth, 1 / depth, 0 on the background: larger is closer. W leads along the motion of a pixel's nearest
sample, the one that D_max belongs to; what is read there is read nearest.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.color import expose, reinhard
from essjax.frames import SampleRanges
from essjax.interfaces import expand_flag
from essjax.typing import Array, Bool, Flag, Image, Int, Plane, Scalar, pytree
from essjax.warp import backward_warp, inside_mask

GHOSTING = ("visibility", "shading", "none")
"""Names of the ghosting classes, in the order of their logits."""
ALIASING = ("geometry", "texture", "none")
"""Names of the aliasing classes, in the order of their logits."""
QUANTUM = 1.0 / 256.0
"""By how much a colour box is widened, so that one of a flat pixel has a volume; of x / (1 + x)."""

Marks = Bool[Array, "... h w 1"]
Classes = Int[Array, "... h w 1"]


class Thresholds(NamedTuple):
    """Above which differences a pixel is labelled. T_I^G and T_IoU are not in the paper (docs/deviations.md).

    Attributes:
      ghosting_depth: T_D^G, relative to the closer depth.
      ghosting_velocity: T_V^G, squared pixels of the labelled resolution.
      ghosting_color: T_I^G, of x / (1 + x).
      ghosting_overlap: T_IoU, below which boxes of x / (1 + x) colour count as different.
      aliasing_depth: T_D^A, relative.
      aliasing_normal: T_N^A, L1.
      aliasing_color: T_I^A, relative to the largest radiance.
      opening: side of the square that shading ghosting is opened with, pixels.
    """

    ghosting_depth: float = 0.01
    ghosting_velocity: float = 1.0
    ghosting_color: float = 0.05
    ghosting_overlap: float = 0.2
    aliasing_depth: float = 0.01
    aliasing_normal: float = 0.5
    aliasing_color: float = 0.5
    opening: int = 5

    @classmethod
    def of_height(cls, height: int) -> "Thresholds":
        """Scale the paper's, which we take to be of 1080 rows, to images of ``height`` rows (docs/deviations.md).

        From pixel to pixel a plane's depth changes the more the fewer there are: with the same T_D^A all of a floor
        would be an edge (34 % of the pixels of 136 rows, 10 % with this one). A shadow's edge moves by fewer pixels.
        """
        return cls(
            aliasing_depth=cls().aliasing_depth * 1080.0 / height, opening=min(max(round(5 * height / 1080), 2), 5)
        )


DEFAULTS = Thresholds()


@pytree
class Labels:
    """One class per pixel and question.

    Attributes:
      ghosting: ``[..., H, W, 1]`` index into ``GHOSTING``: may history be used?
      aliasing: ``[..., H, W, 1]`` index into ``ALIASING``: how many samples does the pixel need?
    """

    ghosting: Classes
    aliasing: Classes


def _closeness(depth: Plane) -> Plane:
    """Compute the paper's D: 1 / depth, 0 on the background."""
    return jnp.where(jnp.isfinite(depth), 1.0 / depth, 0.0)


def _neighbours(image: Image, outside) -> list[Image]:
    """Return the images whose pixel (y, x) is one of the neighbours of (y, x); ``outside`` where there is none."""
    height, width = image.shape[-3:-1]
    padded = jnp.pad(image, [(0, 0)] * (image.ndim - 3) + [(1, 1), (1, 1), (0, 0)], constant_values=outside)
    offsets = [(dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)]
    return [padded[..., dy : dy + height, dx : dx + width, :] for dy, dx in offsets]


def _windows(marks: Marks, size: int, axis: int) -> Marks:
    """``size`` copies shifted along ``axis``, stacked in front; the axis shrinks by ``size - 1``."""
    length = marks.shape[axis] - size + 1
    return jnp.stack([jax.lax.slice_in_dim(marks, k, k + length, axis=axis) for k in range(size)])


def opening(marks: Marks, *, size: int = 5) -> Marks:
    """Erosion, then dilation with a square: what is left is the union of all ``size`` x ``size`` squares of marks.

    Squares may stick out of the image. 5 is our reading of "opening twice" (3 x 3): eroded twice, then dilated twice;
    one opening after another would change nothing.
    """
    margin = [(size - 1, size - 1)] * 2 + [(0, 0)]
    marks = jnp.pad(marks, [(0, 0)] * (marks.ndim - 3) + margin, constant_values=True)
    for combine in (jnp.all, jnp.any):
        for axis in (-3, -2):
            marks = combine(_windows(marks, size, axis), axis=0)
    return marks


def _unlike(closeness: Plane, velocity: Array, other_closeness: Plane, other_velocity: Array, at: Thresholds) -> Marks:
    """Whether a pixel is closer than another by T_D^G and moves otherwise by T_V^G (eq 3 and 4)."""
    closer = closeness - other_closeness > at.ghosting_depth * closeness  # multiplied out: 0 on the background
    moves = jnp.sum((velocity - other_velocity) ** 2, axis=-1, keepdims=True) > at.ghosting_velocity
    return closer & moves


def visibility_ghosting(ranges: SampleRanges, previous: SampleRanges, *, at: Thresholds = DEFAULTS) -> Marks:
    """Pixels whose history shows a closer surface that moves otherwise (eq 1 and 2), or is off screen.

    Then dilated by a pixel onto neighbours that are farther and move otherwise (eq 3 and 4).

    Args:
      ranges: of this frame, leaves ``[..., H, W, C]``.
      previous: of the frame before.
      at: thresholds.
    """
    closeness, velocity = _closeness(ranges.depth_min), ranges.motion
    there = jnp.concatenate([_closeness(previous.depth_min), previous.motion], axis=-1)
    there = backward_warp(there, ranges.motion, mode="nearest")
    marks = _unlike(there[..., :1], there[..., 1:], closeness, velocity, at)  # eq 1, 2: history is closer
    around = zip(
        _neighbours(marks, False), _neighbours(closeness, 0.0), _neighbours(velocity, 0.0), strict=True
    )  # outside nothing is marked
    spread = marks
    for marked, other_closeness, other_velocity in around:
        spread |= marked & _unlike(other_closeness, other_velocity, closeness, velocity, at)
    return spread | (inside_mask(ranges.motion) == 0)


def color_overlap(low: Image, high: Image, other_low: Image, other_high: Image) -> Plane:
    """Intersection over union ``[..., H, W, 1]`` of two colour boxes, each widened by ``QUANTUM`` (eq 6)."""

    def volume(low: Image, high: Image) -> Plane:
        return jnp.prod(jnp.maximum(high - low + QUANTUM, 0.0), axis=-1, keepdims=True)

    common = volume(jnp.maximum(low, other_low), jnp.minimum(high, other_high))
    return common / (volume(low, high) + volume(other_low, other_high) - common)


def shading_ghosting(
    ranges: SampleRanges, previous: SampleRanges, *, at: Thresholds = DEFAULTS, exposure: Scalar | float = 1.0
) -> Marks:
    """Pixels whose colour changed along the motion (|eq 5| in any channel, and eq 6), opened, not yet corrected.

    Our reading: colours after x / (1 + x), so that one threshold serves dark and bright places.

    Args:
      ranges: of this frame, leaves ``[..., H, W, C]``.
      previous: of the frame before.
      at: thresholds.
      exposure: ``[...]`` of this frame; both are compared at it.
    """
    low, high, *before = (
        reinhard(expose(colors, jnp.asarray(exposure)))
        for colors in (ranges.color_min, ranges.color_max, previous.color_min, previous.color_max)
    )
    there = jnp.concatenate(before, axis=-1)
    there = backward_warp(there, ranges.motion, mode="nearest")
    other_low, other_high = there[..., :3], there[..., 3:]
    changed = jnp.max(jnp.abs(high - other_high), axis=-1, keepdims=True) > at.ghosting_color
    different = color_overlap(low, high, other_low, other_high) < at.ghosting_overlap
    return opening(changed & different, size=at.opening)


def geometry_aliasing(ranges: SampleRanges, *, at: Thresholds = DEFAULTS) -> Marks:
    """Pixels that hold a depth or normal edge, bump detail left out: A_G (eq 7 or 8)."""
    closest, farthest = _closeness(ranges.depth_min), _closeness(ranges.depth_max)
    return (closest - farthest > at.aliasing_depth * closest) | (ranges.normal_spread_smooth > at.aliasing_normal)


def texture_aliasing(ranges: SampleRanges, *, at: Thresholds = DEFAULTS) -> Marks:
    """Pixels that hold other detail: A_T, all of eq 7, 8 (with bumps) or 9 without A_G."""
    bumps = ranges.normal_spread > at.aliasing_normal
    difference = ranges.color_max - ranges.color_min
    varied = jnp.any(difference > at.aliasing_color * ranges.color_max, axis=-1, keepdims=True)
    return (bumps | varied) & ~geometry_aliasing(ranges, at=at)


def label(
    ranges: SampleRanges,
    previous: SampleRanges,
    cut: Flag,
    *,
    at: Thresholds = DEFAULTS,
    exposure: Scalar | float = 1.0,
) -> Labels:
    """Both classes of every pixel of one frame.

    Shading ghosting is removed where visibility ghosting or aliasing is set. Where ``cut``, everything is visibility
    ghosting: the engine knows it.

    Args:
      ranges: of this frame, leaves ``[..., H, W, C]``.
      previous: of the frame before.
      cut: bool ``[...]``.
      at: thresholds.
      exposure: see ``shading_ghosting``.
    """
    visibility = visibility_ghosting(ranges, previous, at=at) | expand_flag(cut, ranges.motion.ndim)
    geometry, texture = geometry_aliasing(ranges, at=at), texture_aliasing(ranges, at=at)
    shading = shading_ghosting(ranges, previous, at=at, exposure=exposure) & ~(visibility | geometry | texture)
    return Labels(ghosting=_first(visibility, shading), aliasing=_first(geometry, texture))


def _first(*marks: Marks) -> Classes:
    """Index of the first mark that is set, else their number."""
    index = jnp.full(marks[0].shape, len(marks), jnp.int32)
    for k, mark in reversed(list(enumerate(marks))):
        index = jnp.where(mark, k, index)
    return index


def label_sequence(
    ranges: SampleRanges, cut: Flag, *, at: Thresholds = DEFAULTS, exposure: Scalar | float = 1.0
) -> Labels:
    """``label`` of every frame of a sequence, frame 0 a cut.

    Leaves ``[T, ..., H, W, C]``, ``cut`` and ``exposure`` ``[T, ...]``.
    """
    previous = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf[:-1]]), ranges)
    return label(ranges, previous, jnp.asarray(cut).at[0].set(True), at=at, exposure=exposure)
