"""ExtraSSNet: one U-Net for supersampled and extrapolated frames (ExtraSS section 4.4, eq 10).

Two encoders E0 (SS) and E1 (ESS), one decoder. All convolution runs at half of the output's size or below, which is LR
at twice the size: HR inputs come in by space-to-depth, the output leaves by depth-to-space. The head predicts, per HR
pixel, corrections to two logits (how to blend history and sample, how far to clamp history) and a residual, and starts
at zero, so that the untrained network returns the prior blend.
"""

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import ConvBlock, conv, crop, mean_pool, nearest_upsample, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen
from essjax.typing import Array, Callable, Image

LEVELS = 4
BLOCK = 2
"""Output pixels per pixel of its finest level, in each dimension."""
HEAD = 5
"""Outputs per HR pixel: blending logit, clamping logit, residual RGB."""


CONDITIONS = 4
"""Numbers that say how a frame differs from the paper's setting, see ``methods``; a network that never saw other than
zeros does not depend on them."""


class Encoder(nn.Module):
    """Four levels at sizes 1, 1/2, 1/4, 1/8 of the half grid; returns their features, finest first."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Image, conditions: Array) -> list[Image]:
        """Encode ``[B, H, W, C]`` under ``conditions`` ``[B, CONDITIONS]``; both sizes must be multiples of 8."""
        features = []
        for level, width in enumerate(self.widths):
            x = ConvBlock(width)(mean_pool(x) if level else x)
            shift = nn.Dense(width, use_bias=False, kernel_init=nn.initializers.zeros, name=f"conditions_{level}")
            x = x + shift(conditions)[..., None, None, :].astype(x.dtype)
            features.append(x)
        return features


class Decoder(nn.Module):
    """From coarse to fine, skips concatenated; returns the head's channels at the finest size.

    Attributes:
      widths: of the encoder's levels, finest first.
      channels: of the output.
      head: makes the last layer from ``channels``; by default it returns zero until trained.
    """

    widths: tuple[int, ...]
    channels: int
    head: Callable[[int], nn.Module] = zero_conv

    @nn.compact
    def __call__(self, features: list[Image]) -> Image:
        """Decode the encoder's levels to ``[B, H, W, channels]``."""
        x = features[-1]
        for level in reversed(range(len(self.widths) - 1)):
            reduced = conv(self.widths[level], 1)(x)  # before upsampling: a quarter of the work
            joined = jnp.concatenate([nearest_upsample(reduced), features[level]], axis=-1)
            x = ConvBlock(self.widths[level], layers=2 if level else 1)(joined)
        return self.head(self.channels)(x)


class ExtraSSNet(nn.Module):
    """Both encoders and the decoder.

    Attributes:
      width: channels on the half grid; the levels have 1, 1.5, 2 and 3 times as many.
    """

    width: int = 24

    def setup(self):
        """Make E0, E1 and D."""
        widths = (self.width, self.width * 3 // 2, self.width * 2, self.width * 3)
        self.encoder_ss = Encoder(widths)
        self.encoder_ess = Encoder(widths)
        self.decoder = Decoder(widths, HEAD * BLOCK**2)

    def _run(self, encoder: Encoder, inputs: Image, conditions: Array) -> tuple[Image, list[Image]]:
        height, width = inputs.shape[-3:-1]
        features = encoder(pad_to_multiple(inputs, 2 ** (LEVELS - 1)), conditions)
        return crop(self.decoder(features), height, width), features

    def render(self, inputs: Image, conditions: Array, train: bool = False) -> tuple[Image, list[Image]]:
        """SS: ``(head [B, H, W, HEAD * BLOCK^2], features of 4 levels)`` from E0's inputs."""
        return self._run(self.encoder_ss, inputs, conditions)

    def extrapolate(self, inputs: Image, conditions: Array, train: bool = False) -> tuple[Image, list[Image]]:
        """ESS: the same from E1's inputs."""
        return self._run(self.encoder_ess, inputs, conditions)

    def __call__(self, inputs_ss: Image, inputs_ess: Image, conditions: Array, train: bool = False):
        """Both paths: what ``init`` needs to make all parameters."""
        return self.render(inputs_ss, conditions), self.extrapolate(inputs_ess, conditions)


def extrassnet(*, width: int = 24) -> Network:
    """ExtraSSNet as a ``Network``; choose the path with ``apply(..., method="render" | "extrapolate")``."""
    return from_linen(ExtraSSNet(width))
