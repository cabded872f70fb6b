"""Census distances: compare how neighbours relate to their centre, not brightness itself.

Meister et al. 2018 (UnFlow), in the soft form that IFRNet trains with: the difference d of a neighbour to its centre
becomes the soft sign ``d / sqrt(0.81 + d^2)``, and two soft signs that differ by D cost ``D^2 / (0.1 + D^2)``.
"""

import jax.numpy as jnp

from essjax.losses.pixel import as_float32
from essjax.typing import Array, Color, Image, Plane

GREY = (0.2989, 0.5870, 0.1140)
"""Rec. 601 luma, IFRNet's grey."""


def _grey(color: Color) -> Plane:
    red, green, blue = (weight * color[..., c : c + 1] for c, weight in enumerate(GREY))
    return red + green + blue  # not a matrix product: some accelerators would round it


def _soft_sign(difference: Array) -> Array:
    return difference / jnp.sqrt(0.81 + difference**2)


def _neighbour_signs(image: Image, window: int) -> Array:
    """Soft signs of all neighbours against their centre, ``[..., h, w, window^2, C]``, where the window fits."""
    radius, channels = window // 2, image.shape[-1]
    height, width = image.shape[-3] - 2 * radius, image.shape[-2] - 2 * radius
    # Columns, then rows: 2 * window slices, because XLA needs 10 s to differentiate window^2 of them.
    columns = jnp.concatenate([image[..., dx : dx + width, :] for dx in range(window)], axis=-1)
    patches = jnp.concatenate([columns[..., dy : dy + height, :, :] for dy in range(window)], axis=-1)
    center = image[..., radius : radius + height, radius : radius + width, :]
    return _soft_sign(patches.reshape(*center.shape[:-1], window**2, channels) - center[..., None, :])


def _census_distance(first: Image, second: Image, window: int) -> Plane:
    """Mean soft census cost over window and channels, ``[..., H, W, 1]``; 0 where the window leaves the image."""
    height, width = first.shape[-3:-1]
    if window < 3 or window % 2 == 0:
        raise ValueError(f"window: expected an odd size >= 3, got {window}.")
    if min(height, width) < window:
        raise ValueError(
            f"census: expected images of at least {window}x{window} pixels (the window), got {width}x{height}. "
            "Use a larger crop or a smaller window."
        )
    squared = (_neighbour_signs(first, window) - _neighbour_signs(second, window)) ** 2
    cost = jnp.mean(squared / (0.1 + squared), axis=(-2, -1))[..., None]
    border = (window // 2, window // 2)
    return jnp.pad(cost, [(0, 0)] * (cost.ndim - 3) + [border, border, (0, 0)])


def census(prediction: Color, target: Color, *, window: int = 7) -> Plane:
    """Census distance of two images' grey, ``[..., H, W, 1]`` in [0, 1): L_cen of ExtraSS eq 7.

    The border of ``window // 2`` pixels is 0 and counts in a plain mean, as in IFRNet.

    Args:
      prediction: ``[..., H, W, 3]`` (or one channel), on the scale that the loss works on (log(1 + x)).
      target: the same shape.
      window: odd size of the neighbourhood, pixels.

    Raises:
      ValueError: the shapes differ, the window is even, or the image is smaller than the window.
    """
    prediction, target = as_float32(prediction, target)
    if prediction.shape[-1] == 3:
        prediction, target = _grey(prediction), _grey(target)
    elif prediction.shape[-1] != 1:
        raise ValueError(
            f"census: expected 3 or 1 channels, got {prediction.shape[-1]}. Use feature_census for feature maps."
        )
    return _census_distance(prediction, target, window)


def feature_census(prediction: Image, target: Image, *, window: int = 3) -> Plane:
    """Census distance of two feature maps, the mean over their channels, ``[..., h, w, 1]``: one term of ExtraSS eq 8.

    IFRNet's feature space geometry loss. Its window is small because features already see a neighbourhood.

    Args:
      prediction: ``[..., h, w, C]`` features of the predicted frame.
      target: the same features of the ground truth; stop their gradient where they are a target only.
      window: odd size of the neighbourhood, feature pixels.

    Raises:
      ValueError: the shapes differ, the window is even, or the map is smaller than the window.
    """
    prediction, target = as_float32(prediction, target)
    return _census_distance(prediction, target, window)
