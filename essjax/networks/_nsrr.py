"""NSRR: supersampling from five frames at once, without recurrence (Xiao et al. 2020; thesis 002 section 3.2).

Three parts: features of every low-resolution frame, one net for the current frame and one shared by the previous ones;
weights for the previous frames, pixel by pixel; a U-Net at output resolution. Layer sizes are the paper's.
"""

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import Chain, bilinear_upsample, conv, crop, mean_pool, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen
from essjax.typing import Image

PREVIOUS = 4
"""Previous frames that the current one is reconstructed from."""
RGBD, LEARNED = 4, 8
FEATURES = RGBD + LEARNED
"""Channels of a frame's features: its colour and depth, then the learned ones."""


class Reweighting(nn.Module):
    """How much each previous frame is believed at each pixel, in (0, 10).

    Attributes:
      width: channels of the hidden layers.
    """

    width: int

    @nn.compact
    def __call__(self, rgbd: Image) -> Image:
        """Weights ``[B, H, W, PREVIOUS]`` from colour and depth of all five frames."""
        x = conv(PREVIOUS)(Chain((self.width, self.width))(rgbd))
        return 5.0 * (nn.tanh(x) + 1.0)


class Reconstruction(nn.Module):
    """The U-Net: three levels, ten convolutions.

    Attributes:
      width: channels of the skip at output resolution.
    """

    width: int

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return ``[B, H, W, 3]``."""
        width, (height, wide) = self.width, x.shape[-3:-1]
        fine = Chain((2 * width, width))(pad_to_multiple(x, 4))
        middle = Chain((2 * width, 2 * width))(mean_pool(fine))
        coarse = Chain((4 * width, 4 * width))(mean_pool(middle))
        middle = Chain((2 * width, 2 * width))(jnp.concatenate([bilinear_upsample(coarse), middle], axis=-1))
        fine = Chain((width,))(jnp.concatenate([bilinear_upsample(middle), fine], axis=-1))
        return crop(zero_conv(3)(fine), height, wide)


class NSRR(nn.Module):
    """All three parts; ``apply(..., method="current" | "previous" | "reconstruct")`` runs one.

    Attributes:
      width: 32 as published; the parts scale with it, not the number of features.
    """

    width: int = 32

    def setup(self):
        """Make both feature nets, the reweighting and the U-Net."""
        widths = (self.width, self.width, LEARNED)
        self.current_net, self.previous_net = Chain(widths), Chain(widths)
        self.reweighting = Reweighting(self.width)
        self.reconstruction = Reconstruction(self.width)

    def current(self, rgbd: Image, train: bool = False) -> Image:
        """Features ``[B, H, W, FEATURES]`` of a low-resolution frame ``[B, H, W, RGBD]`` that is reconstructed."""
        return jnp.concatenate([rgbd, self.current_net(rgbd)], axis=-1)

    def previous(self, rgbd: Image, train: bool = False) -> Image:
        """Do the same for a frame that later ones will look back at."""
        return jnp.concatenate([rgbd, self.previous_net(rgbd)], axis=-1)

    def reconstruct(self, current: Image, previous: Image, train: bool = False) -> tuple[Image, Image]:
        """Compute the output.

        Args:
          current: zero-upsampled features of the current frame, ``[B, sH, sW, FEATURES]``.
          previous: those of the previous ones, newest first, warped to it, ``[PREVIOUS, B, sH, sW, FEATURES]``.
          train: unused (no BatchNorm).

        Returns:
          ``[B, sH, sW, 3]`` and the weights of the previous frames ``[B, sH, sW, PREVIOUS]``.
        """
        rgbd = jnp.concatenate([current[..., :RGBD], *previous[..., :RGBD]], axis=-1)
        weights = self.reweighting(rgbd)
        weighted = [weights[..., k : k + 1] * previous[k] for k in range(PREVIOUS)]
        return self.reconstruction(jnp.concatenate([current, *weighted], axis=-1)), weights

    def __call__(self, rgbd: Image, current: Image, previous: Image, train: bool = False):
        """All parts: what ``init`` needs to make all parameters."""
        return self.current(rgbd), self.previous(rgbd), self.reconstruct(current, previous)


def nsrr(*, width: int = 32) -> Network:
    """NSRR as a ``Network``."""
    return from_linen(NSRR(width))
