"""The network of DLCTUS (thesis 002 section 4.1.3, figure 5): how much of the new sample each output pixel takes.

All of it runs at a quarter of the output's size, whatever the upsampling factor: a 4x4 convolution with stride 4, four
residual blocks as in EDSR, and a pixel shuffle straight from the last block.
"""

import math

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import conv, crop, pad_to_multiple, replicated_conv
from essjax.networks.linen import from_linen, kernel_bound
from essjax.typing import Array, Image, Key
from essjax.warp import depth_to_space

BLOCK = 4
"""Output pixels per network pixel, in each dimension."""
WIDTH, RESIDUAL_BLOCKS = 32, 4


def _small_bound(key: Key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    """Uniform in +-1 / sqrt(fan-in), what PyTorch does: with He's noise the four blocks' sum leaves the clamp."""
    return kernel_bound(key, shape, dtype) / math.sqrt(6.0)


class DLCTUSNet(nn.Module):
    """78,112 parameters with the 8 input channels of the method."""

    @nn.compact
    def __call__(self, inputs: Image, train: bool = False) -> Image:
        """Return ``[B, H, W, 2]``, not clamped, from ``[B, H, W, C]``, both at output resolution."""
        height, width = inputs.shape[-3:-1]
        x = conv(WIDTH, BLOCK, BLOCK, padding="VALID", kernel_init=_small_bound)(pad_to_multiple(inputs, BLOCK))
        for block in range(RESIDUAL_BLOCKS):
            residual = nn.relu(replicated_conv(x, WIDTH, kernel_init=_small_bound))
            # The untrained outputs lie in the middle of the clamp, where they have a gradient.
            bias = 0.5 if block == RESIDUAL_BLOCKS - 1 else 0.0
            x = x + replicated_conv(residual, WIDTH, kernel_init=_small_bound, bias_init=nn.initializers.constant(bias))
        return crop(depth_to_space(x, BLOCK), height, width)


def dlctus_network() -> Network:
    """Make the network of DLCTUS."""
    return from_linen(DLCTUSNet())
