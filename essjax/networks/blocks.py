"""Pieces that the networks share. All images ``[B, H, W, C]``."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from essjax.networks.convolution import scan_friendly_convolution
from essjax.networks.linen import kernel_bound
from essjax.typing import Image


def pad_to_multiple(image: Image, multiple: int) -> Image:
    """Repeat the last row and column until both sizes are multiples; crop the output back with ``crop``."""
    height, width = image.shape[-3:-1]
    pad = [(0, 0)] * (image.ndim - 3) + [(0, -height % multiple), (0, -width % multiple), (0, 0)]
    return jnp.pad(image, pad, mode="edge")


def crop(image: Image, height: int, width: int) -> Image:
    """The top left ``height`` x ``width`` pixels: the inverse of ``pad_to_multiple``."""
    return image[..., :height, :width, :]


def mean_pool(image: Image, factor: int = 2) -> Image:
    """Box downsampling by a whole factor; the size must be a multiple of it."""
    *lead, height, width, channels = image.shape
    blocks = image.reshape(*lead, height // factor, factor, width // factor, factor, channels)
    return blocks.mean(axis=(-4, -2))


def nearest_upsample(image: Image, factor: int = 2) -> Image:
    """Repeat each pixel ``factor`` times in both directions."""
    return jnp.repeat(jnp.repeat(image, factor, axis=-3), factor, axis=-2)


def bilinear_upsample(image: Image, factor: int = 2) -> Image:
    """Bilinear upsampling, pixel centres at +0.5, borders replicated."""
    *lead, height, width, channels = image.shape
    return jax.image.resize(image, (*lead, height * factor, width * factor, channels), "linear")


def conv(features: int, size: int = 3, **options) -> nn.Conv:
    """A stride-1 convolution, ``size`` x ``size``, zero padding, whose gradient is fast inside a scan."""
    options = {"kernel_init": kernel_bound, **options}
    return nn.Conv(features, (size, size), conv_general_dilated=scan_friendly_convolution, **options)


def replicated_conv(x: Image, features: int, size: int = 3, **options) -> Image:
    """``conv`` with replicated borders; call it in a module's ``nn.compact`` method."""
    radius = size // 2
    pad = [(0, 0)] * (x.ndim - 3) + [(radius, radius), (radius, radius), (0, 0)]
    # Cropped from the zero-padded convolution of the larger image: its gradient is the fast one.
    wide = conv(features, size, **options)(jnp.pad(x, pad, mode="edge"))
    return wide[..., radius:-radius, radius:-radius, :] if radius else wide


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
            x = nn.leaky_relu(conv(self.width)(x), 0.1)
        return x


def zero_conv(channels: int) -> nn.Conv:
    """A 3x3 convolution that returns zero until it is trained: residuals and flows start at their prior."""
    return conv(channels, kernel_init=nn.initializers.zeros)
