"""A 3x3 convolution with bias and leaky ReLU as one Triton kernel, for the narrow layers of real-time networks.

cuDNN multiplies tiles of 64 output channels whatever the layer has: most of its work on 24 channels is thrown away, and
bias and activation are another pass over memory. 16-bit operands, float32 sums.
"""

from functools import partial

import jax
import jax.numpy as jnp
import triton
import triton.language as tl
from jax import lax

from essjax import kernels
from essjax.networks.precision import pad_channels
from essjax.typing import Array


@triton.jit
def conv3x3_kernel(
    x, kernel, bias, y,
    height: tl.constexpr, width: tl.constexpr, channels: tl.constexpr, outputs: tl.constexpr,
    padded_channels: tl.constexpr, padded_outputs: tl.constexpr, chunk: tl.constexpr, slope: tl.constexpr,
    shared: tl.constexpr, block_rows: tl.constexpr, block_columns: tl.constexpr, stages: tl.constexpr,
):  # fmt: skip
    """One tile of pixels of one image, all output channels.

    Args:
      x: ``[B, height, width, channels]``.
      kernel: ``[B, 3, 3, padded_channels, padded_outputs]``, zeros in the padding.
      bias: float32 ``[B, padded_outputs]``.
      y: result, ``[B, height, width, outputs]``.
      height: of the images.
      width: of the images.
      channels: of ``x``.
      outputs: channels of ``y``.
      padded_channels: a multiple of ``chunk``.
      padded_outputs: a power of 2.
      chunk: channels multiplied at once.
      slope: of the leaky ReLU; 1 for none.
      shared: of the three arrays, whether there is one for the whole batch.
      block_rows: of a tile.
      block_columns: of a tile.
      stages: of the pipeline of loads.
    """
    item = tl.program_id(2).to(tl.int64)  # of large batches more numbers than int32 counts
    pixel = tl.arange(0, block_rows * block_columns)
    row = tl.program_id(1) * block_rows + pixel // block_columns
    column = tl.program_id(0) * block_columns + pixel % block_columns
    channel = tl.arange(0, chunk)
    output = tl.arange(0, padded_outputs)
    if not shared[0]:
        x += item * (height * width * channels)
    if not shared[1]:
        kernel += item * (9 * padded_channels * padded_outputs)
    if not shared[2]:
        bias += item * padded_outputs
    total = tl.zeros((block_rows * block_columns, padded_outputs), tl.float32)
    chunks: tl.constexpr = padded_channels // chunk
    for step in tl.range(0, 9 * chunks, num_stages=stages):
        tap = step // chunks
        first = (step % chunks) * chunk
        tap_row, tap_column = row + tap // 3 - 1, column + tap % 3 - 1
        inside = (tap_row >= 0) & (tap_row < height) & (tap_column >= 0) & (tap_column < width)
        index = (tap_row * width + tap_column) * channels + first
        left = tl.load(
            x + index[:, None] + channel[None, :],
            mask=inside[:, None] & (first + channel < channels)[None, :], other=0.0,
        )  # fmt: skip
        right = tl.load(kernel + (step * chunk + channel)[:, None] * padded_outputs + output[None, :])
        total = tl.dot(left, right, total)
    total += tl.load(bias + output)[None, :]
    total = tl.where(total > 0, total, total * slope)
    y += item * (height * width * outputs)
    at = row * width + column
    inside = (row < height) & (column < width)
    tl.store(
        y + at[:, None] * outputs + output[None, :],
        total.to(y.dtype.element_ty), mask=inside[:, None] & (output < outputs)[None, :],
    )  # fmt: skip


def settings(channels: int, outputs: int) -> dict[str, int]:
    """Constants of the kernel and its warps, for a number of channels; the best of 14 on an H100."""
    chunk = 32 if 16 < channels <= 32 else 16
    return {
        "padded_channels": -(-channels // chunk) * chunk,
        "padded_outputs": max(16, triton.next_power_of_2(outputs)),
        "chunk": chunk, "block_rows": 8, "block_columns": 32, "stages": 1, "num_warps": 4 if chunk == 32 else 8,
    }  # fmt: skip


def pack(kernel: Array, padded_channels: int, padded_outputs: int) -> Array:
    """``[3, 3, I, O]`` with zeros up to the padded sizes."""
    _, _, channels, outputs = kernel.shape
    return jnp.pad(kernel, [(0, 0), (0, 0), (0, padded_channels - channels), (0, padded_outputs - outputs)])


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def convolve(x: Array, kernel: Array, bias: Array, slope: float) -> Array:
    """Leaky ReLU of a 3x3 convolution with zero padding: ``[B, H, W, I]`` to ``[B, H, W, O]``.

    Args:
      x: bfloat16 or float16, ``[B, H, W, I]``.
      kernel: of the same type, ``[3, 3, I, O]``.
      bias: float32 ``[O]``.
      slope: of the leaky ReLU; 1 for none.
    """
    images, outputs = pad_channels(x), bias.size
    height, width, channels = images.shape[1:]
    chosen = settings(channels, outputs)
    tiles = triton.cdiv(width, chosen["block_columns"]), triton.cdiv(height, chosen["block_rows"])

    @kernels.over_batches
    def run(*arrays: Array) -> list[Array]:
        batch = max(array.shape[0] for array in arrays)
        return kernels.call(
            conv3x3_kernel,
            *arrays,
            out_shape=[jax.ShapeDtypeStruct((batch, height, width, outputs), x.dtype)],
            grid=(*tiles, batch),
            height=height, width=width, channels=channels, outputs=outputs, slope=slope,
            shared=tuple(array.shape[0] == 1 for array in arrays),
            **chosen,
        )  # fmt: skip

    packed = pack(kernel, chosen["padded_channels"], chosen["padded_outputs"])
    return run(images, packed[None], jnp.pad(bias, (0, chosen["padded_outputs"] - outputs))[None])[0]


def reference(x: Array, kernel: Array, bias: Array, slope: float) -> Array:
    """Compute the same by XLA: what derivatives are taken of."""
    y = lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    y = y.astype(jnp.float32) + bias
    return jnp.where(y > 0, y, slope * y).astype(x.dtype)


@convolve.defjvp
def _derivative(slope, primals, tangents):
    return convolve(*primals, slope), jax.jvp(lambda *arrays: reference(*arrays, slope), primals, tangents)[1]
