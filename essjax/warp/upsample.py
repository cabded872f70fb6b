"""From low-resolution, jittered samples to a high-resolution grid, and blocks to channels and back."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from essjax.sizes import Size, check_size, whole_ratio
from essjax.typing import Array, Float, Image, Jitter, Places, Resized
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.sampling import Tap, axis_taps, check_mode, gather_pixels, sample


def check_block(block: int) -> int:
    """Return the side of a block as an int; raise a ValueError unless it is a whole number >= 1."""
    if int(block) != block or block < 1:
        raise ValueError(f"block: expected a whole number >= 1, got {block!r}.")
    return int(block)


def check_jitter(jitter: Jitter | Sequence[float]) -> Array:
    """Return the jitter as a float32 array; raise a ValueError unless it is ``[..., 2]``."""
    jitter = jnp.asarray(jitter, jnp.float32)
    if jitter.shape[-1:] != (2,):
        raise ValueError(f"jitter: expected [..., 2] (x, y) in LR pixels, got {jitter.shape}.")
    return jitter


def _sample_offset(jitter: Jitter, scale: int) -> Array:
    """HR pixel ``[..., 2]`` (x, y), inside its LR pixel, that a sample fell into."""
    return jnp.clip(jnp.floor((jitter + 0.5) * scale), 0, scale - 1)  # the clip is for rounding at 0.5


def _check_enlarges(size: Size, image: Image) -> Size:
    """Return the size; a ValueError unless it is the image's or larger: two samples cannot lie in one pixel."""
    size, (height, width) = check_size(size), image.shape[-3:-1]
    if size[0] < height or size[1] < width:
        raise ValueError(f"size: expected at least the image's {width}x{height}, got {size[1]}x{size[0]}.")
    return size


def _fallen(pixels: Array, size: int, output: int, jitter: Array) -> tuple[Array, Array]:
    """Find which LR sample fell into each of the output ``pixels`` of an axis: its index, and whether one did."""
    ratio = output / size
    index = jnp.clip(jnp.floor((pixels + 0.5) / ratio - jitter), 0, size - 1)  # the nearest: no other can have
    place = (index + 0.5 + jitter) * ratio
    last = index == size - 1  # rounding at the end of the image
    hit = (jnp.floor(place) == pixels) | (last & (pixels == output - 1) & (place >= output))
    return index.astype(jnp.int32), hit


def zero_upsample(image: Image, size: Size, jitter: Jitter) -> Resized:
    """Each LR sample in the HR pixel that it fell into, 0 elsewhere (DLCTUS; SPEC 4).

    The sample of pixel p lies at ``ratio * (p + 0.5 + jitter)``. Upsample an image of ones for the mask.

    Args:
      image: ``[..., H, W, C]``.
      size: (height, width) of the output, at least the image's.
      jitter: ``[..., 2]`` (x, y) LR pixels in [-0.5, 0.5).

    Returns:
      ``[..., *size, C]``.

    Raises:
      ValueError: the size is smaller, or wrong shapes.
    """
    check_channels("image", image, None)
    size, jitter = _check_enlarges(size, image), check_jitter(jitter)
    height, width, channels = image.shape[-3:]
    scale = whole_ratio((height, width), size)
    if scale is not None:  # without a gather
        offset = _sample_offset(jitter, scale)
        here = jnp.arange(scale) == offset[..., None]  # [..., 2, scale]: x, y
        hit = (here[..., 1, :, None] & here[..., 0, None, :])[..., None, :, None, :, None]
        blocks = jnp.where(hit, image[..., :, None, :, None, :], jnp.zeros((), image.dtype))
        return blocks.reshape(*blocks.shape[:-5], *size, channels)

    def one(image: Array, jitter: Array) -> Array:
        columns, across = _fallen(jnp.arange(size[1]), width, size[1], jitter[0])
        rows, down = _fallen(jnp.arange(size[0]), height, size[0], jitter[1])
        value = gather_pixels(image.reshape(-1, channels), rows[:, None] * width + columns)
        return jnp.where((down[:, None] & across)[..., None], value, jnp.zeros((), image.dtype))

    return over_leading_axes(one, (3, 1), image, jitter)


def _sparse_taps(positions: Array, size: int, output: int, jitter: Array) -> list[Tap]:
    """Which LR pixels bilinear interpolation of the zero-upsampled axis meets, with their weights: up to two.

    At twice the size or more one of them at most holds a sample: the other is left out.
    """
    scale = output // size if output % size == 0 else None
    taps = []
    for tap in axis_taps(positions, output, "bilinear", "zeros"):
        if scale is None:
            index, hit = _fallen(tap.index, size, output, jitter)
        else:
            index, hit = tap.index // scale, tap.index % scale == _sample_offset(jitter, scale).astype(jnp.int32)
        taps.append(Tap(index, jnp.where(hit, tap.weight, 0.0)))
    if output < 2 * size:
        return taps
    near, far = taps
    met = far.weight > 0
    return [Tap(jnp.where(met, far.index, near.index), jnp.where(met, far.weight, near.weight))]


def sample_zero_upsampled(image: Image, positions: Places, size: Size, jitter: Jitter) -> Resized:
    """``sample(zero_upsample(image, size, jitter), positions, outside="zeros")`` without making the large image.

    From twice the size on, of the four HR pixels that bilinear interpolation reads one at most holds a sample: one
    gather instead of four, and the gradient to the image is one scatter.

    Args:
      image: ``[..., H, W, C]``.
      positions: ``[..., h, w, 2]`` (x, y) in HR pixels, centres at +0.5; no gradient.
      size: (height, width) of the large image, at least the small one's.
      jitter: ``[..., 2]`` (x, y) LR pixels in [-0.5, 0.5) of the image.

    Returns:
      ``[..., h, w, C]``.

    Raises:
      ValueError: the size is smaller, or wrong shapes.
    """
    check_channels("image", image, None)
    check_channels("positions", positions, 2)
    size, jitter = _check_enlarges(size, image), check_jitter(jitter)
    if size == image.shape[-3:-1]:
        return sample(image, positions, outside="zeros")

    def one(image: Array, positions: Array, jitter: Array) -> Array:
        height, width, channels = image.shape
        columns = _sparse_taps(positions[..., 0], width, size[1], jitter[0])
        rows = _sparse_taps(positions[..., 1], height, size[0], jitter[1])
        flat, values = image.reshape(-1, channels), []
        for row in rows:
            for column in columns:
                value = gather_pixels(flat, row.index * width + column.index)
                values.append(value * (row.weight * column.weight)[..., None].astype(image.dtype))
        return functools.reduce(jnp.add, values)

    return over_leading_axes(one, (3, 3, 1), image, jax.lax.stop_gradient(positions), jitter)


def _along(image: Array, taps: list[Tap], axis: int) -> Array:
    """Interpolate a ``[H, W, C]`` image along axis 0 or 1 at the taps' positions."""
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    values = [jnp.asarray(image).at[(slice(None),) * axis + (tap.index,)].get(mode="promise_in_bounds") for tap in taps]
    if len(taps) == 1:  # nearest, no arithmetic: integers stay exact
        return values[0]
    weighted = (value.astype(jnp.float32) * tap.weight.reshape(shape) for value, tap in zip(values, taps, strict=True))
    return functools.reduce(jnp.add, weighted)


def jitter_aligned_upsample(image: Image, size: Size, jitter: Jitter, *, mode: str = "bilinear") -> Resized:
    """JAU: HR pixel P reads the LR image at (P + 0.5) / ratio - jitter, where its samples really are (SPEC 4).

    All rows share their vertical position and all columns their horizontal one, so it is two 1-D interpolations.

    Args:
      image: ``[..., H, W, C]`` sampled at pixel centres + jitter.
      size: (height, width) of the output; each axis has the ratio that follows.
      jitter: ``[..., 2]`` (x, y) LR pixels; zeros give ordinary upsampling.
      mode: see ``sample``; the border repeats.

    Returns:
      ``[..., *size, C]``; of integers float32, except that "nearest" keeps them.

    Raises:
      ValueError: unknown mode, or wrong shapes.
    """
    check_mode(mode)
    check_channels("image", image, None)
    size, jitter = check_size(size), check_jitter(jitter)
    height, width = image.shape[-3:-1]
    rows, columns = (
        (jnp.arange(output, dtype=jnp.float32) + 0.5) / (output / n)
        for output, n in zip(size, (height, width), strict=True)
    )

    def one(image: Array, jitter: Array) -> Array:
        wide = _along(image, axis_taps(columns - jitter[0], width, mode, "border"), axis=1)
        wide = jax.lax.optimization_barrier(wide)  # else every tap along the other axis computes it again
        result = _along(wide, axis_taps(rows - jitter[1], height, mode, "border"), axis=0)
        return result.astype(image.dtype) if jnp.issubdtype(image.dtype, jnp.floating) else result

    return over_leading_axes(one, (3, 1), image, jitter)


def nearest_upsample(image: Image, size: Size) -> Resized:
    """Each output pixel shows the LR pixel that its centre lies in, jitter or not: blocks where the ratio is whole.

    Args:
      image: ``[..., H, W, C]``.
      size: (height, width) of the output.

    Returns:
      ``[..., *size, C]``, of the image's type.
    """
    check_channels("image", image, None)
    factor = whole_ratio(image.shape[-3:-1], check_size(size))
    if factor is not None:
        return jnp.repeat(jnp.repeat(image, factor, axis=-3), factor, axis=-2)
    return jitter_aligned_upsample(image, size, (0.0, 0.0), mode="nearest")


def space_to_depth(x: Image, block: int) -> Float[Array, "... H W C"]:
    """Fold blocks of pixels into channels: ``[..., H, W, C]`` to ``[..., H / block, W / block, block^2 C]``.

    Channel order (dy, dx, c): ``out[i, j, (dy * block + dx) * C + c] = x[i * block + dy, j * block + dx, c]``.

    Raises:
      ValueError: H or W is not a multiple of ``block``.
    """
    block = check_block(block)
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
    block = check_block(block)
    height, width, channels = x.shape[-3:]
    if channels % block**2:
        raise ValueError(f"depth_to_space: expected a multiple of {block**2} channels, got {channels}.")
    channels //= block**2
    x = x.reshape(*x.shape[:-1], block, block, channels)
    x = jnp.swapaxes(x, -4, -3)
    return x.reshape(*x.shape[:-5], height * block, width * block, channels)
