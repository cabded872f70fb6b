"""The grid of half an output's size, whatever the input's, and what it shows of low-resolution frames.

Its pixels are the 2 x 2 blocks of output pixels; an odd output is padded by one. Where the output is twice the input,
the two grids are one.
"""

import jax.numpy as jnp

from essjax.sizes import Size, check_size, ratios
from essjax.typing import Array, Image, Jitter, Places, Resized
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.upsample import check_jitter


def half_size(size: Size) -> Size:
    """(height, width) of the half grid of an output of ``size``."""
    height, width = check_size(size)
    return -(-height // 2), -(-width // 2)


def _nearest(low: int, output: int, jitter: Array) -> Array:
    """Index of the LR sample next to the centre of each half-grid pixel of an axis."""
    centre = 2.0 * jnp.arange(-(-output // 2), dtype=jnp.float32) + 1.0
    return jnp.clip(jnp.floor(centre / (output / low) - jitter), 0, low - 1).astype(jnp.int32)


def _is_half(low: Size, size: Size) -> bool:
    return size == (2 * low[0], 2 * low[1])


def to_half_grid(image: Image, size: Size, jitter: Jitter) -> Resized:
    """Show the nearest sample in each pixel of the half grid of an output of ``size``.

    Args:
      image: ``[..., H, W, C]`` sampled at pixel centres + jitter.
      size: (height, width) of the output.
      jitter: ``[..., 2]`` (x, y) LR pixels.

    Returns:
      ``[..., *half_size(size), C]``; the image itself where the output is twice as large.
    """
    check_channels("image", image, None)
    low, size, jitter = image.shape[-3:-1], check_size(size), check_jitter(jitter)
    if _is_half(low, size):
        return image

    def one(image: Array, jitter: Array) -> Array:
        rows, columns = (_nearest(low[axis], size[axis], jitter[1 - axis]) for axis in (0, 1))
        return jnp.take(jnp.take(image, rows, axis=0, mode="clip"), columns, axis=1, mode="clip")

    return over_leading_axes(one, (3, 1), image, jitter)


def half_grid_offset(low: Size, size: Size, jitter: Jitter) -> Places:
    """How far that sample lies from its half-grid pixel's centre, in half-grid pixels: the jitter at twice the size.

    Args:
      low: (height, width) of the input.
      size: of the output.
      jitter: ``[..., 2]`` (x, y) LR pixels.

    Returns:
      ``[..., *half_size(size), 2]``.
    """
    jitter, half = check_jitter(jitter), half_size(size)
    if _is_half(low, check_size(size)):
        return jnp.broadcast_to(jitter[..., None, None, :], (*jitter.shape[:-1], *half, 2))

    def along(axis: int, jitter: Array) -> Array:
        ratio = ratios(low, size)[1 - axis]
        sample = _nearest(low[axis], size[axis], jitter) + 0.5 + jitter
        return 0.5 * ratio * sample - (jnp.arange(half[axis], dtype=jnp.float32) + 0.5)

    def one(jitter: Array) -> Array:
        x, y = along(1, jitter[0]), along(0, jitter[1])
        return jnp.stack([jnp.broadcast_to(x, half), jnp.broadcast_to(y[:, None], half)], axis=-1)

    return over_leading_axes(one, (1,), jitter)
