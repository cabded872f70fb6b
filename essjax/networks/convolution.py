"""Convolutions whose gradients stay fast inside ``lax.scan`` on CPUs.

XLA:CPU lays out the gradients of a convolution in a loop such that they miss its fast routine and run about 20 times
slower (docs/adr/0006-scan-friendly-convolution.md). Written out as plain NHWC convolutions they do not. The gradient of
a strided one is that of a stride-1 convolution of blocks, a depthwise one is a sum of shifted products. On other
backends the ordinary convolution is used, with channels in the multiples that GPUs like, or a kernel of our own.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from essjax import kernels
from essjax.networks.precision import LIKED, current_itemsize, in_compute_dtype, pad_channels

_NHWC = ("NHWC", "HWIO", "NHWC")
Padding = tuple[tuple[int, int], ...]
"""(before, after) of rows and of columns."""


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _convolve(x: jax.Array, kernel: jax.Array, padding: Padding) -> jax.Array:
    return lax.conv_general_dilated(x, kernel, (1, 1), padding, dimension_numbers=_NHWC)


def _forward(x, kernel, padding):
    return _convolve(x, kernel, padding), (x, kernel)


def _backward(padding, residuals, gradient):
    x, kernel = residuals
    flipped = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    reverse = [(size - 1 - low, size - 1 - high) for size, (low, high) in zip(kernel.shape, padding, strict=False)]
    dx = lax.conv_general_dilated(gradient, flipped, (1, 1), reverse, dimension_numbers=_NHWC)
    # The kernel's gradient correlates input and output gradient: channels take the place of the batch, the image that
    # of the kernel.
    dw = lax.conv_general_dilated(
        jnp.transpose(x, (3, 1, 2, 0)), jnp.transpose(gradient, (1, 2, 0, 3)), (1, 1), padding, dimension_numbers=_NHWC
    )
    return dx, jnp.transpose(dw, (1, 2, 0, 3))


_convolve.defvjp(_forward, _backward)


def _by_blocks(x: jax.Array, kernel: jax.Array, stride: int, padding: Padding) -> jax.Array:
    """Compute a strided convolution as one of stride 1 over ``stride`` x ``stride`` blocks that have become channels.

    The kernel gets zeros in front until it begins with a block, and at the end until it ends with one.
    """
    batch, height, width, channels = x.shape
    front = [-low % stride for low, _ in padding]
    blocks = [-(-(size + f) // stride) for size, f in zip(kernel.shape, front, strict=False)]
    behind = [n * stride - size - f for n, size, f in zip(blocks, kernel.shape, front, strict=False)]
    kernel = jnp.pad(kernel, [(front[0], behind[0]), (front[1], behind[1]), (0, 0), (0, 0)])
    kernel = kernel.reshape(blocks[0], stride, blocks[1], stride, channels, -1).transpose(0, 2, 1, 3, 4, 5)
    kernel = kernel.reshape(*blocks, stride * stride * channels, -1)
    x = x.reshape(batch, height // stride, stride, width // stride, stride, channels).transpose(0, 1, 3, 2, 4, 5)
    x = x.reshape(batch, height // stride, width // stride, stride * stride * channels)
    lows = [-(-low // stride) for low, _ in padding]
    return _convolve(x, kernel, tuple((low, n - 1 - low) for low, n in zip(lows, blocks, strict=True)))


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _strided(x: jax.Array, kernel: jax.Array, stride: int, padding: Padding) -> jax.Array:
    """Compute the ordinary one, which is faster than blocks; only its gradient is that of ``_by_blocks``."""
    return lax.conv_general_dilated(x, kernel, (stride, stride), padding, dimension_numbers=_NHWC)


def _strided_forward(x, kernel, stride, padding):
    return _strided(x, kernel, stride, padding), (x, kernel)


def _strided_backward(stride, padding, residuals, gradient):
    return jax.vjp(lambda x, kernel: _by_blocks(x, kernel, stride, padding), *residuals)[1](gradient)


_strided.defvjp(_strided_forward, _strided_backward)


def _shifted(x: jax.Array, kernel: jax.Array, padding: Padding) -> list[list[jax.Array]]:
    """Shift the image to what each place of the kernel sees, ``[kh][kw]`` arrays of the output's size."""
    padded = jnp.pad(x, [(0, 0), *padding, (0, 0)])
    height, width = (
        n + low + high + 1 - size for n, (low, high), size in zip(x.shape[1:3], padding, kernel.shape, strict=False)
    )
    rows = [padded[:, i : i + height] for i in range(kernel.shape[0])]
    return [[row[:, :, j : j + width] for j in range(kernel.shape[1])] for row in rows]


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _depthwise(x: jax.Array, kernel: jax.Array, padding: Padding) -> jax.Array:
    """One kernel ``[kh, kw, 1, C]`` per channel, as a sum of shifted products: they fuse, no convolution does."""
    seen = _shifted(x, kernel, padding)
    products = [part * kernel[i, j, 0] for i, row in enumerate(seen) for j, part in enumerate(row)]
    return sum(products[1:], start=products[0])


def _depthwise_forward(x, kernel, padding):
    return _depthwise(x, kernel, padding), (x, kernel)


def _depthwise_backward(padding, residuals, gradient):
    x, kernel = residuals
    reverse = tuple((size - 1 - low, size - 1 - high) for size, (low, high) in zip(kernel.shape, padding, strict=False))
    sums = [[jnp.sum(part * gradient, axis=(0, 1, 2)) for part in row] for row in _shifted(x, kernel, padding)]
    to_kernel = jnp.stack([jnp.stack(row) for row in sums])[:, :, None]
    return _depthwise(gradient, kernel[::-1, ::-1], reverse), to_kernel


_depthwise.defvjp(_depthwise_forward, _depthwise_backward)


@in_compute_dtype
def scan_friendly_convolution(lhs, rhs, window_strides, padding, *, lhs_dilation=None, rhs_dilation=None, **options):
    """``lax.conv_general_dilated`` for linen's ``conv_general_dilated=``: NHWC, on the CPU with gradients of our own.

    They need a kernel no larger than its padding allows: an output as large as the input (stride 1), or one pixel per
    ``stride`` x ``stride`` block (sizes must be multiples of the stride). With a group per channel (depthwise, one
    kernel each) the stride must be 1. Anything else, and every backend but the CPU, falls through to the ordinary one.
    """
    sizes, strides = lhs.shape[1:3], tuple(window_strides)
    groups = options.get("feature_group_count", 1)
    depthwise = 1 < groups == lhs.shape[3] == rhs.shape[3] and strides == (1, 1)
    simple = (groups == 1 or depthwise) and kernels.backend() == "cpu"
    simple &= all(d in (None, (1, 1), [1, 1]) or tuple(d) == (1, 1) for d in (lhs_dilation, rhs_dilation))
    if simple and strides[0] == strides[1] and all(size % strides[0] == 0 for size in sizes):
        pairs = lax.padtype_to_pads(sizes, rhs.shape[:2], strides, padding) if isinstance(padding, str) else padding
        pairs = tuple((int(low), int(high)) for low, high in pairs)
        if all(n - strides[0] <= low + high < n and low < n for n, (low, high) in zip(rhs.shape, pairs, strict=False)):
            lhs, rhs = _vary_alike(lhs, rhs)
            if depthwise:
                return _depthwise(lhs, rhs, pairs)
            return _convolve(lhs, rhs, pairs) if strides[0] == 1 else _strided(lhs, rhs, strides[0], pairs)
    outputs = rhs.shape[3]
    if groups == 1 and kernels.on_gpu():
        lhs, rhs = pad_channels(lhs), _pad_kernel(rhs)
    result = lax.conv_general_dilated(
        lhs, rhs, window_strides, padding, lhs_dilation=lhs_dilation, rhs_dilation=rhs_dilation, **options
    )
    return result[..., :outputs]


def _vary_alike(*arrays: jax.Array) -> list[jax.Array]:
    """In ``jax.shard_map``: each array marked as varying over the mesh axes that any of them varies over.

    JAX sums the gradient of what is the same everywhere (a kernel) over the devices; only not in a custom rule.
    """
    kinds = [jax.typeof(array) for array in arrays]
    # Of jax before and since 0.12.
    varying = [kind.vma if hasattr(kind, "vma") else kind.mat.varying for kind in kinds]  # type: ignore[attr-defined]
    axes = frozenset().union(*varying)
    return [
        lax.pcast(array, tuple(axes - own), to="varying") if axes - own else array
        for array, own in zip(arrays, varying, strict=True)
    ]


def _pad_kernel(kernel: jax.Array) -> jax.Array:
    """Zeros for the channels that ``pad_channels`` adds, and outputs up to such a multiple."""
    if kernel.dtype.itemsize != 2:
        return kernel
    return jnp.pad(kernel, [(0, 0), (0, 0), *((0, -n % LIKED) for n in kernel.shape[2:])])


def fits_kernel(channels: int, outputs: int) -> bool:
    """Whether the Triton kernel for 3x3 convolutions is faster than cuDNN: 16-bit numbers, few channels, a GPU.

    Measured on an H100 (docs/guides/performance.md): with 48 inputs it is just as fast, activation aside.
    """
    return kernels.available() and current_itemsize() == 2 and channels <= 48 and outputs <= 32


@in_compute_dtype
def convolve_leaky(x: jax.Array, kernel: jax.Array, bias: jax.Array, slope: float) -> jax.Array:
    """Leaky ReLU of a 3x3 convolution with zero padding by one kernel; ask ``fits_kernel`` first.

    Args:
      x: ``[..., H, W, I]``.
      kernel: ``[3, 3, I, O]``.
      bias: ``[O]``.
      slope: of the leaky ReLU; 1 for none.
    """
    from essjax.networks.convolution_triton import convolve  # an optional package

    result = convolve(x.reshape(-1, *x.shape[-3:]), kernel, bias.astype(jnp.float32), slope)
    return result.reshape(*x.shape[:-1], kernel.shape[3])
