"""From low-resolution, jittered samples to a high-resolution grid, and blocks to channels and back."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from essjax.typing import Array, Float, Image, Jitter, Places, Resized
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.sampling import Tap, axis_taps, check_mode, gather_pixels, sample


def check_scale(scale: int, name: str = "scale") -> int:
    """Return the scale as an int; raise a ValueError unless it is a whole number >= 1."""
    if int(scale) != scale or scale < 1:
        raise ValueError(f"{name}: expected a whole number >= 1, got {scale!r}.")
    return int(scale)


def check_jitter(jitter: Jitter | Sequence[float]) -> Array:
    """Return the jitter as a float32 array; raise a ValueError unless it is ``[..., 2]``."""
    jitter = jnp.asarray(jitter, jnp.float32)
    if jitter.shape[-1:] != (2,):
        raise ValueError(f"jitter: expected [..., 2] (x, y) in LR pixels, got {jitter.shape}.")
    return jitter


def _sample_offset(jitter: Jitter, scale: int) -> Array:
    """HR pixel ``[..., 2]`` (x, y), inside its LR pixel, that a sample fell into."""
    return jnp.clip(jnp.floor((jitter + 0.5) * scale), 0, scale - 1)  # the clip is for rounding at 0.5


def zero_upsample(image: Image, scale: int, jitter: Jitter) -> Resized:
    """Each LR sample in the HR pixel that it fell into, 0 elsewhere (DLCTUS; SPEC 4).

    The HR pixel is ``scale * p + floor((jitter + 0.5) * scale)``. Upsample an image of ones for the mask.

    Args:
      image: ``[..., H, W, C]``.
      scale: whole number.
      jitter: ``[..., 2]`` (x, y) LR pixels in [-0.5, 0.5).

    Returns:
      ``[..., scale * H, scale * W, C]``.

    Raises:
      ValueError: the scale is no whole number >= 1, or wrong shapes.
    """
    scale = check_scale(scale)
    check_channels("image", image, None)
    height, width, channels = image.shape[-3:]
    offset = _sample_offset(check_jitter(jitter), scale)
    here = jnp.arange(scale) == offset[..., None]  # [..., 2, scale]: x, y
    hit = (here[..., 1, :, None] & here[..., 0, None, :])[..., None, :, None, :, None]
    blocks = jnp.where(hit, image[..., :, None, :, None, :], jnp.zeros((), image.dtype))
    return blocks.reshape(*blocks.shape[:-5], height * scale, width * scale, channels)


def _sparse_taps(positions: Array, size: int, scale: int, offset: Array) -> Tap:
    """Which LR pixel bilinear interpolation of the zero-upsampled axis meets, and its weight: one of two neighbours."""
    index = jnp.zeros(positions.shape, jnp.int32)
    weight = jnp.zeros(positions.shape, jnp.float32)
    for tap in axis_taps(positions, size * scale, "bilinear", "zeros"):
        hit = (tap.index % scale == offset) & (tap.weight > 0)
        index = jnp.where(hit, tap.index // scale, index)
        weight = jnp.where(hit, tap.weight, weight)
    return Tap(index, weight)


def sample_zero_upsampled(image: Image, positions: Places, scale: int, jitter: Jitter) -> Resized:
    """``sample(zero_upsample(image, scale, jitter), positions, outside="zeros")`` without making the large image.

    Of the four HR pixels that bilinear interpolation reads, one at most holds a sample: one gather instead of four,
    and the gradient to the image is one scatter.

    Args:
      image: ``[..., H, W, C]``.
      positions: ``[..., h, w, 2]`` (x, y) in HR pixels, centres at +0.5; no gradient.
      scale: whole number.
      jitter: ``[..., 2]`` (x, y) LR pixels in [-0.5, 0.5) of the image.

    Returns:
      ``[..., h, w, C]``.

    Raises:
      ValueError: the scale is no whole number >= 1, or wrong shapes.
    """
    scale, jitter = check_scale(scale), check_jitter(jitter)
    if scale == 1:
        return sample(image, positions, outside="zeros")
    check_channels("image", image, None)
    check_channels("positions", positions, 2)

    def one(image: Array, positions: Array, jitter: Array) -> Array:
        height, width, channels = image.shape
        offset = _sample_offset(jitter, scale).astype(jnp.int32)
        column = _sparse_taps(positions[..., 0], width, scale, offset[0])
        row = _sparse_taps(positions[..., 1], height, scale, offset[1])
        value = gather_pixels(image.reshape(-1, channels), row.index * width + column.index)
        return value * (row.weight * column.weight)[..., None].astype(image.dtype)

    return over_leading_axes(one, (3, 3, 1), image, jax.lax.stop_gradient(positions), jitter)


def _along(image: Array, taps: list[Tap], axis: int) -> Array:
    """Interpolate a ``[H, W, C]`` image along axis 0 or 1 at the taps' positions."""
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    values = [jnp.asarray(image).at[(slice(None),) * axis + (tap.index,)].get(mode="promise_in_bounds") for tap in taps]
    if len(taps) == 1:  # nearest, no arithmetic: integers stay exact
        return values[0]
    weighted = (value.astype(jnp.float32) * tap.weight.reshape(shape) for value, tap in zip(values, taps, strict=True))
    return functools.reduce(jnp.add, weighted)


def jitter_aligned_upsample(image: Image, scale: float, jitter: Jitter, *, mode: str = "bilinear") -> Resized:
    """JAU: HR pixel P reads the LR image at (P + 0.5) / scale - jitter, where its samples really are (SPEC 4).

    All rows share their vertical position and all columns their horizontal one, so it is two 1-D interpolations.

    Args:
      image: ``[..., H, W, C]`` sampled at pixel centres + jitter.
      scale: output size over input size; sizes are rounded.
      jitter: ``[..., 2]`` (x, y) LR pixels; zeros give ordinary upsampling.
      mode: see ``sample``; the border repeats.

    Returns:
      ``[..., round(scale * H), round(scale * W), C]``; of integers float32, except that "nearest" keeps them.

    Raises:
      ValueError: unknown mode, wrong shapes, or a scale that is not positive.
    """
    check_mode(mode)
    check_channels("image", image, None)
    jitter = check_jitter(jitter)
    if not scale > 0:
        raise ValueError(f"scale: expected a positive number, got {scale!r}.")
    height, width = image.shape[-3:-1]
    rows, columns = ((jnp.arange(round(n * scale), dtype=jnp.float32) + 0.5) / scale for n in (height, width))

    def one(image: Array, jitter: Array) -> Array:
        wide = _along(image, axis_taps(columns - jitter[0], width, mode, "border"), axis=1)
        wide = jax.lax.optimization_barrier(wide)  # else every tap along the other axis computes it again
        result = _along(wide, axis_taps(rows - jitter[1], height, mode, "border"), axis=0)
        return result.astype(image.dtype) if jnp.issubdtype(image.dtype, jnp.floating) else result

    return over_leading_axes(one, (3, 1), image, jitter)


def space_to_depth(x: Image, block: int) -> Float[Array, "... H W C"]:
    """Fold blocks of pixels into channels: ``[..., H, W, C]`` to ``[..., H / block, W / block, block^2 C]``.

    Channel order (dy, dx, c): ``out[i, j, (dy * block + dx) * C + c] = x[i * block + dy, j * block + dx, c]``.

    Raises:
      ValueError: H or W is not a multiple of ``block``.
    """
    block = check_scale(block, "block")
    height, width, channels = x.shape[-3:]
    if height % block or width % block:
        raise ValueError(
            f"space_to_depth: expected height and width to be multiples of {block}, got {height}x{width}. Pad it first."
        )
    x = x.reshape(*x.shape[:-3], height // block, block, width // block, block, channels)
    x = jnp.swapaxes(x, -4, -3)
    return x.reshape(*x.shape[:-3], block * block * channels)


def depth_to_space(x: Image, block: int) -> Float[Array, "... H W C"]:
    """Inverse of ``space_to_depth``: ``[..., h, w, block^2 C]`` to ``[..., h block, w block, C]``.

    Raises:
      ValueError: the channels are not a multiple of ``block``^2.
    """
    block = check_scale(block, "block")
    height, width, channels = x.shape[-3:]
    if channels % block**2:
        raise ValueError(f"depth_to_space: expected a multiple of {block**2} channels, got {channels}.")
    channels //= block**2
    x = x.reshape(*x.shape[:-1], block, block, channels)
    x = jnp.swapaxes(x, -4, -3)
    return x.reshape(*x.shape[:-5], height * block, width * block, channels)
