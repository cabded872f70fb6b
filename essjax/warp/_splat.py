"""Forward warps: every pixel is written where its motion points."""

import math

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.typing import Array, Image, Mask, Motion, Plane
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.sampling import gather_pixels, merge_leading_axes, stack_images

_MARGIN = 2  # positions are clamped to 1 pixel outside: every 2x2 window lies in the padded image


def _splat_windows(image: Array, motion: Array) -> Array:
    """``[B, H, W, C]`` and ``[B, H, W, 2]``, or one image. One scatter of 2x2 windows is faster than four of pixels."""
    *batch, height, width, channels = image.shape
    target = pixel_positions(height, width) + motion.astype(jnp.float32)
    first_column, columns = _axis_pair(target[..., 0], width)
    first_row, rows = _axis_pair(target[..., 1], height)
    size = (*batch, height + 2 * _MARGIN, width + 2 * _MARGIN, channels)
    total, first = stack_images(jnp.zeros(size, jnp.float32))
    weights = rows[..., :, None] * columns[..., None, :]
    lead = first_row.ndim
    total = jax.lax.scatter_add(
        total,
        jnp.stack([first + first_row, first_column], axis=-1) + _MARGIN,
        weights[..., None] * image.astype(jnp.float32)[..., None, None, :],
        jax.lax.ScatterDimensionNumbers(
            update_window_dims=(lead, lead + 1, lead + 2), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
        ),
        mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    )
    result = total.reshape(size)[..., _MARGIN:-_MARGIN, _MARGIN:-_MARGIN, :]
    return result.astype(_result_type(image))


def _result_type(image: Array) -> jnp.dtype:
    return image.dtype if jnp.issubdtype(image.dtype, jnp.floating) else jnp.dtype(jnp.float32)


def _axis_pair(positions: Array, size: int) -> tuple[Array, Array]:
    """First of the two pixels ``[..., H, W]`` around a position on one axis, their weights ``[..., H, W, 2]``."""
    x = jnp.where(positions > -1.0, jnp.minimum(positions, size + 1.0), -1.0) - 0.5  # NaN goes outside
    first = jnp.floor(x)
    return first.astype(jnp.int32), jnp.stack([1.0 - (x - first), x - first], axis=-1)


def splat(image: Image, motion: Motion) -> Image:
    """Add every pixel to the four around pixel + ``motion``, with bilinear weights; what falls outside is lost.

    The transpose (adjoint) of ``backward_warp(..., mode="bilinear", outside="zeros")``. Divide by the splat of ones for
    an average.

    Args:
      image: ``[..., H, W, C]`` of the current frame.
      motion: ``[..., H, W, 2]`` pixels, current to previous; a pixel whose motion is NaN is lost.

    Returns:
      ``[..., H, W, C]`` on the previous frame's pixels; of integers float32.

    Raises:
      ValueError: sizes differ.
    """
    check_channels("image", image, None)
    check_channels("motion", motion, 2, image.shape[-3:-1])
    leading = jnp.broadcast_shapes(image.shape[:-3], motion.shape[:-3])
    if math.prod((*leading, *image.shape[-3:])) == 0:
        return jnp.zeros((*leading, *image.shape[-3:]), _result_type(image))
    result = _splat_windows(
        *(merge_leading_axes(jnp.broadcast_to(x, (*leading, *x.shape[-3:]))) for x in (image, motion))
    )
    return result.reshape(*leading, *result.shape[-3:])


def _splat_nearest_one(image: Array, depth: Array, motion: Array) -> tuple[Array, Array]:
    height, width, channels = image.shape
    count = height * width
    target = (pixel_positions(height, width) + motion.astype(jnp.float32)).reshape(-1, 2)
    depth = depth.reshape(-1)
    inside = jnp.all((target >= 0) & (target < jnp.array([width, height])), axis=-1) & ~jnp.isnan(depth)
    cell = jnp.where(inside[:, None], jnp.floor(target), 0.0).astype(jnp.int32)
    index = jnp.where(inside, cell[:, 1] * width + cell[:, 0], count)  # outside: past the end, dropped
    nearest = jnp.full(count, jnp.inf, jnp.float32).at[index].min(depth, mode="drop")
    wins = inside & (depth == nearest.at[index].get(mode="clip"))
    # A second minimum, over pixel numbers, makes the winner the same on every backend where depths tie.
    winner = (
        jnp.full(count, count, jnp.int32)
        .at[jnp.where(wins, index, count)]
        .min(jnp.arange(count, dtype=jnp.int32), mode="drop")
    )
    covered = (winner < count)[:, None]
    value = gather_pixels(image.reshape(-1, channels), jnp.minimum(winner, count - 1))
    result = jnp.where(covered, value, jnp.zeros_like(value))
    return result.reshape(image.shape), covered.astype(jnp.float32).reshape(height, width, 1)


def splat_nearest(image: Image, depth: Plane, motion: Motion) -> tuple[Image, Mask]:
    """Write every pixel to the one that contains pixel + ``motion``; where several meet, the nearest depth wins.

    Args:
      image: ``[..., H, W, C]`` of the current frame; integers and infinities pass unchanged.
      depth: ``[..., H, W, 1]`` of the current frame, background +inf. Ties: first in rows.
      motion: ``[..., H, W, 2]`` pixels, current to previous; a pixel whose motion or depth is NaN is lost.

    Returns:
      The image ``[..., H, W, C]`` on the previous frame's pixels, 0 where nothing was written, and the mask
      ``[..., H, W, 1]`` of where something was.

    Raises:
      ValueError: sizes differ.
    """
    size = motion.shape[-3:-1]
    check_channels("image", image, None, size)
    check_channels("depth", depth, 1, size)
    check_channels("motion", motion, 2, size)
    return over_leading_axes(_splat_nearest_one, (3, 3, 3), image, depth, motion)
