"""FASSET's networks (Qin et al., sections 3.2, 3.3): frame feature extractor and RenderINR.

Features are extracted at input size; RenderINR, a multilayer perceptron, is asked for each output pixel's colour, so
the output may have any size. All images are log(1 + x); widths are ours, the paper gives the MLP's and the total.
History comes in three ways, all of it already at this frame's pixels: the recurrent state of the frame encoder, the
last image at the samples, and the last image at output size.
"""

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks._extrassnet import Decoder
from essjax.networks.blocks import Chain, GatedConv, conv, crop, mean_pool, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen, kernel_bound
from essjax.networks.precision import dot_general
from essjax.sizes import ratios
from essjax.typing import Array, Color, Image, Jitter, Mask
from essjax.warp import jitter_aligned_upsample

MAX_WEIGHT = 2.0
"""Feature weights lie in (0, MAX_WEIGHT), so that 1, where they start, is in the middle of tanh."""
LEVELS = 3
OUTPUT_GAIN = 0.1
"""RenderINR's colour is scaled by this: its last layer starts at zero, so Adam's first steps move all its weights
the same way; unscaled, at a learning rate of 2e-3, the loss rises above the untrained network's at first."""
PAST = 4
"""Channels of the history at the samples: colour, and 1 where it showed the same surface."""
LOCAL = 5
"""Channels of what RenderINR is told of an output pixel itself: how the history differs there from what its colour is
added to (3), whether it showed the same surface, and how near a rendered sample is."""


class ConvGRU(nn.Module):
    """Gated recurrent unit of 3x3 convolutions (Ballas et al. 2016): hidden state and input to the new hidden state.

    Attributes:
      width: channels of both.
    """

    width: int

    @nn.compact
    def __call__(self, hidden: Image, x: Image) -> Image:
        """Return the new hidden state ``[B, H, W, width]`` in (-1, 1)."""
        gates = nn.sigmoid(conv(2 * self.width)(jnp.concatenate([hidden, x], axis=-1)))
        update, reset = jnp.split(gates, 2, axis=-1)
        candidate = nn.tanh(conv(self.width)(jnp.concatenate([reset * hidden, x], axis=-1)))
        return hidden + update * (candidate - hidden)


class FrameEncoder(nn.Module):
    """U-Net of lightweight gated convolutions with a recurrent module after its first three; section 3.3.

    The convolutions have BatchNorm, as ExtraNet's, from which the paper takes them: without it features shrink.

    Attributes:
      width: channels at input size and of the hidden state; deeper levels have 5/3 and 8/3 times as many.
      channels: of the feature map.
    """

    width: int
    channels: int

    @nn.compact
    def __call__(self, inputs: Image, hidden: Image, train: bool = False) -> tuple[Image, Image]:
        """Compute the feature map M ``[B, H, W, channels]`` and the new hidden state ``[B, H, W, width]``.

        Sizes must be multiples of 4.
        """
        widths = (self.width, self.width * 5 // 3, self.width * 8 // 3)
        x, features = inputs, []
        for level, width in enumerate(widths):
            x = mean_pool(x) if level else x
            for _ in range(2 if level else 3):
                x = GatedConv(width)(x, train)
            if level == 0:
                x = hidden = ConvGRU(width)(hidden, x)
            features.append(x)
        return Decoder(widths, self.channels, head=conv)(features), hidden


class GEncoder(nn.Module):
    """Three convolutions on albedo, depth and normal: the feature map M_G.

    Attributes:
      width: channels between.
      channels: of the feature map.
    """

    width: int
    channels: int

    @nn.compact
    def __call__(self, gbuffers: Image) -> Image:
        """Encode ``[B, H, W, 7]`` to ``[B, H, W, channels]``."""
        return conv(self.channels)(Chain((self.width, self.width))(gbuffers))


class Reweighting(nn.Module):
    """Three convolutions, tanh, scaled to (0, 2): one weight per pixel for each of the two feature maps.

    The last layer starts at zero: untrained, features pass as they are.

    Attributes:
      width: channels between.
    """

    width: int

    @nn.compact
    def __call__(self, frame: Image, gbuffers: Image) -> tuple[Mask, Mask]:
        """Weights ``[B, H, W, 1]`` for M and M_G."""
        x = Chain((self.width, self.width))(jnp.concatenate([frame, gbuffers], axis=-1))
        weights = MAX_WEIGHT / 2 * (1.0 + nn.tanh(zero_conv(2)(x)))
        return weights[..., :1], weights[..., 1:]


def dense(features: int, **options) -> nn.Dense:
    """Make a pixelwise layer in the networks' compute type."""
    return nn.Dense(features, dot_general=dot_general, **options)


class RenderINR(nn.Module):
    """f_theta of eq 1: three hidden layers, ReLU, linear output, evaluated at every output pixel.

    The pixel size has weights of its own that start at zero: a first layer on the concatenation, written as a sum.
    The last layer starts at zero, so that the untrained network returns what its output is added to.

    Attributes:
      hidden: neurons of each hidden layer.
    """

    hidden: int = 128

    @nn.compact
    def __call__(self, latents: Image, pixel_size: Array) -> tuple[Color, Mask]:
        """Colour to be added ``[B, h, w, 3]`` and share of the history ``[B, h, w, 1]`` in (-1, 1).

        Args:
          latents: z*, z_g* and what is known of the pixel itself, ``[B, h, w, C]``.
          pixel_size: a, ``[1]``, LR pixels.
        """
        x = dense(self.hidden, kernel_init=kernel_bound)(latents)
        x = x + dense(self.hidden, use_bias=False, kernel_init=nn.initializers.zeros, name="pixel_size")(pixel_size)
        for _ in range(2):
            x = dense(self.hidden, kernel_init=kernel_bound)(nn.relu(x))
        output = dense(4, kernel_init=nn.initializers.zeros)(nn.relu(x))
        # Below 1: what is added to the image comes back with the next one's history.
        return OUTPUT_GAIN * output[..., 1:], nn.tanh(output[..., :1])


class FASSET(nn.Module):
    """Feature extractor and RenderINR for both tasks.

    Attributes:
      width: of the encoders; each feature map has 3 channels fewer: <= 24 keeps RenderINR below 40 K parameters.
      hidden: neurons of RenderINR's layers.
      gencoder: without it RenderINR reads the G-buffers themselves (Table 4).
      shared: one FrameEncoder for both tasks, or one each (Table 4).
    """

    width: int = 24
    hidden: int = 128
    gencoder: bool = True
    shared: bool = True

    def setup(self):
        """Make the parts."""
        channels = self.width - 3
        self.frame_encoder = FrameEncoder(self.width, channels)
        if not self.shared:
            self.frame_encoder_ess = FrameEncoder(self.width, channels)
        if self.gencoder:
            self.gbuffer_encoder = GEncoder(self.width, channels)
        self.reweighting = Reweighting(self.width)
        # Recomputed in the backward pass: its activations, at output size, would be most of the memory.
        self.inr = nn.remat(RenderINR)(self.hidden)

    def _run(self, encoder: FrameEncoder, frame, mask, gbuffers, past, hidden, local, jitter, train: bool):
        height, width = mask.shape[-3:-1]
        where = jnp.broadcast_to(jitter[..., None, None, :], (*mask.shape[:-1], 2)).astype(frame.dtype)
        inputs = jnp.concatenate([frame, mask, gbuffers[..., 3:], past, where], axis=-1)
        padded = (pad_to_multiple(x, 2 ** (LEVELS - 1)) for x in (inputs, hidden))
        features, hidden = (crop(x, height, width) for x in encoder(*padded, train))
        surface = self.gbuffer_encoder(gbuffers) if self.gencoder else gbuffers
        weight, weight_surface = self.reweighting(frame, gbuffers)
        latents = jnp.concatenate([weight * features, weight_surface * surface], axis=-1)
        size = local.shape[-3:-1]
        queried = jnp.concatenate([jitter_aligned_upsample(latents, size, jitter), local], axis=-1)
        color, share = self.inr(queried, jnp.full((1,), 2.0 / sum(ratios((height, width), size)), latents.dtype))
        return color, share, hidden

    def render(
        self,
        frame: Image,
        mask: Mask,
        gbuffers: Image,
        past: Image,
        hidden: Image,
        local: Image,
        jitter: Jitter,
        train: bool = False,
    ) -> tuple[Color, Mask, Image]:
        """SS: colour to be added and share of the history, at output size, and the new hidden state.

        Args:
          frame: ``[B, H, W, 3]`` log1p, 0 in holes.
          mask: ``[B, H, W, 1]`` 1 valid, 0 hole.
          gbuffers: ``[B, H, W, 7]`` albedo, depth, normal.
          past: ``[B, H, W, PAST]`` the last image, log1p, read at this frame's samples, and whether to trust it.
          hidden: ``[B, H, W, width]`` at this frame's pixel centres.
          local: ``[B, H', W', LOCAL]``: its size is the output's.
          jitter: ``[B, 2]`` of this frame, LR pixels.
          train: BatchNorm by the batch's statistics.

        Returns:
          ``[B, H', W', 3]``, the same with 1 channel in (-1, 1), and ``[B, H, W, width]``.
        """
        return self._run(self.frame_encoder, frame, mask, gbuffers, past, hidden, local, jitter, train)

    def extrapolate(
        self,
        frame: Image,
        mask: Mask,
        gbuffers: Image,
        past: Image,
        hidden: Image,
        local: Image,
        jitter: Jitter,
        train: bool = False,
    ) -> tuple[Color, Mask, Image]:
        """ESS: the same from a warped frame."""
        encoder = self.frame_encoder if self.shared else self.frame_encoder_ess
        return self._run(encoder, frame, mask, gbuffers, past, hidden, local, jitter, train)

    def __call__(self, frame, mask, gbuffers, past, hidden, local, jitter, train: bool = False):
        """Both paths: what ``init`` needs to make all parameters."""
        inputs = (frame, mask, gbuffers, past, hidden, local, jitter)
        return self.render(*inputs), self.extrapolate(*inputs)


def fasset(*, width: int = 24, hidden: int = 128, gencoder: bool = True, shared: bool = True) -> Network:
    """FASSET as a ``Network``; choose the task with ``apply(..., method="render" | "extrapolate")``.

    Raises:
      ValueError: the width is below 4.
    """
    if width < 4:
        raise ValueError(f"FASSET's width: expected at least 4 (a feature map has width - 3 channels), got {width}.")
    return from_linen(FASSET(width, hidden, gencoder, shared))
