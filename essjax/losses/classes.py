"""Cross-entropy of one class per pixel, and weights for classes of unequal size."""

import jax
import jax.numpy as jnp

from essjax.typing import Array, Image, Int, Mask, Plane


def cross_entropy(logits: Image, classes: Int[Array, "... h w 1"]) -> Plane:
    """``-log softmax(logits)[class]``, ``[..., H, W, 1]``, in float32; NaN where the class is outside 0 ... K-1.

    Args:
      logits: ``[..., H, W, K]``.
      classes: ``[..., H, W, 1]`` in 0 ... K-1; hide others by the mask of ``masked_mean``.

    Raises:
      ValueError: the sizes differ.
    """
    if logits.shape[:-1] != classes.shape[:-1] or classes.shape[-1] != 1:
        raise ValueError(
            f"cross_entropy: expected classes {(*logits.shape[:-1], 1)} for logits {tuple(logits.shape)}, "
            f"got {tuple(classes.shape)}."
        )
    chosen = jax.nn.one_hot(classes[..., 0], logits.shape[-1], dtype=jnp.float32)  # no gather: its gradient is slow
    loss = -jnp.sum(chosen * jax.nn.log_softmax(logits.astype(jnp.float32)), axis=-1, keepdims=True)
    return jnp.where((classes >= 0) & (classes < logits.shape[-1]), loss, jnp.nan)


def class_weights(
    classes: Int[Array, "... h w 1"], count: int, mask: Mask, *, balance: float = 0.5, smallest: float = 1e-3
) -> Plane:
    """Weight of every pixel, ``mask / share^balance`` of its class's share of the mask, scaled to sum up like the mask.

    Args:
      classes: ``[..., H, W, 1]`` in 0 ... ``count`` - 1; others weigh 0.
      count: number of classes.
      mask: ``[..., H, W, 1]``, 1 where a pixel counts.
      balance: 0 weighs pixels alike, 1 classes alike.
      smallest: share that a rare class counts with at least.
    """
    chosen = jax.nn.one_hot(classes[..., 0], count, dtype=jnp.float32) * mask
    total = jnp.maximum(jnp.sum(mask), 1.0)
    share = jnp.sum(chosen, axis=tuple(range(chosen.ndim - 1))) / total
    weight = jnp.maximum(share, smallest) ** -balance
    weight = weight / jnp.maximum(jnp.sum(share * weight), 1e-6)
    return jnp.sum(chosen * weight, axis=-1, keepdims=True)
