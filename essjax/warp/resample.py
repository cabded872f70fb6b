"""A low-resolution frame resampled to the output grid, with what temporal accumulation must know of its samples."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.sizes import Size, check_size
from essjax.typing import Array, Guide, Image, Jitter, Mask
from essjax.warp._batch import check_channels
from essjax.warp.sampling import gather_pixels
from essjax.warp.upsample import check_jitter, zero_upsample


class Resampled(NamedTuple):
    """A low-resolution frame seen from the output grid.

    Attributes:
      color: ``[..., sH, sW, C]`` weighted mean of the nearest samples (eq 38).
      weight: ``[..., sH, sW, 1]`` β: the largest unnormalised weight (eq 42), or 1 where a sample is in the pixel.
      low: ``[..., sH, sW, C]`` smallest of those samples, per channel of the clamp's colour space.
      high: the largest.
      average: their unweighted mean.
    """

    color: Array
    weight: Mask
    low: Array
    high: Array
    average: Array


def _nearest_three(size: int, output: int, jitter: Array) -> tuple[Array, Array, Array]:
    """Find the LR samples next to each output pixel on one axis, ``[3, output]`` indices, the nearest first.

    Returns:
      The indices, which may lie one outside; the distance to them in output pixels; whether they are inside.
    """
    ratio = output / size
    position = (jnp.arange(output, dtype=jnp.float32) + 0.5) / ratio
    nearest = jnp.clip(jnp.floor(position - jitter), 0, size - 1)
    index = nearest[None] + jnp.array([[0.0], [-1.0], [1.0]], jnp.float32)
    distance = (index + 0.5 + jitter - position) * ratio
    return index, distance, (index >= 0) & (index < size)


def _gaussian_axis(size: int, output: int, jitter: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Return indices, normalised weights, and the logarithm of the largest weight before normalisation."""
    index, distance, inside = _nearest_three(size, output, jitter)
    log_weight = jnp.where(inside, -0.5 * (distance / sigma) ** 2, -jnp.inf)
    return index, jax.nn.softmax(log_weight, axis=0), log_weight[0]


def _tent_axis(size: int, output: int, jitter: Array) -> tuple[Array, Array, Array]:
    """Return indices and normalised weights (0 where no sample is within a pixel); no logarithm is needed."""
    index, distance, inside = _nearest_three(size, output, jitter)
    weight = jnp.where(inside, jnp.maximum(1.0 - jnp.abs(distance), 0.0), 0.0)
    total = weight.sum(axis=0)
    return index, weight / jnp.where(total > 0, total, 1.0), jnp.zeros_like(total)


def _at(image: Array, rows: Array, columns: Array) -> Array:
    """``[len(rows), len(columns), C]``: what a grid of pixels shows. One flat gather: one along columns transposes."""
    index = rows[:, None] * image.shape[1] + columns
    return gather_pixels(image.reshape(-1, image.shape[-1]), index)


def _of_three(image: Array, axis: int, merge: Callable) -> Array:
    """``merge`` of each pixel and its two neighbours along ``axis``, borders repeated."""
    padded = jnp.pad(image, [(int(k == axis),) * 2 for k in range(image.ndim)], mode="edge")
    return merge([jax.lax.slice_in_dim(padded, k, k + image.shape[axis], axis=axis) for k in range(3)])


_MERGES: tuple[Callable, ...] = (
    lambda three: functools.reduce(jnp.minimum, three),
    lambda three: functools.reduce(jnp.maximum, three),
    lambda three: sum(three) / 3.0,
)


def _resample_one(color: Array, bounded: Array, jitter: Array, output: Size, axis: Callable) -> Resampled:
    height, width = color.shape[:2]
    columns, column_weight, column_log = axis(width, output[1], jitter[0])
    rows, row_weight, row_log = axis(height, output[0], jitter[1])
    columns = jnp.clip(columns, 0, width - 1).astype(jnp.int32)
    rows = jnp.clip(rows, 0, height - 1).astype(jnp.int32)
    # Barriers: fused into what reads it three times, each stage would be computed three times for every pixel.
    columns, column_weight, rows, row_weight = jax.lax.optimization_barrier((columns, column_weight, rows, row_weight))
    weight = jax.lax.optimization_barrier(jnp.exp(row_log))[:, None, None] * jnp.exp(column_log)[:, None]
    # The kernel of a grid is a product: rows first, then columns.
    tall = sum(_at(color, rows[k], jnp.arange(width)) * row_weight[k][:, None, None] for k in range(3))
    tall = jnp.asarray(jax.lax.optimization_barrier(tall))
    every_row = jnp.arange(tall.shape[0])
    mean = sum(_at(tall, every_row, columns[k]) * column_weight[k][:, None] for k in range(3))
    # The nine samples around an output pixel are those around its nearest one: found at low resolution.
    boxes = jax.lax.optimization_barrier([_of_three(_of_three(bounded, 0, merge), 1, merge) for merge in _MERGES])
    low, high, average = (_at(box, rows[0], columns[0]) for box in boxes)
    return Resampled(jnp.asarray(mean), weight, low, high, average)


def _resample(color: Image, bounded: Image, jitter: Jitter, size: Size, axis: Callable) -> Resampled:
    check_channels("color", color, None)
    check_channels("bounded", bounded, None, color.shape[-3:-1])
    size, jitter = check_size(size), check_jitter(jitter)
    leading = jnp.broadcast_shapes(color.shape[:-3], bounded.shape[:-3], jitter.shape[:-1])
    flat = [
        jnp.broadcast_to(x, (*leading, *core)).reshape(math.prod(leading), *core)
        for x, core in ((color, color.shape[-3:]), (bounded, bounded.shape[-3:]), (jitter, (2,)))
    ]
    results = jax.vmap(lambda c, b, j: _resample_one(c, b, j, size, axis))(*flat)
    return jax.tree.map(lambda x: x.reshape(*leading, *x.shape[1:]), results)


def gaussian_resample(color: Image, bounded: Guide, jitter: Jitter, sigma: Array, size: Size) -> Resampled:
    """Resample LR samples to the output grid with a Gaussian over the 3 x 3 nearest (thesis 002 eq 38, 41, 42).

    Args:
      color: ``[..., H, W, C]``, sampled at pixel centres + ``jitter``.
      bounded: ``[..., H, W, C]``, the colour in the space whose minimum and maximum are wanted.
      jitter: ``[..., 2]`` LR pixels.
      sigma: standard deviation in *output* pixels (our reading: eq 40 measures distance in them), a scalar array.
      size: (height, width) of the output.

    Raises:
      ValueError: wrong shapes.
    """
    return _resample(color, bounded, jitter, size, lambda *axis: _gaussian_axis(*axis, sigma))


def tent_resample(color: Image, bounded: Guide, jitter: Jitter, size: Size) -> Resampled:
    """Resample with a tent of one output pixel (eq 38, 40); β is 1 in the pixel that a sample fell into, else 0.

    The colour is 0 where no sample is within a pixel, as is β there. Arguments and errors as ``gaussian_resample``; the
    size must be the image's or larger.
    """
    resampled = _resample(color, bounded, jitter, size, _tent_axis)
    return resampled._replace(weight=zero_upsample(jnp.ones_like(color[..., :1]), size, jitter))
