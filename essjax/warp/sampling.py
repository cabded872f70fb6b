"""Read an image at fractional positions.

Conventions (those of ``grid_sample`` with ``align_corners=False``, in pixels): the centre of the top left pixel is
(0.5, 0.5), positions are (x, y). Outside the image either the border pixel repeats (``"border"``) or there is 0
(``"zeros"``); both hold per tap, so a bilinear read half a pixel outside blends the border pixel with 0.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from essjax import kernels
from essjax.cameras import pixel_positions
from essjax.typing import Array, Image, Mask, Motion, Places, Resized
from essjax.warp._batch import check_channels

OUTSIDE = ("border", "zeros")
CUBIC_PARAMETER = {"bicubic": -0.5, "bicubic-0.75": -0.75}
"""Keys' a: -0.5 keeps quadratics (Catmull-Rom), -0.75 is sharper (what DLCTUS, PyTorch and OpenCV use)."""
MODES = ("nearest", "bilinear", *CUBIC_PARAMETER)


class Tap(NamedTuple):
    """One tap of a 1-D filter: pixel index (always inside the image) and weight (0 where the read is of nothing)."""

    index: Array
    weight: Array


def check_mode(mode: str, outside: str = "border") -> None:
    """Raise a ValueError that lists the valid names."""
    if mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}.")
    if outside not in OUTSIDE:
        raise ValueError(f"outside: expected one of {', '.join(OUTSIDE)}, got {outside!r}.")


def cubic_weights(t: Array, a: float) -> list[Array]:
    """Weights of the pixels at -1, 0, 1, 2 for fraction ``t`` in [0, 1) (Keys 1981, eq 4)."""
    inner = lambda d: ((a + 2.0) * d - (a + 3.0)) * d * d + 1.0  # noqa: E731 - d = distance in [0, 1]
    outer = lambda d: ((a * d - 5.0 * a) * d + 8.0 * a) * d - 4.0 * a  # noqa: E731 - d in [1, 2]
    return [outer(1.0 + t), inner(t), inner(1.0 - t), outer(2.0 - t)]


def axis_taps(positions: Array, size: int, mode: str, outside: str) -> list[Tap]:
    """Return the taps that interpolate at ``positions`` (pixels, centres at +0.5) along an axis of ``size`` pixels."""
    half = {"nearest": 0, "bilinear": 1}.get(mode, 2)
    # Far outside nothing changes any more; the clamp keeps the integers below from overflowing.
    positions = jnp.clip(positions.astype(jnp.float32), -3.0, size + 3.0)
    if mode == "nearest":
        first, weights = jnp.floor(positions), [jnp.ones_like(positions)]
    else:
        x = positions - 0.5
        t = x - jnp.floor(x)
        first = jnp.floor(x) - (half - 1)
        weights = [1.0 - t, t] if mode == "bilinear" else cubic_weights(t, CUBIC_PARAMETER[mode])
    first = first.astype(jnp.int32)
    taps = []
    for k, weight in enumerate(weights):
        index = first + k
        if outside == "zeros":
            weight = jnp.where((index >= 0) & (index < size), weight, 0.0)
        taps.append(Tap(jnp.clip(index, 0, size - 1), weight))
    return taps


def gather_pixels(flat: Array, index: Array) -> Array:
    """Rows ``index`` (any shape, known to be inside) of ``flat`` ``[H * W, C]``: the fast gather."""
    return jnp.asarray(flat).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def merge_leading_axes(image: Array) -> Array:
    """``[..., H, W, C]`` as ``[B, H, W, C]``, or as ``[H, W, C]`` where that is one image."""
    batch = math.prod(image.shape[:-3])
    return image.reshape(*([batch] if batch != 1 else []), *image.shape[-3:])


def stack_images(image: Array) -> tuple[Array, Array | int]:
    """Images ``[B, H, W, C]`` below each other, ``[B * H, W, C]``, and the first row of each, ``[B, 1, 1]``.

    Under vmap gathers and scatters do not fuse on XLA:CPU; of one high image they do. One image without a leading axis
    passes unchanged and begins at row 0.
    """
    if image.ndim == 3:
        return image, 0
    batch, height, *rest = image.shape
    return image.reshape(batch * height, *rest), (jnp.arange(batch, dtype=jnp.int32) * height)[:, None, None]


def fetch(image: Array, column: Array, row: Array) -> Array:
    """Pixels ``[..., h, w, C]`` of ``[..., H, W, C]`` at integer places ``[..., h, w]``, known to be inside."""
    width, channels = image.shape[-2:]
    leading = jnp.broadcast_shapes(image.shape[:-3], column.shape[:-2])
    image = image if math.prod(image.shape[:-3]) == 1 else jnp.broadcast_to(image, (*leading, *image.shape[-3:]))
    place = jnp.broadcast_to(row * width + column, (*leading, *column.shape[-2:]))
    stacked, first = stack_images(merge_leading_axes(image))
    images = 1 if isinstance(first, int) else first.shape[0]
    index = first * width + place.reshape(images, -1, *place.shape[-1:])
    return gather_pixels(stacked.reshape(-1, channels), index).reshape(*place.shape, channels)


def _sample_taps(image: Array, positions: Array, mode: str, outside: str) -> Array:
    """One gather per tap: they fuse with the arithmetic. Arguments as ``_sample_cubic``."""
    height, width, channels = image.shape[-3:]
    stacked, first = stack_images(image)
    flat = stacked.reshape(-1, channels)
    columns = axis_taps(positions[..., 0], width, mode, outside)
    rows = axis_taps(positions[..., 1], height, mode, outside)
    if mode == "nearest":  # no arithmetic: integers stay exact and +inf stays +inf
        value = gather_pixels(flat, (first + rows[0].index) * width + columns[0].index)
        return jnp.where((rows[0].weight * columns[0].weight)[..., None] > 0, value, jnp.zeros_like(value))
    total = jnp.zeros((), jnp.float32)
    for row in rows:
        for column in columns:
            value = gather_pixels(flat, (first + row.index) * width + column.index).astype(jnp.float32)
            total = total + value * (row.weight * column.weight)[..., None]
    return total.astype(image.dtype) if jnp.issubdtype(image.dtype, jnp.floating) else total


def _sample_windows(image: Array, positions: Array, mode: str, outside: str) -> Array:
    """Do the same by one gather of a 4x4 window per position: slower itself, but its transpose is a single scatter."""
    height, width, channels = image.shape[-3:]
    margin = 5  # positions are clamped to 3 pixels outside: every window lies in the padded image
    pad = [(0, 0)] * (image.ndim - 3) + [(margin, margin), (margin, margin), (0, 0)]
    padded, first = stack_images(jnp.pad(image, pad, mode="edge") if outside == "border" else jnp.pad(image, pad))
    first_column, columns = _axis_window(positions[..., 0], width, mode)
    first_row, rows = _axis_window(positions[..., 1], height, mode)
    start = jnp.stack([first + first_row, first_column], axis=-1) + margin
    lead = start.ndim - 1
    window = jax.lax.gather(
        padded,
        start,
        jax.lax.GatherDimensionNumbers(
            offset_dims=(lead, lead + 1, lead + 2), collapsed_slice_dims=(), start_index_map=(0, 1)
        ),
        (4, 4, channels),
        mode=jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    ).astype(jnp.float32)
    total = jnp.sum(window * (rows[..., :, None] * columns[..., None, :])[..., None], axis=(-3, -2))
    return total.astype(image.dtype)


def _axis_window(positions: Array, size: int, mode: str) -> tuple[Array, Array]:
    """First pixel ``[..., h, w]`` (may be outside) and the four cubic weights ``[..., h, w, 4]`` along one axis."""
    x = jnp.clip(positions.astype(jnp.float32), -3.0, size + 3.0) - 0.5
    weights = cubic_weights(x - jnp.floor(x), CUBIC_PARAMETER[mode])
    return jnp.floor(x).astype(jnp.int32) - 1, jnp.stack(weights, axis=-1)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _sample_cubic(image: Array, positions: Array, mode: str, outside: str) -> Array:
    """Bicubic reads whose gradient to the image is one scatter, not 16 (4x faster, and to compile as well).

    The image is ``[B, H, W, C]`` with positions ``[B, h, w, 2]``, or ``[H, W, C]`` with positions ``[..., h, w, 2]``.
    """
    if not kernels.available():
        return _sample_taps(image, positions, mode, outside)
    from essjax.warp.sampling_triton import read_cubic  # an optional package

    images = image.reshape(-1, *image.shape[-3:])
    flat = positions.astype(jnp.float32).reshape(len(images), -1, 2)
    values = read_cubic(images, flat, a=CUBIC_PARAMETER[mode], zeros=outside == "zeros")
    return values.reshape(*positions.shape[:-1], image.shape[-1])


def _cubic_forward(image, positions, mode, outside):
    return _sample_cubic(image, positions, mode, outside), (image, positions)


def _cubic_backward(mode, outside, residuals, gradient):
    image, positions = residuals
    to_image = jax.vjp(lambda i: _sample_windows(i, positions, mode, outside), image)[1]
    to_positions = jax.vjp(lambda p: _sample_taps(image, p, mode, outside), positions)[1]
    return to_image(gradient)[0], to_positions(gradient)[0]


_sample_cubic.defvjp(_cubic_forward, _cubic_backward)


def sample(image: Image, positions: Places, *, mode: str = "bilinear", outside: str = "border") -> Resized:
    """Read ``image`` at ``positions``.

    Weights and sums are float32 whatever the image's type. Bicubic differentiates in reverse mode only. Finite
    gradients everywhere; bilinear has a kink at pixel centres (its gradient there is that of the right/lower side),
    nearest has none with respect to positions.

    Args:
      image: ``[..., H, W, C]``, finite (``mode="nearest"`` also takes infinities and integers unchanged).
      positions: ``[..., h, w, 2]`` (x, y) in pixels of ``image``, centres at +0.5; another size than the image is fine.
      mode: "nearest" (the pixel that contains the position), "bilinear", "bicubic" (Keys, a = -0.5) or
        "bicubic-0.75" (a = -0.75). Bicubic can over- and undershoot.
      outside: "border" repeats the border pixel, "zeros" reads 0 there.

    Returns:
      ``[..., h, w, C]``; leading axes broadcast.

    Raises:
      ValueError: unknown mode or outside, or wrong shapes.
    """
    check_mode(mode, outside)
    check_channels("image", image, None)
    check_channels("positions", positions, 2)
    leading = jnp.broadcast_shapes(image.shape[:-3], positions.shape[:-3])
    if math.prod(image.shape[:-3]) != 1:  # else it is shared, not copied
        image, positions = (jnp.broadcast_to(x, (*leading, *x.shape[-3:])) for x in (image, positions))
    image, positions = merge_leading_axes(image), merge_leading_axes(positions)
    differentiable = mode in CUBIC_PARAMETER and jnp.issubdtype(image.dtype, jnp.floating)
    kernel = cast(Callable[..., Array], _sample_cubic if differentiable else _sample_taps)
    result = kernel(image, positions, mode, outside)
    return result.reshape(*leading, *result.shape[-3:])


def inside_mask(motion: Motion) -> Mask:
    """1 where pixel centre + ``motion`` lies inside the image [0, W] x [0, H], else 0.

    Args:
      motion: ``[..., H, W, 2]`` in pixels.

    Returns:
      float32 ``[..., H, W, 1]``.
    """
    check_channels("motion", motion, 2)
    height, width = motion.shape[-3:-1]
    positions = pixel_positions(height, width) + motion
    size = jnp.array([width, height], jnp.float32)
    return jnp.all((positions >= 0) & (positions <= size), axis=-1, keepdims=True).astype(jnp.float32)
