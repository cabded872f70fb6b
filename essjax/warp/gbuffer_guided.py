"""G-buffer guided warping (ExtraSS section 4.2, eq 1-3; SPEC 1).

Around the reprojected position 33 pixels of the previous frame are candidates; the four whose G-buffers and positions
fit best are blended. Selection works on packed integer keys: the bits of a non-negative float order like the float,
so the cost with its low 6 bits replaced by the candidate's number sorts by cost, ties by number, and four running
minima of one integer each need no indices. Costs that agree to 2^-17 count as ties. The winners' weights are then
computed anew in full precision, which is also the only part that gradients see.
"""

import jax
import jax.numpy as jnp
import numpy as np

from essjax.cameras import pixel_positions
from essjax.frames import GBuffers
from essjax.typing import Array, Image, Motion
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.sampling import gather_pixels

STRIDES = (1, 3, 5, 9)
WINNERS = 4
SIGMA_GUIDE = (0.1, 0.1, 0.1, 0.2, 0.2, 0.2)
"""Base colour, normal: a starting value measured on a path-traced clip; the paper gives none."""
SIGMA_DISTANCE = 4.0
_ID_BITS = 6
_ID_MASK = (1 << _ID_BITS) - 1
_MAX_COST = np.float32(1e30)  # finite, so that a candidate that fits terribly still beats one outside the image
_OUTSIDE = np.int32(0x7F800000)  # bits of +inf: above the key of every finite cost


def candidate_offsets() -> np.ndarray:
    """The 33 offsets ``[33, 2]`` (x, y) of eq 1 in the order that breaks ties: centre, then by stride, row, column."""
    ring = [(s * k, s * l) for s in STRIDES for l in (-1, 0, 1) for k in (-1, 0, 1) if (k, l) != (0, 0)]  # noqa: E741
    return np.array([(0, 0), *ring], np.int32)


def guides(gbuffers: GBuffers) -> Image:
    """The guide of eq 2: base colour and normal, ``[..., H, W, 6]``."""
    return jnp.concatenate([gbuffers.base_color, gbuffers.normal], axis=-1)


def _cost(guide_previous: list[Array], guide: list[Array], index: Array, away: list[Array], inverse: Array) -> Array:
    """Minus the logarithm of eq 2's weight, without constants: half squared distances over variances."""
    differences = [g - gather_pixels(p, index) for g, p in zip(guide, guide_previous, strict=True)]
    squares = [0.5 * inverse[k] * d * d for k, d in enumerate([*differences, *away])]
    total = jnp.asarray(sum(squares))
    return jnp.where(total < _MAX_COST, total, _MAX_COST)  # NaN included: it would sort anywhere


def _guided_one(
    radiance: Array, guide_previous: Array, guide: Array, motion: Array, inverse: Array
) -> tuple[Array, Array, Array]:
    height, width, channels = radiance.shape
    offsets = jnp.asarray(candidate_offsets())
    # Clamped far outside: every candidate is outside there anyway, and the integers below must not overflow.
    reach = 4.0 * max(STRIDES)
    target = pixel_positions(height, width) + motion
    x = jnp.clip(target[..., 0].reshape(-1), -reach, width + reach)
    y = jnp.clip(target[..., 1].reshape(-1), -reach, height + reach)
    center_x, center_y = jnp.floor(x).astype(jnp.int32), jnp.floor(y).astype(jnp.int32)
    # One plane per channel: gathers of single numbers fuse, gathers of rows would be written out.
    planes = [guide_previous[..., k].reshape(-1) for k in range(guide.shape[-1])]
    here = [guide[..., k].reshape(-1) for k in range(guide.shape[-1])]

    def locate(candidate):
        offset = offsets[candidate]
        column, row = center_x + offset[..., 0], center_y + offset[..., 1]
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1), inside

    def cost(candidate, x, y, planes, here, inverse):
        column, row, inside = locate(candidate)
        away = [x - column - 0.5, y - row - 0.5]
        return _cost(planes, here, row * width + column, away, inverse), inside

    frozen = jax.lax.stop_gradient((x, y, planes, here, inverse))

    def keep_best(candidate, best):
        value, inside = cost(candidate, *frozen)
        bits = jax.lax.bitcast_convert_type(value, jnp.int32)
        key = jnp.where(inside, bits & ~_ID_MASK, _OUTSIDE) | candidate
        kept = []
        for other in best:
            kept.append(jnp.minimum(key, other))
            key = jnp.maximum(key, other)
        return tuple(kept)

    worst = jnp.full(x.shape, np.iinfo(np.int32).max, jnp.int32)
    best = jax.lax.fori_loop(0, len(candidate_offsets()), keep_best, (worst,) * WINNERS)

    logits, pixels = [], []
    for rank, key in enumerate(best):
        candidate = key & _ID_MASK
        value, _ = cost(jnp.minimum(candidate, len(candidate_offsets()) - 1), x, y, planes, here, inverse)
        usable = key < _OUTSIDE
        column, row, _ = locate(jnp.where(usable, candidate, 0))  # the centre, clamped: the nearest border pixel
        # All 33 outside: the first takes it all. The constant replaces the value, so no gradient passes.
        logits.append(jnp.where(usable, -value, 0.0 if rank == 0 else -jnp.inf))
        pixels.append(row * width + column)
    weights = jax.nn.softmax(jnp.stack(logits), axis=0)
    flat = radiance.reshape(-1, channels)
    blended = sum(w[:, None] * gather_pixels(flat, i).astype(jnp.float32) for w, i in zip(weights, pixels, strict=True))
    result = blended.astype(radiance.dtype).reshape(radiance.shape)  # type: ignore[union-attr]
    shape = (height, width, WINNERS)
    return result, weights.T.reshape(shape), jnp.stack(pixels, axis=-1).reshape(shape)


def _inverse_variances(sigma_guide, sigma_distance, channels: int) -> Array:
    sigma_guide = jnp.asarray(sigma_guide, jnp.float32)
    if sigma_guide.ndim > 1 or (sigma_guide.ndim == 1 and sigma_guide.shape[0] != channels):
        raise ValueError(
            f"sigma_guide: expected one number or one for each of the {channels} guide channels, got shape "
            f"{sigma_guide.shape}."
        )
    distance = jnp.broadcast_to(jnp.asarray(sigma_distance, jnp.float32), (2,))
    return 1.0 / jnp.concatenate([jnp.broadcast_to(sigma_guide, (channels,)), distance]) ** 2


def _run(radiance, guide_previous, guide, motion, sigma_guide, sigma_distance):
    check_channels("radiance", radiance, None)
    size = radiance.shape[-3:-1]
    check_channels("guide", guide, None, size)
    check_channels("guide_previous", guide_previous, guide.shape[-1], size)
    check_channels("motion", motion, 2, size)
    inverse = _inverse_variances(sigma_guide, sigma_distance, guide.shape[-1])
    return over_leading_axes(
        _guided_one, (3, 3, 3, 3, 1), radiance, guide_previous.astype(jnp.float32), guide.astype(jnp.float32), motion,
        inverse,
    )  # fmt: skip


def gbuffer_guided_warp(
    radiance: Image,
    guide_previous: Image,
    guide: Image,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
) -> Image:
    """Blend, of 33 pixels around the reprojected position, the four whose G-buffers fit best (ExtraSS eq 1-3).

    A candidate is a real pixel, the one that contains the reprojected position plus an offset; its distance term uses
    its centre's distance to the fractional position, its guide is fetched without interpolation. Weights are a softmax
    of log-weights, so they are finite where all Gaussians underflow. Candidates outside the image are excluded; where
    all are, the nearest border pixel is used. Ties: centre first, then by stride, row, column.

    Differentiable with respect to radiance, guides, motion and sigmas through the weights; the selection is
    piecewise constant.

    Args:
      radiance: ``[..., H, W, C]`` of the previous frame, demodulated (``color.demodulate``) for the paper's method.
      guide_previous: ``[..., H, W, G]`` of the previous frame, see ``guides``; finite.
      guide: ``[..., H, W, G]`` of the current frame.
      motion: ``[..., H, W, 2]`` pixels, the jitter difference included (``jittered_motion``).
      sigma_guide: one number, or one per guide channel (the default is for ``guides``), > 0.
      sigma_distance: pixels, > 0.

    Returns:
      ``[..., H, W, C]``.

    Raises:
      ValueError: sizes differ, or ``sigma_guide`` is neither a number nor one per channel.
    """
    return _run(radiance, guide_previous, guide, motion, sigma_guide, sigma_distance)[0]


def guided_weights(
    guide_previous: Image,
    guide: Image,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
) -> tuple[Array, Array]:
    """What ``gbuffer_guided_warp`` blends: to look at, and to warp several images alike.

    Returns:
      Weights ``[..., H, W, 4]``, sum 1, best first, and pixel numbers ``[..., H, W, 4]`` (row * W + column) in the
      previous frame; a number whose weight is 0 has no meaning.
    """
    nothing = jnp.zeros((*motion.shape[-3:-1], 0))
    return _run(nothing, guide_previous, guide, motion, sigma_guide, sigma_distance)[1:]
