"""FRNet: flow that moves shading which geometry does not explain (ExtraSS section 4.3, eq 4).

The supplementary with its layers is not public. Ours is a coarse-to-fine flow decoder over a 3-level encoder as in
IFRNet (Kong et al. 2022), whose feature loss eq 8 follows; see docs/deviations.md.
"""

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import ConvBlock, bilinear_upsample, conv, crop, mean_pool, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen
from essjax.typing import Image, Plane
from essjax.warp import backward_warp

LEVELS = 3


class FRNet(nn.Module):
    """Flow from two warped rendered frames.

    Attributes:
      width: channels of the finest level; the levels have ``width``, ``1.5 width`` and ``2 width``.
    """

    width: int = 16

    def setup(self):
        """Make encoder levels and decoders, finest first."""
        widths = [self.width, self.width * 3 // 2, self.width * 2]
        self.levels = [ConvBlock(w) for w in widths]
        self.decoders = [ConvBlock(w) for w in widths]
        self.to_features = [conv(w) for w in widths]
        self.to_flow = [zero_conv(4) for _ in widths]

    def encode(self, image: Image, train: bool = False) -> list[Image]:
        """Features of images ``[..., h, w, 3]`` (log1p), finest first: sizes 1, 1/2, 1/4."""
        features = []
        x = pad_to_multiple(image, 2 ** (LEVELS - 1))
        for level, block in enumerate(self.levels):
            x = block(mean_pool(x) if level else x)
            features.append(x)
        return features

    def __call__(self, warped: Image, roughness: Plane, train: bool = False) -> dict:
        """Predict the flow that re-warps ``warped[0]``.

        Args:
          warped: f_g(i_{t-1}) and f_g(i_{t-3}), log1p, downsampled, ``[2, ..., h, w, 3]``.
          roughness: ``[..., h, w, 1]``.
          train: unused (no BatchNorm).

        Returns:
          ``flow`` ``[..., h, w, 2]`` in pixels of this size, current to warped; ``features``: three levels of what the
          network believes the current frame's encoder features to be (eq 8), finest first.
        """
        height, width = warped.shape[-3:-1]
        encoded = self.encode(warped)
        hints = [pad_to_multiple(roughness, 2 ** (LEVELS - 1))]
        for _ in range(LEVELS - 1):
            hints.append(mean_pool(hints[-1]))
        flows = jnp.zeros((*encoded[-1].shape[:-1], 2), warped.dtype)  # [2, ...]: to the newest, to the older frame
        coarser: list[Image] = []
        features: list[Image] = []
        for level in reversed(range(LEVELS)):
            if level < LEVELS - 1:
                flows = 2.0 * bilinear_upsample(flows)
                coarser = [bilinear_upsample(features[-1])]
            newest, older = backward_warp(encoded[level], flows)
            x = self.decoders[level](
                jnp.concatenate([newest, older, *coarser, flows[0], flows[1], hints[level]], axis=-1)
            )
            flows = flows + jnp.stack(jnp.split(self.to_flow[level](x), 2, axis=-1))
            features.append(self.to_features[level](x))
        return {"flow": crop(flows[0], height, width), "features": features[::-1]}


def frnet(width: int = 16) -> Network:
    """FRNet as a ``Network``; ``apply(..., method="encode")`` gives the encoder's features of an image."""
    return from_linen(FRNet(width))
