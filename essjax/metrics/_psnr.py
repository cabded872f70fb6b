"""Peak signal-to-noise ratio."""

import jax.numpy as jnp

from essjax.losses import masked_mean
from essjax.losses.pixel import as_float32
from essjax.typing import Image, Mask, Scalar

PIXEL_AXES = (-3, -2, -1)
MAX_PSNR = 100.0
"""The score of equal images, so that means stay finite."""


def psnr(prediction: Image, target: Image, *, mask: Mask | None = None) -> Scalar:
    """PSNR of each image in dB, data range 1: ``-10 log10(mean squared error)``, at most ``MAX_PSNR``.

    The mean runs over pixels and channels. A mean PSNR, wherever this project prints one, is the mean of the frames'
    PSNRs, not the PSNR of the mean error.

    Args:
      prediction: ``[..., H, W, C]`` display-referred in [0, 1] (``essjax.color.display``); computed in float32.
      target: the same shape.
      mask: ``[..., H, W, 1]``, 1 where to look; all pixels if None.

    Returns:
      ``[...]``; NaN where the mask is empty: there is nothing to score.

    Raises:
      ValueError: the shapes differ, or an image holds integers.
    """
    prediction, target = as_float32(prediction, target)
    squared = (prediction - target) ** 2
    if mask is None:
        error = jnp.mean(squared, axis=PIXEL_AXES)
    else:
        error = masked_mean(squared, mask, axis=PIXEL_AXES)
        error = jnp.where(jnp.sum(mask, axis=PIXEL_AXES) > 0, error, jnp.nan)
    return -10.0 * jnp.log10(jnp.maximum(error, 10.0 ** (-MAX_PSNR / 10.0)))
