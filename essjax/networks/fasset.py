"""FASSET's networks (Qin et al., sections 3.2, 3.3): frame feature extractor and RenderINR.

Features are extracted at input size; RenderINR, a multilayer perceptron, is asked for each output pixel's colour, so
the output may have any size. All images are log(1 + x); widths are ours, the paper gives the MLP's and the total.
"""

import flax.linen as nn
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import Chain, GatedConv, conv, crop, mean_pool, pad_to_multiple
from essjax.networks.extrassnet import Decoder
from essjax.networks.linen import from_linen, kernel_bound
from essjax.networks.precision import dot_general
from essjax.typing import Array, Image, Jitter, Mask
from essjax.warp import jitter_aligned_upsample

MAX_WEIGHT = 10.0
"""Feature weights lie in (0, MAX_WEIGHT)."""
_UNIT_WEIGHT = -1.0986123  # MAX_WEIGHT / 2 * (1 + tanh(this)) = 1
LEVELS = 3
OUTPUT_GAIN = 0.1
"""RenderINR's output is scaled by this: its last layer starts at zero, so Adam's first steps move all its weights
the same way; unscaled, at a learning rate of 2e-3, the loss rises above the untrained network's at first."""


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

    Attributes:
      width: channels of the feature map and at input size; deeper levels have 5/3 and 8/3 times as many.
    """

    width: int

    @nn.compact
    def __call__(self, inputs: Image, hidden: Image) -> tuple[Image, Image]:
        """The feature map M and the new hidden state, both ``[B, H, W, width]``; sizes must be multiples of 4."""
        widths = (self.width, self.width * 5 // 3, self.width * 8 // 3)
        x, features = inputs, []
        for level, width in enumerate(widths):
            x = mean_pool(x) if level else x
            for _ in range(2 if level else 3):
                x = nn.relu(2.0 * GatedConv(width, norm=False)(x))  # a fresh gate passes half
            if level == 0:
                x = hidden = ConvGRU(width)(hidden, x)
            features.append(x)
        return Decoder(widths, self.width, head=conv)(features), hidden


class GEncoder(nn.Module):
    """Three convolutions on albedo, depth and normal: the feature map M_G.

    Attributes:
      width: channels.
    """

    width: int

    @nn.compact
    def __call__(self, gbuffers: Image) -> Image:
        """Encode ``[B, H, W, 7]`` to ``[B, H, W, width]``."""
        return conv(self.width)(Chain((self.width, self.width))(gbuffers))


class Reweighting(nn.Module):
    """Three convolutions, tanh, scaled to (0, 10): one weight per pixel for each of the two feature maps.

    The last layer starts at zero weights and a bias that makes 1: untrained, features pass as they are.

    Attributes:
      width: channels between.
    """

    width: int

    @nn.compact
    def __call__(self, frame: Image, gbuffers: Image) -> tuple[Mask, Mask]:
        """Weights ``[B, H, W, 1]`` for M and M_G."""
        x = Chain((self.width, self.width))(jnp.concatenate([frame, gbuffers], axis=-1))
        last = conv(2, kernel_init=nn.initializers.zeros, bias_init=nn.initializers.constant(_UNIT_WEIGHT))
        weights = MAX_WEIGHT / 2 * (1.0 + nn.tanh(last(x)))
        return weights[..., :1], weights[..., 1:]


def dense(features: int, **options) -> nn.Dense:
    """A pixelwise layer in the networks' compute type."""
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
    def __call__(self, latents: Image, pixel_size: Array) -> Image:
        """Colour ``[B, h, w, 3]`` from latents z*, z_g* ``[B, h, w, C]`` and the pixel size a, ``[1]``, LR pixels."""
        x = dense(self.hidden, kernel_init=kernel_bound)(latents)
        x = x + dense(self.hidden, use_bias=False, kernel_init=nn.initializers.zeros, name="pixel_size")(pixel_size)
        for _ in range(2):
            x = dense(self.hidden, kernel_init=kernel_bound)(nn.relu(x))
        return OUTPUT_GAIN * dense(3, kernel_init=nn.initializers.zeros)(nn.relu(x))


class FASSET(nn.Module):
    """Feature extractor and RenderINR for both tasks.

    Attributes:
      scale: output size over input size, any positive number.
      width: channels of each feature map; <= 24 keeps RenderINR below 40 K parameters.
      hidden: neurons of RenderINR's layers.
      gencoder: without it RenderINR reads the G-buffers themselves (Table 4).
      shared: one FrameEncoder for both tasks, or one each (Table 4).
    """

    scale: float = 2
    width: int = 24
    hidden: int = 128
    gencoder: bool = True
    shared: bool = True

    def setup(self):
        """Make the parts."""
        self.frame_encoder = FrameEncoder(self.width)
        if not self.shared:
            self.frame_encoder_ess = FrameEncoder(self.width)
        if self.gencoder:
            self.gbuffer_encoder = GEncoder(self.width)
        self.reweighting = Reweighting(self.width)
        # Recomputed in the backward pass: its activations, at output size, would be most of the memory.
        self.inr = nn.remat(RenderINR)(self.hidden)

    def _run(self, encoder: FrameEncoder, frame: Image, mask: Mask, gbuffers: Image, hidden: Image, jitter: Jitter):
        height, width = mask.shape[-3:-1]
        inputs = jnp.concatenate([frame, mask, gbuffers[..., 3:]], axis=-1)
        features, hidden = (
            crop(x, height, width) for x in encoder(*(pad_to_multiple(x, 2 ** (LEVELS - 1)) for x in (inputs, hidden)))
        )
        surface = self.gbuffer_encoder(gbuffers) if self.gencoder else gbuffers
        weight, weight_surface = self.reweighting(frame, gbuffers)
        latents = jnp.concatenate([weight * features, weight_surface * surface], axis=-1)
        queried = jitter_aligned_upsample(latents, self.scale, jitter)
        return self.inr(queried, jnp.full((1,), 1.0 / self.scale, latents.dtype)), hidden

    def render(
        self, frame: Image, mask: Mask, gbuffers: Image, hidden: Image, jitter: Jitter, train: bool = False
    ) -> tuple[Image, Image]:
        """SS: the residual ``[B, round(scale H), round(scale W), 3]`` and the new hidden state ``[B, H, W, width]``.

        Args:
          frame: ``[B, H, W, 3]`` log1p, 0 in holes.
          mask: ``[B, H, W, 1]`` 1 valid, 0 hole.
          gbuffers: ``[B, H, W, 7]`` albedo, depth, normal.
          hidden: ``[B, H, W, width]`` at this frame's samples.
          jitter: ``[B, 2]`` of this frame, LR pixels.
          train: unused.
        """
        return self._run(self.frame_encoder, frame, mask, gbuffers, hidden, jitter)

    def extrapolate(
        self, frame: Image, mask: Mask, gbuffers: Image, hidden: Image, jitter: Jitter, train: bool = False
    ) -> tuple[Image, Image]:
        """ESS: the same from a warped frame."""
        encoder = self.frame_encoder if self.shared else self.frame_encoder_ess
        return self._run(encoder, frame, mask, gbuffers, hidden, jitter)

    def __call__(self, frame, mask, gbuffers, hidden, jitter, train: bool = False):
        """Both paths: what ``init`` needs to make all parameters."""
        inputs = (frame, mask, gbuffers, hidden, jitter)
        return self.render(*inputs), self.extrapolate(*inputs)


def fasset(
    scale: float = 2, *, width: int = 24, hidden: int = 128, gencoder: bool = True, shared: bool = True
) -> Network:
    """FASSET as a ``Network``; choose the task with ``apply(..., method="render" | "extrapolate")``."""
    return from_linen(FASSET(scale, width, hidden, gencoder, shared))
