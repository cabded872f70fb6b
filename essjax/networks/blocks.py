"""Pieces that the networks share. All images ``[B, H, W, C]``."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from essjax.networks.convolution import convolve_leaky, fits_kernel, scan_friendly_convolution
from essjax.networks.linen import kernel_bound
from essjax.typing import Array, Image


def pad_to_multiple(image: Image, multiple: int) -> Image:
    """Repeat the last row and column until both sizes are multiples; crop the output back with ``crop``."""
    below, right = (-size % multiple for size in image.shape[-3:-1])
    if below == right == 0:
        return image  # XLA does not see that padding by nothing changes nothing: it would copy, in the gradient as well
    pad = [(0, 0)] * (image.ndim - 3) + [(0, below), (0, right), (0, 0)]
    return jnp.pad(image, pad, mode="edge")


def crop(image: Image, height: int, width: int) -> Image:
    """Keep the top left ``height`` x ``width`` pixels: the inverse of ``pad_to_multiple``."""
    return image[..., :height, :width, :]


def mean_pool(image: Image, factor: int = 2) -> Image:
    """Box downsampling by a whole factor; the size must be a multiple of it."""
    *lead, height, width, channels = image.shape
    blocks = image.reshape(*lead, height // factor, factor, width // factor, factor, channels)
    return blocks.mean(axis=(-4, -2))


def max_pool(image: Image) -> Image:
    """Largest value of each 2 x 2 block, per channel; the sizes must be even.

    By comparisons: linen's is slow to differentiate on CPUs, and the gradient of ``jnp.max`` looks for the value that
    equals the maximum: where a compiler computes the two differently it finds none and divides by zero.
    """
    *lead, height, width, channels = image.shape
    blocks = image.reshape(*lead, height // 2, 2, width // 2, 2, channels)
    upper, lower = blocks[..., 0, :, :, :], blocks[..., 1, :, :, :]
    rows = jnp.where(upper > lower, upper, lower)
    return jnp.where(rows[..., 0, :] > rows[..., 1, :], rows[..., 0, :], rows[..., 1, :])


def nearest_upsample(image: Image, factor: int = 2) -> Image:
    """Repeat each pixel ``factor`` times in both directions."""
    return jnp.repeat(jnp.repeat(image, factor, axis=-3), factor, axis=-2)


def bilinear_upsample(image: Image) -> Image:
    """Twice the size by bilinear interpolation, pixel centres at +0.5, borders replicated."""
    for axis in (-3, -2):
        image = _double(image, axis, 0.25, 0.25)
    return image


def bilinear_upsample_corners(image: Image) -> Image:
    """Twice the size, corners on corners: output i reads i (n - 1) / (2 n - 1) (PyTorch's ``align_corners=True``)."""
    for axis in (-3, -2):
        size = image.shape[axis]
        index = jnp.arange(size, dtype=image.dtype).reshape(-1, *(1,) * (-1 - axis))
        image = _double(image, axis, index / (2 * size - 1), (size - 1 - index) / (2 * size - 1))
    return image


def _double(image: Image, axis: int, before: Array | float, after: Array | float) -> Image:
    """Twice the pixels along ``axis``; outputs 2k and 2k + 1 lie a little before and after input k.

    ``before`` is the share of input k - 1 in output 2k, ``after`` that of k + 1 in 2k + 1. Slices: the gradient of a
    gather is a scatter, and a resize as matrix products is as much work as the convolutions.
    """
    axis, size = axis % image.ndim, image.shape[axis]
    inner = [jax.lax.slice_in_dim(image, k, size - 1 + k, axis=axis) for k in (0, 1)]
    first, last = (jax.lax.slice_in_dim(image, k, k + 1, axis=axis) for k in (0, size - 1))
    previous, following = (jnp.concatenate(parts, axis) for parts in ([first, inner[0]], [inner[1], last]))
    pair = [image + before * (previous - image), image + after * (following - image)]
    shape = [2 * n if k == axis else n for k, n in enumerate(image.shape)]
    return jnp.stack(pair, axis=axis + 1).reshape(shape)


class Conv(nn.Conv):
    """linen's, and a leaky ReLU: by one kernel where that is faster.

    Attributes:
      slope: of the leaky ReLU; 1 for none.
    """

    slope: float = 1.0

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return ``[..., H / stride, W / stride, features]``."""
        channels, plain = x.shape[-1], self.strides == (1, 1) and self.padding == "SAME" and self.use_bias
        plain &= (
            self.feature_group_count == 1 and self.kernel_dilation in (1, None) and self.input_dilation in (1, None)
        )
        if plain and self.kernel_size == (3, 3) and fits_kernel(channels, self.features):
            kernel = self.param("kernel", self.kernel_init, (3, 3, channels, self.features), self.param_dtype)
            bias = self.param("bias", self.bias_init, (self.features,), self.param_dtype)
            return convolve_leaky(x, kernel, bias, self.slope)
        y = super().__call__(x)
        return y if self.slope == 1.0 else nn.leaky_relu(y, self.slope)


def conv(features: int, size: int = 3, stride: int = 1, **options) -> Conv:
    """Make a convolution, ``size`` x ``size``, zero padding, whose gradient is fast inside a scan.

    With a stride, ``(size - 1) // 2`` zeros on every side, as PyTorch networks do; give ``padding`` for other ones. The
    fast gradient then needs sizes that are multiples of the stride.
    """
    if stride > 1:
        options = {"padding": (size - 1) // 2, **options}
    options = {"kernel_init": kernel_bound, **options}
    return Conv(features, (size, size), (stride, stride), conv_general_dilated=scan_friendly_convolution, **options)


def batch_norm(train: bool, **options) -> nn.BatchNorm:
    """BatchNorm with PyTorch's defaults: eps 1e-5, running statistics that move by 0.1 towards each batch's."""
    return nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=1e-5, **options)


class ConvNorm(nn.Module):
    """Convolution, BatchNorm, ReLU; its parts are ``Conv_0`` and ``BatchNorm_0``.

    Attributes:
      width: output channels.
      size: of the kernel.
      stride: see ``conv``.
    """

    width: int
    size: int = 3
    stride: int = 1

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """Return ``[B, H / stride, W / stride, width]``."""
        return nn.relu(batch_norm(train)(conv(self.width, self.size, self.stride)(x)))


class GatedConv(nn.Module):
    """Lightweight gated convolution: sigma(M) * F with a mask M of one channel (ExtraNet section 4.3, eq 1-3).

    M is the last output channel of ``Conv_0``: one convolution reads the input once. ``BatchNorm_0`` and a ReLU follow
    if ``norm``.

    Attributes:
      width: output channels.
      size: of the kernel.
      stride: see ``conv``.
      norm: BatchNorm and ReLU after the gate.
    """

    width: int
    size: int = 3
    stride: int = 1
    norm: bool = True

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """Return ``[B, H / stride, W / stride, width]``."""
        both = conv(self.width + 1, self.size, self.stride)(x)
        x = nn.sigmoid(both[..., -1:]) * both[..., :-1]
        return nn.relu(batch_norm(train)(x)) if self.norm else x


def replicated_conv(x: Image, features: int, size: int = 3, **options) -> Image:
    """``conv`` with replicated borders; call it in a module's ``nn.compact`` method."""
    radius = size // 2
    pad = [(0, 0)] * (x.ndim - 3) + [(radius, radius), (radius, radius), (0, 0)]
    # Cropped from the zero-padded convolution of the larger image: its gradient is the fast one.
    wide = conv(features, size, **options)(jnp.pad(x, pad, mode="edge"))
    return wide[..., radius:-radius, radius:-radius, :] if radius else wide


class Chain(nn.Module):
    """3x3 convolutions, each followed by a ReLU.

    Attributes:
      widths: output channels of each.
    """

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return ``[B, H, W, widths[-1]]``."""
        for width in self.widths:
            x = nn.relu(conv(width)(x))
        return x


class ConvBlock(nn.Module):
    """``layers`` 3x3 convolutions, each followed by a leaky ReLU.

    Attributes:
      width: output channels.
      layers: number of convolutions.
    """

    width: int
    layers: int = 2

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return features ``[B, H, W, width]``."""
        for _ in range(self.layers):
            x = conv(self.width, slope=0.1)(x)
        return x


def zero_conv(channels: int, size: int = 3) -> Conv:
    """Make a convolution that returns zero until it is trained: residuals and flows start at their prior."""
    return conv(channels, size, kernel_init=nn.initializers.zeros)
