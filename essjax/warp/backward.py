"""Backward warp: what the previous frame showed at this pixel."""

import math

import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.typing import Image, Motion
from essjax.warp._batch import check_channels
from essjax.warp.sampling import check_mode, sample


def backward_warp(image: Image, motion: Motion, *, mode: str = "bilinear", outside: str = "border") -> Image:
    """Read ``image`` (of the previous frame) at pixel + ``motion``.

    For low-resolution frames that carry jitter, pass ``jittered_motion``; for unjittered history the motion itself.
    Motion that comes from the renderer needs no gradient; do not ask for one where it is not used, it is slow.

    Args:
      image: ``[..., H, W, C]``.
      motion: ``[..., H, W, 2]`` (x right, y down) pixels, current to previous.
      mode: see ``sample``.
      outside: see ``sample``.

    Returns:
      ``[..., H, W, C]``.

    Raises:
      ValueError: unknown mode or outside, or sizes that differ.
    """
    check_channels("image", image, None)
    check_channels("motion", motion, 2, image.shape[-3:-1])
    check_mode(mode, outside)
    leading = jnp.broadcast_shapes(image.shape[:-3], motion.shape[:-3])
    if math.prod((*leading, *image.shape[-3:])) == 0:  # an empty batch, or no channel
        exact = mode == "nearest" or jnp.issubdtype(image.dtype, jnp.floating)
        return jnp.zeros((*leading, *image.shape[-3:]), image.dtype if exact else jnp.float32)
    positions = pixel_positions(motion.shape[-3], motion.shape[-2]) + motion
    return sample(image, positions, mode=mode, outside=outside)
