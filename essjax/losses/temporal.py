"""Losses that tie a frame to the one before it, or its two encodings to each other."""

from collections.abc import Sequence

import jax.numpy as jnp

from essjax.losses.pixel import as_float32, l1
from essjax.typing import Array, Color, Image, Level, Mask


def temporal_l1(image: Color, warped_previous: Color, valid: Mask) -> Color:
    """Compute ``valid * |image - warped_previous|``, ``[..., H, W, 3]``: the first term of ExtraSS eq 13.

    Our reading: masked, because where the warped history shows another surface an unmasked term rewards ghosting.
    Reduce it with ``masked_mean(..., valid)``.

    Args:
      image: this frame's output.
      warped_previous: the previous output at this frame's positions.
      valid: ``[..., H, W, 1]``, 1 where the warp found the same surface.

    Raises:
      ValueError: the images' shapes differ.
    """
    image, warped_previous = as_float32(image, warped_previous, ("image", "warped_previous"))
    return jnp.where(valid > 0, valid * jnp.abs(image - warped_previous), 0.0)


def spatio_temporal(error: Image, error_previous: Image, *, theta: float) -> Image:
    """``|x| + |y| + theta (|x - y| - |x| - |y|)``, ``[..., H, W, C]``: the summand of DLCTUS' loss (thesis 002 eq 54).

    The mean is eq 55. With ``theta`` 0 it is the L1 of two frames, with 1 it only asks that the error stays the same.

    Args:
      error: x, prediction minus target.
      error_previous: y, the same of the previous frame, warped to this one.
      theta: share of the temporal term, in [0, 1].

    Raises:
      ValueError: the shapes differ, or ``theta`` is outside [0, 1].
    """
    error, error_previous = as_float32(error, error_previous, ("error", "error_previous"))
    if not 0.0 <= theta <= 1.0:
        raise ValueError(f"theta: expected a share in [0, 1], got {theta}.")
    return (1.0 - theta) * (jnp.abs(error) + jnp.abs(error_previous)) + theta * jnp.abs(error - error_previous)


def feature_l1(features_a: Sequence[Level], features_b: Sequence[Level]) -> list[Level]:
    """Absolute differences level by level: l_1 of ExtraSS eq 13, between both encoders' features of one frame.

    Args:
      features_a: one map ``[..., h, w, C]`` per level; sizes may differ between levels.
      features_b: as many maps of the same shapes.

    Returns:
      One unreduced map per level; ``sum_of_means`` gives the sum over k.

    Raises:
      ValueError: another number of levels, or shapes that differ.
    """
    if len(features_a) != len(features_b):
        raise ValueError(
            f"feature_l1: expected as many levels on both sides, got {len(features_a)} and {len(features_b)}."
        )
    return [l1(a, b) for a, b in zip(features_a, features_b, strict=True)]


def sum_of_means(levels: Sequence[Level]) -> Array:
    """Mean of every level, summed: the sum over k in ExtraSS eq 8 and 13. Returns a scalar; 0 without levels."""
    return sum((jnp.mean(level) for level in levels), start=jnp.zeros((), jnp.float32))
