"""FRNet: flow that moves shading which geometry does not explain (ExtraSS section 4.3, eq 4).

The supplementary with its layers is not public. Ours is a coarse-to-fine flow decoder over a 3-level encoder as in
IFRNet (Kong et al. 2022), whose feature loss eq 8 follows; it corrects a flow found by matching on smooth surfaces,
where mirror images and highlights move. See docs/deviations.md.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import sum_channels
from essjax.interfaces import Network
from essjax.networks.blocks import ConvBlock, bilinear_upsample, conv, crop, mean_pool, pad_to_multiple, zero_conv
from essjax.networks.linen import from_linen
from essjax.typing import Array, Image, Plane
from essjax.warp import backward_warp

LEVELS = 3
OFFSETS = np.stack(np.meshgrid(*2 * [np.arange(-1.0, 1.5, 0.5)]), axis=-1).reshape(-1, 2).astype(np.float32)
"""Flows that ``matched_flow`` tries, (x, y) half-size pixels per rendered frame; multiples of 0.5."""
REACH = 7
"""Half-size pixels that a frame is read away at most: a flow of 1 over 7 frames, the older one's age at one in four."""
PATCH = 7
"""Side of the squares whose match is judged, half-size pixels."""
TEMPERATURE = 0.003
"""Difference of costs (log1p radiance) that matters."""
COST_PER_PIXEL, SMOOTH, COST_OF_ROUGHNESS = 0.005, 0.25, 100.0
"""Cost of a flow's length, and how it grows with roughness beyond ``SMOOTH``: shading of rough surfaces stays there."""


def matched_flow(warped: Image, roughness: Plane, ages: Array) -> Image:
    """Where shading that moves evenly came from, by matching the two warped frames; nothing to learn.

    What is at x now was at x + a f in a frame of a frames ago. Every f of ``OFFSETS`` is judged by the mean absolute
    difference over a square, and the mean weighted by a softmax is taken.

    Args:
      warped: the newest and the older frame, warped by geometry, log1p, ``[2, ..., h, w, 3]``.
      roughness: ``[..., h, w, 1]``.
      ages: of the two, in frames, ``[2, ...]``: 1 and 3 where every other frame is rendered.

    Returns:
      f, ``[..., h, w, 2]`` pixels of this size per frame; no gradient.
    """
    size = (warped.shape[-3], warped.shape[-2])
    newest, older = (_halfway(image) for image in jax.lax.stop_gradient(warped))
    price = COST_PER_PIXEL * (1.0 + COST_OF_ROUGHNESS * jnp.maximum(roughness - SMOOTH, 0.0))[..., 0]
    means = []
    for offset in OFFSETS:
        difference = jnp.abs(_read(newest, ages[0], offset, size) - _read(older, ages[1], offset, size))
        means.append(jnp.asarray(sum_channels(difference)[..., 0]) / difference.shape[-1])
    lengths = np.linalg.norm(OFFSETS, axis=-1).reshape(-1, *(1,) * price.ndim)
    costs = _box(jnp.stack(means)) + price * lengths
    # A softmax, term by term: reductions over an axis that is not the last are slow on XLA:CPU.
    weights = jnp.exp((jnp.min(costs, axis=0) - costs) / TEMPERATURE)
    total, *flow = (
        sum(factor * weight for factor, weight in zip(factors.tolist(), weights, strict=True))
        for factors in (np.ones(len(OFFSETS)), *OFFSETS.T)
    )
    return jax.lax.stop_gradient(jnp.stack([component / total for component in flow], axis=-1))


def _halfway(image: Image) -> Array:
    """Read the padded image, borders replicated, at each half pixel: ``[2, 2, ...]``, half a pixel down, and right."""
    lead = [(0, 0)] * (image.ndim - 3)
    padded = jnp.pad(image, [*lead, (REACH, REACH + 1), (REACH, REACH + 1), (0, 0)], mode="edge")
    whole, down = padded[..., :-1, :, :], 0.5 * (padded[..., :-1, :, :] + padded[..., 1:, :, :])
    halves = [[rows[..., :-1, :], 0.5 * (rows[..., :-1, :] + rows[..., 1:, :])] for rows in (whole, down)]
    return jnp.stack([jnp.stack(row) for row in halves])


def _read(halves: Array, age: Array, offset: np.ndarray, size: tuple[int, int]) -> Array:
    """Take from ``_halfway`` every pixel ``age * offset`` away, rounded to half a pixel, at most ``REACH``.

    Args:
      halves: ``[2, 2, ..., h + 2 REACH, w + 2 REACH, C]``.
      age: ``[...]``.
      offset: (x, y).
      size: h, w.
    """
    lead, channels = age.shape, halves.shape[-1]
    places = jnp.clip(jnp.round(2.0 * (age[..., None] * jnp.asarray(offset) + REACH)), 0, 4 * REACH).astype(jnp.int32)

    def read(halves: Array, place: Array) -> Array:
        start = (place[1] % 2, place[0] % 2, place[1] // 2, place[0] // 2, jnp.int32(0))  # one type, with 64 bits too
        return jax.lax.dynamic_slice(halves, start, (1, 1, *size, channels))[0, 0]

    flat = halves.reshape(2, 2, -1, *halves.shape[-3:])
    return jax.vmap(read, in_axes=(2, 0))(flat, places.reshape(-1, 2)).reshape(*lead, *size, channels)


def _box(values: jax.Array) -> jax.Array:
    """Mean over ``PATCH`` x ``PATCH`` of ``[..., h, w]``, borders replicated."""
    reach = PATCH // 2
    values = jnp.pad(values, [(0, 0)] * (values.ndim - 2) + [(reach, reach)] * 2, mode="edge")
    for axis in (-2, -1):
        size = values.shape[axis] - PATCH + 1
        parts = [jax.lax.slice_in_dim(values, k, k + size, axis=axis % values.ndim) for k in range(PATCH)]
        values = sum(parts[1:], start=parts[0])
    return values / PATCH**2


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

    def __call__(self, warped: Image, roughness: Plane, ages: Array, train: bool = False) -> dict:
        """Predict the flow that re-warps ``warped[0]``.

        Args:
          warped: the two latest rendered frames, f_g(i_{t-1}) and f_g(i_{t-3}) where every other frame is rendered;
            log1p, downsampled, ``[2, ..., h, w, 3]``.
          roughness: ``[..., h, w, 1]``.
          ages: how many frames ago those were rendered, ``[2, ...]``; flows grow with them.
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
        matched = [matched_flow(pad_to_multiple(warped, 2 ** (LEVELS - 1)), hints[0], ages)]
        for _ in range(LEVELS - 1):
            matched.append(0.5 * mean_pool(matched[-1]))
        flows = jnp.zeros(
            (*encoded[-1].shape[:-1], 2), warped.dtype
        )  # [2, ...]: corrections for newest and older frame
        coarser: list[Image] = []
        features: list[Image] = []
        for level in reversed(range(LEVELS)):
            if level < LEVELS - 1:
                flows = 2.0 * bilinear_upsample(flows)
                coarser = [bilinear_upsample(features[-1])]
            total = flows + ages[..., None, None, None] * matched[level]
            # Warps of their own, else a GPU computes each read's place again for every channel.
            newest, older = jax.lax.optimization_barrier(backward_warp(encoded[level], total))
            x = self.decoders[level](
                jnp.concatenate([newest, older, *coarser, total[0], total[1], hints[level]], axis=-1)
            )
            flows = flows + jnp.stack(jnp.split(self.to_flow[level](x), 2, axis=-1))
            features.append(self.to_features[level](x))
        return {
            "flow": crop(ages[0, ..., None, None, None] * matched[0] + flows[0], height, width),
            "features": features[::-1],
        }


def frnet(*, width: int = 16) -> Network:
    """FRNet as a ``Network``; ``apply(..., method="encode")`` gives the encoder's features of an image."""
    return from_linen(FRNet(width))
