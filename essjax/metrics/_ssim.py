"""Structural similarity (Wang et al. 2004) of whole images; the map it averages is ``losses.ssim_map``."""

import jax.numpy as jnp

from essjax.losses import masked_mean, ssim_map
from essjax.metrics._psnr import PIXEL_AXES
from essjax.typing import Image, Mask, Scalar


def ssim(
    prediction: Image,
    target: Image,
    *,
    mask: Mask | None = None,
    window: int = 11,
    sigma: float = 1.5,
    c1: float = 0.01**2,
    c2: float = 0.03**2,
) -> Scalar:
    """Mean SSIM of each image, ``[...]`` in [-1, 1]: per channel, then averaged, over windows inside the image.

    Equals scikit-image's with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1``.

    Args:
      prediction: see ``ssim_map``.
      target: see ``ssim_map``.
      mask: ``[..., H, W, 1]``, 1 on the window centres that count; all if None. NaN where it is empty.
      window: see ``ssim_map``.
      sigma: see ``ssim_map``.
      c1: see ``ssim_map``.
      c2: see ``ssim_map``.

    Raises:
      ValueError: see ``ssim_map``.
    """
    values = ssim_map(prediction, target, window=window, sigma=sigma, c1=c1, c2=c2)
    if mask is None:
        return jnp.mean(values, axis=PIXEL_AXES)
    radius = window // 2
    centers = mask[..., radius : mask.shape[-3] - radius, radius : mask.shape[-2] - radius, :]
    mean = masked_mean(values, centers, axis=PIXEL_AXES)
    return jnp.where(jnp.sum(centers, axis=PIXEL_AXES) > 0, mean, jnp.nan)
