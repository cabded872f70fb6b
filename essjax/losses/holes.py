"""Means over part of an image, and the losses that look at disoccluded or at the worst pixels only."""

import jax
import jax.numpy as jnp

from essjax.losses.pixel import l1
from essjax.typing import Array, Color, Image, Mask


def masked_mean(values: Image, mask: Mask, *, axis: int | tuple[int, ...] | None = None) -> Array:
    """Mean of ``values`` weighted by ``mask``; 0, with a zero gradient, where the mask is empty.

    Values under a zero mask are not read: they may be inf or NaN. Sums and mean are float32.

    Args:
      values: ``[..., H, W, C]``.
      mask: >= 0, broadcasts against ``values``; ``[..., H, W, 1]`` weighs all channels alike.
      axis: axes to reduce; all if None.
    """
    mask = jnp.broadcast_to(mask, values.shape).astype(jnp.float32)
    # The inner select keeps inf and NaN out of the product, whose gradient would spread them.
    total = jnp.sum(jnp.where(mask > 0, values.astype(jnp.float32), 0.0) * mask, axis=axis)
    weight = jnp.sum(mask, axis=axis)
    return jnp.where(weight > 0, total / jnp.where(weight > 0, weight, 1.0), 0.0)


def occlusion(prediction: Color, target: Color, hole: Mask) -> Color:
    """``hole * |prediction - target|``, ``[..., H, W, 3]``: the numerator of ExtraSS eq 11, ExtraNet eq 5, FASSET eq 3.

    ``masked_mean(occlusion(...), hole)`` divides by the hole's size as those do (and by the number of channels, so
    that it is on the scale of the mean L1 next to it), and is 0 where nothing was disoccluded.

    Args:
      prediction: ``[..., H, W, 3]``.
      target: the same shape.
      hole: ``[..., H, W, 1]``, 1 on *disoccluded* pixels, that is ``1 - valid``, at the images' resolution.

    Raises:
      ValueError: the images' shapes differ.
    """
    return hole * l1(prediction, target)


def hardest(errors: Image, *, share: float = 0.1) -> Mask:
    """Which pixels of each image have the largest errors: the set of ExtraNet eq 6 and FASSET eq 4, as weights.

    ``masked_mean(errors, hardest(errors))`` is ExtraNet's shading-augmented loss; FASSET divides by all pixels instead:
    ``jnp.mean(errors * hardest(errors))``. Our reading: a pixel's error is the mean over its channels, and every image
    of a batch has a set of its own. Pixels that tie for the last places share them.

    Args:
      errors: >= 0, ``[..., H, W, C]``, for example ``l1(prediction, target)``.
      share: k over the number of pixels; k is at least 1.

    Returns:
      ``[..., H, W, 1]`` in [0, 1], no gradient; 1 on the k worst pixels, and k in sum over each image.

    Raises:
      ValueError: ``share`` is not in (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: expected a number in (0, 1], got {share}.")
    error = jax.lax.stop_gradient(jnp.mean(errors, axis=-1))
    flat = error.reshape(*error.shape[:-2], -1)
    count = max(round(share * flat.shape[-1]), 1)
    # A threshold instead of indices: the gradient of a gather is a scatter.
    threshold = jax.lax.top_k(flat, count)[0][..., -1:]
    above, ties = flat > threshold, flat == threshold
    left = count - jnp.sum(above, axis=-1, keepdims=True)
    weights = jnp.where(above, 1.0, jnp.where(ties, left / jnp.sum(ties, axis=-1, keepdims=True), 0.0))
    return weights.reshape(error.shape)[..., None].astype(errors.dtype)
