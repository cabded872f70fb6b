"""Bicubic reads as one Triton kernel: positions in, values out, nothing between lies in memory.

Same taps and weights as ``sampling._sample_taps``, whose gradients are used.
"""

import jax
import triton
import triton.language as tl

from essjax import kernels
from essjax.typing import Array

BLOCK = 512
"""Numbers of one program: neighbouring channels and pixels, as they lie in memory."""
WARPS = 4


@triton.jit
def _inner(d, a: tl.constexpr):
    return ((a + 2.0) * d - (a + 3.0)) * d * d + 1.0


@triton.jit
def _outer(d, a: tl.constexpr):
    return ((a * d - 5.0 * a) * d + 8.0 * a) * d - 4.0 * a


@triton.jit
def _taps(position, size: tl.constexpr, step: tl.constexpr, a: tl.constexpr, zeros: tl.constexpr):
    """Return indices, times ``step``, and weights of the four pixels along one axis."""
    # A position that is not a number reads what is not a number, as XLA does.
    x = tl.maximum(position, -3.0, propagate_nan=tl.PropagateNan.ALL)
    x = tl.minimum(x, size + 3.0, propagate_nan=tl.PropagateNan.ALL) - 0.5
    first = tl.floor(x)
    t = x - first
    index = tl.where(first == first, first, 0.0).to(tl.int32) - 1
    weights = (_outer(1.0 + t, a), _inner(t, a), _inner(1.0 - t, a), _outer(2.0 - t, a))
    indices = ()
    kept = ()
    for k in tl.static_range(4):
        weight = weights[k]
        if zeros:
            weight = tl.where((index + k >= 0) & (index + k < size), weight, 0.0)
        kept = kept + (weight,)
        indices = indices + (tl.minimum(tl.maximum(index + k, 0), size - 1) * step,)
    return indices, kept


@triton.jit
def cubic_kernel(
    image, positions, result,
    count: tl.constexpr, height: tl.constexpr, width: tl.constexpr, channels: tl.constexpr, shared: tl.constexpr,
    a: tl.constexpr, zeros: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """One block of numbers of one image of a batch.

    Args:
      image: ``[B, height, width, channels]``.
      positions: float32 ``[B, count, 2]``.
      result: ``[B, count, channels]``.
      count: of positions.
      height: of the images.
      width: of the images.
      channels: of the images.
      shared: of image and positions, whether there is one for the whole batch.
      a: Keys' parameter.
      zeros: read 0 outside, not the border.
      block: numbers of one program.
    """
    item = tl.program_id(1).to(tl.int64)  # of large batches more numbers than int32 counts
    number = tl.minimum(tl.program_id(0) * block + tl.arange(0, block), count * channels - 1)
    place, channel = number // channels, number % channels
    if not shared[0]:
        image += item * (height * width * channels)
    if not shared[1]:
        positions += item * (2 * count)
    result += item * (count * channels)
    columns, column_weights = _taps(tl.load(positions + 2 * place), width, channels, a, zeros)
    rows, row_weights = _taps(tl.load(positions + 2 * place + 1), height, 1, a, zeros)
    total = tl.zeros_like(row_weights[0])
    for row in tl.static_range(4):
        first = rows[row] * (width * channels) + channel
        for column in tl.static_range(4):
            value = tl.load(image + (first + columns[column])).to(tl.float32)
            total += value * (row_weights[row] * column_weights[column])
    tl.store(result + number, total)


def read_cubic(image: Array, positions: Array, *, a: float, zeros: bool) -> Array:
    """Bicubic reads.

    Args:
      image: ``[B, H, W, C]``.
      positions: float32 ``[B, n, 2]``; of either there may be one for all of the batch.
      a: Keys' parameter.
      zeros: read 0 outside, not the border.

    Returns:
      ``[B, n, C]`` of the image's type.
    """

    @kernels.over_batches
    def read(image: Array, positions: Array) -> list[Array]:
        height, width, channels = image.shape[1:]
        batch, count = max(image.shape[0], positions.shape[0]), positions.shape[1]
        return kernels.call(
            cubic_kernel,
            image,
            positions,
            out_shape=[jax.ShapeDtypeStruct((batch, count, channels), image.dtype)],
            grid=(triton.cdiv(count * channels, BLOCK), batch, 1),
            num_warps=WARPS,
            count=count, height=height, width=width, channels=channels,
            shared=(image.shape[0] == 1, positions.shape[0] == 1), a=a, zeros=zeros, block=BLOCK,
        )  # fmt: skip

    return read(image, positions)[0]
