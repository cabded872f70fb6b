"""IFRNet: interpolation between two images by intermediate flow and an intermediate feature (Kong et al. 2022).

A four-level encoder of both images; from coarse to fine, decoders refine the flows from the wanted image to both and
guess its features; the finest blends both warped images under a mask and adds a residual. This is the published 2x
model, whose time is always halfway, but for two things: transposed convolutions are 3x3 convolutions followed by
depth-to-space (which contain them), and flows start from a prior that the caller gives (docs/deviations.md).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.networks.blocks import bilinear_upsample, conv, crop, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen
from essjax.typing import Array, Image
from essjax.warp import backward_warp, depth_to_space

LEVELS = 4


class PReLU(nn.Module):
    """A leaky ReLU whose slope is learned for every channel."""

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return ``[..., H, W, C]``."""
        slope = self.param("slope", nn.initializers.constant(0.25), (x.shape[-1],), jnp.float32)
        return jnp.where(x >= 0, x, slope.reshape((1,) * (x.ndim - 1) + (-1,)) * x)


class Interlaced(nn.Module):
    """Residual block of five 3x3 convolutions, the second and fourth of which see and change the last channels only.

    Attributes:
      side: number of those channels.
    """

    side: int

    @nn.compact
    def __call__(self, x: Image) -> Image:
        """Return ``[B, H, W, C]``."""
        width, y = x.shape[-1], x
        for _ in range(2):
            y = PReLU()(conv(width)(y))
            y = jnp.concatenate([y[..., : -self.side], PReLU()(conv(self.side)(y[..., -self.side :]))], axis=-1)
        return PReLU()(x + conv(width)(y))


class Decoder(nn.Module):
    """One level; its output is twice as large.

    Attributes:
      hidden: channels of the convolutions.
      side: see ``Interlaced``.
      refined: outputs that start at zero (flow residuals; at the finest level also mask and residual).
      features: channels of the intermediate feature; 0: none.
    """

    hidden: int
    side: int
    refined: int
    features: int

    @nn.compact
    def __call__(self, x: Image) -> tuple[Image, Image | None]:
        """Return ``[B, 2 H, 2 W, refined]`` and ``[B, 2 H, 2 W, features]``."""
        x = Interlaced(self.side)(PReLU()(conv(self.hidden)(x)))
        refined = depth_to_space(zero_conv(4 * self.refined)(x), 2)
        return refined, depth_to_space(conv(4 * self.features)(x), 2) if self.features else None


def _both(refined: Image) -> Image:
    """Take the flows to the earlier and to the later image, ``[2, ..., H, W, 2]``, from a decoder's outputs."""
    return jnp.stack([refined[..., :2], refined[..., 2:4]])


class IFRNet(nn.Module):
    """Encoder and decoders.

    Attributes:
      width: channels of the finest level, which is half the image's size; the levels have 1, 1.5, 2.25 and 3 times as
        many. 24 is the published small model, 32 the standard one.
    """

    width: int = 24

    def setup(self):
        """Make encoder levels and decoders, finest first."""
        widths = [self.width, self.width * 3 // 2, self.width * 9 // 4, self.width * 3]
        self.halving = [conv(w, stride=2) for w in widths]
        self.keeping = [conv(w) for w in widths]
        self.slopes = [[PReLU(), PReLU()] for _ in widths]
        hidden = [3 * w for w in widths[:-1]] + [2 * widths[-1]]
        self.decoders = [
            Decoder(hidden[level], self.width, 4 if level else 8, widths[level - 1] if level else 0)
            for level in range(LEVELS)
        ]

    def encode(self, image: Image, train: bool = False) -> list[Image]:
        """Features of images ``[..., h, w, 3]``, finest first: sizes 1/2, 1/4, 1/8, 1/16."""
        features, x = [], pad_to_multiple(image, 2**LEVELS)
        for halve, keep, (first, second) in zip(self.halving, self.keeping, self.slopes, strict=True):
            x = second(keep(first(halve(x))))
            features.append(x)
        return features

    def __call__(self, images: Image, prior: Array, train: bool = False) -> dict:
        """Interpolate halfway.

        Args:
          images: the earlier and the later one, log1p, ``[2, ..., h, w, 3]``.
          prior: ``[2, ..., 2]`` (x, y) pixels, flow from the wanted image to both that is known beforehand.
          train: unused (no BatchNorm).

        Returns:
          ``image`` ``[..., h, w, 3]``, log1p; ``flow`` ``[2, ..., h, w, 2]`` from it to both, pixels, with the prior;
          ``mask`` ``[..., h, w, 1]``, the earlier image's share; ``features``: what the network believes the wanted
          image's encoder features to be, sizes 1/2, 1/4, 1/8; ``mean`` ``[..., 1, 1, 1]`` of both images, which the
          encoder sees taken off.
        """
        height, width = images.shape[-3:-1]
        mean = jnp.mean(images, axis=(0, -3, -2, -1))[..., None, None, None]
        images = pad_to_multiple(images - mean, 2**LEVELS)
        encoded = self.encode(images)
        prior = jax.lax.stop_gradient(prior)[..., None, None, :]
        refined, guess = self.decoders[-1](jnp.concatenate([*encoded[-1]], axis=-1))
        flow, features = _both(refined), []
        for level in reversed(range(LEVELS - 1)):
            features.append(guess)
            total = flow + prior / 2 ** (level + 1)
            inputs = [guess, *backward_warp(encoded[level], total), *total]
            refined, guess = self.decoders[level](jnp.concatenate(inputs, axis=-1))
            flow = 2.0 * bilinear_upsample(flow) + _both(refined)
        flow = flow + prior
        earlier, later = backward_warp(images, flow)
        mask = nn.sigmoid(refined[..., 4:5])
        image = later + mask * (earlier - later) + refined[..., 5:] + mean
        return {
            "image": crop(image, height, width),
            "flow": crop(flow, height, width),
            "mask": crop(mask, height, width),
            "features": features[::-1],
            "mean": mean,
        }


def ifrnet(*, width: int = 24) -> Network:
    """IFRNet as a ``Network``; ``apply(..., method="encode")`` gives the encoder's features of images."""
    return from_linen(IFRNet(width))
