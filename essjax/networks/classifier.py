"""The classification and the composition network (Guo et al. 2022, supplementary section 1, figures 1 and 2).

Classifier: at half the output's resolution by space-to-depth, an encoder of four scales, all merged at its resolution
by depth-to-space, three pixelwise layers, six logits, bilinearly enlarged. Composition: two pixelwise layers.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import (
    ConvNorm,
    batch_norm,
    bilinear_upsample,
    conv,
    crop,
    max_pool,
    pad_to_multiple,
    zero_conv,
)
from essjax.networks.linen import from_linen
from essjax.typing import Image
from essjax.warp import depth_to_space, space_to_depth

SCALES = 4
LOGITS = 6
"""Three of ghosting, three of aliasing (``labels.GHOSTING``, ``labels.ALIASING``)."""

LOGIT_SCALE = 0.3
"""Standard deviation of the logits around their prior, before training."""


class Bottleneck(nn.Module):
    """1x1 convolution, depthwise 3x3, 1x1; BatchNorm and ReLU after the 1x1s only.

    Attributes:
      width: output channels, also those in between.
    """

    width: int

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """Return ``[B, H, W, width]``."""
        x = ConvNorm(self.width, 1)(x, train)
        x = conv(self.width, 3, feature_group_count=self.width)(x)
        return ConvNorm(self.width, 1)(x, train)


class Classifier(nn.Module):
    """Logits of the classes of every output pixel.

    Attributes:
      width: channels of the finest scale; they double from scale to scale. A multiple of 8.
      prior: the six logits before training.
    """

    width: int = 32
    prior: Sequence[float] = (0.0,) * LOGITS

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """``[B, H, W, C]`` at the output's resolution to ``[B, H, W, 6]``; any size (padded inside)."""
        height, width = x.shape[-3:-1]
        x = space_to_depth(pad_to_multiple(x, 2**SCALES), 2)
        merged = []
        for scale in range(SCALES):
            if scale:
                x = max_pool(x)
            x = Bottleneck(self.width * 2**scale)(x, train)
            part = x
            if scale < SCALES - 1:  # half of the channels to the decoder, half onward
                part, x = jnp.split(x, 2, axis=-1)
            merged.append(depth_to_space(part, 2**scale))
        x = jnp.concatenate(merged, axis=-1)
        for _ in range(3):
            x = ConvNorm(self.width, 1)(x, train)
        # A small scale: the first logits are near the prior. From zero it would take the optimiser hundreds of steps.
        scale = nn.initializers.constant(LOGIT_SCALE)
        last = batch_norm(train, scale_init=scale, bias_init=lambda *_: jnp.asarray(self.prior, jnp.float32))
        x = conv(LOGITS, 1)(x)
        logits = last(x)
        return crop(bilinear_upsample(logits), height, width)


class Composition(nn.Module):
    """Logit of the blending weight of every pixel, 0 before training; the caller adds a prior and takes the sigmoid.

    Attributes:
      width: of the hidden layer.
    """

    width: int = 64

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """``[B, H, W, C]`` to ``[B, H, W, 1]``."""
        x = nn.relu(conv(self.width, 1)(x))
        return zero_conv(1, 1)(x)


def classifier_network(*, width: int = 32, prior: Sequence[float] = (0.0,) * LOGITS) -> Network:
    """``apply(variables, inputs, train) -> (logits, state)``, at the output's resolution; see ``Classifier``.

    Args:
      width: channels of the finest of the four scales: 32 in the paper.
      prior: the six logits before training.

    Raises:
      ValueError: the width is not a multiple of 8, or there are not six logits.
    """
    if width < 8 or width % 8:
        raise ValueError(f"classifier width: expected a multiple of 8 (it is split in half and by 8), got {width}.")
    if len(prior) != LOGITS:
        raise ValueError(f"prior: expected {LOGITS} logits, got {len(prior)}.")
    return from_linen(Classifier(width, tuple(prior)))


def composition_network(*, width: int = 64) -> Network:
    """``apply(variables, inputs, train) -> (logit, state)``; see ``Composition``. 64 in the paper."""
    return from_linen(Composition(width))
