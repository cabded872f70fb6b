"""Structural similarity (Wang et al. 2004), pixel by pixel: 1 - SSIM is NSRR's loss, its mean a metric."""

import functools

import jax.numpy as jnp
import numpy as np

from essjax.losses.pixel import as_float32
from essjax.typing import Image, Resized


def _gaussian_window(window: int, sigma: float) -> np.ndarray:
    weights = np.exp(-0.5 * ((np.arange(window) - window // 2) / sigma) ** 2)
    return weights / weights.sum()


def _blur(image: Image, weights: np.ndarray) -> Resized:
    """Separable filter where the window fits: ``[..., H - window + 1, W - window + 1, C]``.

    Shifted sums: a depthwise convolution is slower on CPU, a banded matrix product less exact on accelerators.
    """
    height, width = (size - len(weights) + 1 for size in image.shape[-3:-1])
    rows = [float(weight) * image[..., dy : dy + height, :, :] for dy, weight in enumerate(weights)]
    image = functools.reduce(jnp.add, rows)
    columns = [float(weight) * image[..., dx : dx + width, :] for dx, weight in enumerate(weights)]
    return functools.reduce(jnp.add, columns)


def ssim_map(
    prediction: Image, target: Image, *, window: int = 11, sigma: float = 1.5, c1: float = 0.01**2, c2: float = 0.03**2
) -> Resized:
    """SSIM of every pixel and channel whose window fits, ``[..., H - window + 1, W - window + 1, C]``.

    Args:
      prediction: ``[..., H, W, C]`` display-referred in [0, 1].
      target: the same shape.
      window: odd size of the Gaussian window, pixels.
      sigma: its standard deviation, pixels.
      c1: stabiliser of the means (data range 1).
      c2: stabiliser of the variances; 0.03^2 as Wang et al., 0.02^2 in DLCTUS' tables.

    Raises:
      ValueError: the shapes differ, an image holds integers or is smaller than the window, or the window is even.
    """
    prediction, target = as_float32(prediction, target)
    if window % 2 == 0 or min(prediction.shape[-3:-1]) < window:
        raise ValueError(
            f"ssim: expected an odd window no larger than the image, got window {window} for "
            f"{prediction.shape[-2]}x{prediction.shape[-3]} pixels."
        )
    channels = prediction.shape[-1]
    products = [prediction, target, prediction**2 + target**2, prediction * target]
    moments = _blur(jnp.concatenate(products, axis=-1), _gaussian_window(window, sigma))
    mean_p, mean_t, squares, cross = (moments[..., k * channels : (k + 1) * channels] for k in range(4))
    variances = squares - mean_p**2 - mean_t**2  # of both images together: the formula needs no more
    covariance = cross - mean_p * mean_t
    luminance = (2.0 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
    return luminance * (2.0 * covariance + c2) / (variances + c2)
