"""Fill holes of an image from its valid pixels, smoothly, without a network."""

import jax.numpy as jnp

from essjax.typing import Array, Image, Mask
from essjax.warp._batch import check_channels
from essjax.warp.upsample import jitter_aligned_upsample, space_to_depth

_SMALL = 1e-6


def _block_sums(image: Array) -> Array:
    """Sum over blocks of 2x2; odd sizes are padded with zeros."""
    height, width, channels = image.shape[-3:]
    padded = jnp.pad(image, [(0, 0)] * (image.ndim - 3) + [(0, height % 2), (0, width % 2), (0, 0)])
    folded = space_to_depth(padded, 2)
    return folded.reshape(*folded.shape[:-1], 4, channels).sum(axis=-2)


def _pull_push(mean: Array, weight: Array) -> Array:
    """``mean`` where ``weight`` is 1, what surrounds it where that is 0, a blend between."""
    height, width = weight.shape[-3:-1]
    if max(height, width) == 1:
        return mean
    total = _block_sums(weight)
    coarse = _block_sums(weight * mean) / jnp.maximum(total, _SMALL)
    coarse = _pull_push(coarse, jnp.minimum(total, 1.0))  # one valid pixel of four is as good as four
    size = 2 * coarse.shape[-3], 2 * coarse.shape[-2]
    fine = jitter_aligned_upsample(coarse, size, jnp.zeros(2, jnp.float32))[..., :height, :width, :]
    return weight * mean + (1.0 - weight) * fine


def fill_holes(image: Image, mask: Mask) -> Image:
    """Pull-push (Gortler et al. 1996, section 3.3): holes become smooth averages of the valid pixels around them.

    Pixels with mask 1 stay; what is under mask 0 is not read, it may be NaN. Values in holes lie between the smallest
    and the largest valid value, or 0. Without any valid pixel the result is 0.

    Args:
      image: ``[..., H, W, C]``.
      mask: ``[..., H, W, 1]`` in [0, 1]: 1 valid, 0 hole; between, the share that is kept.

    Raises:
      ValueError: sizes differ.
    """
    check_channels("image", image, None)
    check_channels("mask", mask, 1, image.shape[-3:-1])
    return _pull_push(jnp.where(mask > 0, image, 0.0), mask)
