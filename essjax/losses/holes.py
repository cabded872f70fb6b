"""Means over part of an image, and the loss that looks at disoccluded pixels only."""

import jax.numpy as jnp

from essjax.losses.pixel import l1
from essjax.typing import Array, Color, Image, Mask


def masked_mean(values: Image, mask: Mask, *, axis: int | tuple[int, ...] | None = None) -> Array:
    """Mean of ``values`` weighted by ``mask``; 0, with a zero gradient, where the mask is empty.

    Values under a zero mask are not read: they may be inf or NaN.

    Args:
      values: ``[..., H, W, C]``.
      mask: >= 0, broadcasts against ``values``; ``[..., H, W, 1]`` weighs all channels alike.
      axis: axes to reduce; all if None.
    """
    mask = jnp.broadcast_to(mask, values.shape)
    # The inner select keeps inf and NaN out of the product, whose gradient would spread them.
    total = jnp.sum(jnp.where(mask > 0, values, 0.0) * mask, axis=axis)
    weight = jnp.sum(mask, axis=axis)
    return jnp.where(weight > 0, total / jnp.where(weight > 0, weight, 1.0), 0.0)


def occlusion(prediction: Color, target: Color, hole: Mask) -> Color:
    """``hole * |prediction - target|``, ``[..., H, W, 3]``: the numerator of ExtraSS eq 11.

    ``masked_mean(occlusion(...), hole)`` divides by the hole's size as eq 11 does (and by the number of channels, so
    that it is on the scale of the mean L1 next to it), and is 0 where nothing was disoccluded.

    Args:
      prediction: ``[..., H, W, 3]``.
      target: the same shape.
      hole: ``[..., H, W, 1]``, 1 on *disoccluded* pixels, that is ``1 - valid``, at the images' resolution.

    Raises:
      ValueError: the images' shapes differ.
    """
    return hole * l1(prediction, target)
