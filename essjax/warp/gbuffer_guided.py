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
from essjax.frames import GBuffers, surface_guides
from essjax.typing import Array, Image, Motion
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.sampling import gather_pixels

STRIDES = (1, 3, 5, 9)
WINNERS = 4
SIGMA_GUIDE = (0.1, 0.1, 0.1, 0.2, 0.2, 0.2)
"""Base colour, normal: a starting value measured on a path-traced clip; the paper gives none."""
SIGMA_DISTANCE = 2.0
_ID_MASK = 63  # 6 bits hold a candidate's number
_UNUSABLE = np.int32(0x7F800000)  # bits of +inf: above the key of every finite cost
_REACH = max(STRIDES)
_FAR = 1e6  # pixels; keeps integers from overflowing
_ROWS_PER_BLOCK = 16


def candidate_offsets() -> np.ndarray:
    """The 33 offsets ``[33, 2]`` (x, y) of eq 1 in the order that breaks ties: centre, then by stride, row, column."""
    ring = [(s * k, s * l) for s in STRIDES for l in (-1, 0, 1) for k in (-1, 0, 1) if (k, l) != (0, 0)]  # noqa: E741
    return np.array([(0, 0), *ring], np.int32)


def guides(gbuffers: GBuffers) -> Image:
    """The guide of eq 2: base colour and normal, ``[..., H, W, 6]``."""
    return jnp.concatenate(surface_guides(gbuffers), axis=-1)


def _select(guide_previous: Array, guide: Array, x: Array, y: Array, inverse: Array) -> tuple[Array, ...]:
    """Keys of the best candidates, four of ``[H, W]``, best first: cost bits, the low 6 a candidate's number."""
    height, width, channels = guide.shape
    # Costs are sums of squares of scaled differences. The border is +inf: a candidate there costs +inf and is never
    # usable, without any comparison of positions. One plane per channel, as gathers of single numbers are cheapest.
    scale = jnp.sqrt(0.5 * inverse)
    margin = 2 * _REACH + 1
    stride = width + 2 * margin
    planes = [
        jnp.pad(guide_previous[..., k] * scale[k], margin, constant_values=jnp.inf).reshape(-1) for k in range(channels)
    ]
    offsets = jnp.asarray(candidate_offsets())
    steps = offsets[:, 1] * stride + offsets[:, 0]
    # Beyond this clamp all candidates are outside already.
    x, y = jnp.clip(x, -_REACH - 0.5, width + _REACH + 0.5), jnp.clip(y, -_REACH - 0.5, height + _REACH + 0.5)

    def select_row(x, y, here):
        column, row = jnp.floor(x), jnp.floor(y)
        start = (row.astype(jnp.int32) + margin) * stride + column.astype(jnp.int32) + margin
        fraction = (x - column - 0.5, y - row - 0.5)

        def keep_best(candidate, best):
            index = start + steps[candidate]
            differences = [here[k] - gather_pixels(planes[k], index) for k in range(channels)]
            away = [scale[channels + k] * (fraction[k] - offsets[candidate, k]) for k in range(2)]
            cost = jnp.asarray(sum(d * d for d in [*differences, *away]))
            bits = jax.lax.bitcast_convert_type(cost, jnp.int32) & ~_ID_MASK
            key = jnp.where(cost < jnp.inf, bits, _UNUSABLE) | candidate  # NaN is unusable too
            key = jax.lax.optimization_barrier(key)  # else XLA computes it again for each of the four minima
            kept = []
            for other in best:
                kept.append(jnp.minimum(key, other))
                key = jnp.maximum(key, other)
            return tuple(kept)

        worst = jnp.full(start.shape, np.iinfo(np.int32).max, jnp.int32)
        return jax.lax.fori_loop(0, len(candidate_offsets()), keep_best, (worst,) * WINNERS)

    here = jnp.moveaxis(guide * scale[:channels], -1, 1)  # [H, G, W]
    # Blocks of rows stay in the cache during the 33 passes.
    return jax.lax.map(lambda row: select_row(*row), (x, y, here), batch_size=_ROWS_PER_BLOCK)


def _weigh(
    guide_previous: Array, guide: Array, motion: Array, inverse: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Weights and pixel numbers of the winners, four of ``[H, W]`` each; all that gradients pass through."""
    height, width, channels = guide.shape
    target = pixel_positions(height, width) + motion
    x, y = target[..., 0], target[..., 1]
    keys = _select(*jax.lax.stop_gradient((guide_previous, guide, x, y, inverse)))
    center_x, center_y = (jnp.floor(jnp.clip(v, -_FAR, _FAR)).astype(jnp.int32) for v in (x, y))
    flat = guide_previous.reshape(-1)
    offsets = jnp.asarray(candidate_offsets())
    logits, pixels = [], []
    for rank, key in enumerate(keys):
        usable = key < _UNUSABLE
        # Where nothing is usable this is the centre clamped to the image: the nearest border pixel.
        candidate = jnp.where(usable, key & _ID_MASK, 0)
        column = jnp.clip(center_x + offsets[candidate, 0], 0, width - 1)
        row = jnp.clip(center_y + offsets[candidate, 1], 0, height - 1)
        pixel = row * width + column
        # Number by number: gathers of rows would be written out, these fuse.
        apart = [guide[..., k] - gather_pixels(flat, pixel * channels + k) for k in range(channels)]
        squares = [inverse[k] * d * d for k, d in enumerate([*apart, x - column - 0.5, y - row - 0.5])]
        # With all 33 unusable the first takes everything. A constant replaces the cost, so no gradient passes.
        logits.append(jnp.where(usable, -0.5 * jnp.asarray(sum(squares)), 0.0 if rank == 0 else -jnp.inf))
        pixels.append(pixel)
    return tuple(jax.nn.softmax(jnp.stack(logits), axis=0)), tuple(pixels)


def _warp_one(radiance: Array, guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> Array:
    weights, pixels = _weigh(guide_previous, guide, motion, inverse)
    flat = radiance.reshape(-1, radiance.shape[-1])
    values = [gather_pixels(flat, pixel).astype(jnp.float32) for pixel in pixels]
    total = sum(weight[..., None] * value for weight, value in zip(weights, values, strict=True))
    return jnp.asarray(total).astype(radiance.dtype)


def _inverse_variances(sigma_guide, sigma_distance, channels: int) -> Array:
    sigma_guide = jnp.asarray(sigma_guide, jnp.float32)
    if sigma_guide.ndim > 1 or (sigma_guide.ndim == 1 and sigma_guide.shape[0] != channels):
        raise ValueError(
            f"sigma_guide: expected one number or one for each of the {channels} guide channels, got shape "
            f"{sigma_guide.shape}."
        )
    distance = jnp.broadcast_to(jnp.asarray(sigma_distance, jnp.float32), (2,))
    return 1.0 / jnp.concatenate([jnp.broadcast_to(sigma_guide, (channels,)), distance]) ** 2


def _run(kernel, images, guide_previous, guide, motion, sigma_guide, sigma_distance):
    check_channels("guide", guide, None)
    size = guide.shape[-3:-1]
    for image in images:
        check_channels("radiance", image, None, size)
    check_channels("guide_previous", guide_previous, guide.shape[-1], size)
    check_channels("motion", motion, 2, size)
    inverse = _inverse_variances(sigma_guide, sigma_distance, guide.shape[-1])
    arrays = (*images, guide_previous.astype(jnp.float32), guide.astype(jnp.float32), motion.astype(jnp.float32))
    return over_leading_axes(kernel, (3,) * len(arrays) + (1,), *arrays, inverse)


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
    return _run(_warp_one, (radiance,), guide_previous, guide, motion, sigma_guide, sigma_distance)


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
    weights, pixels = _run(_weigh, (), guide_previous, guide, motion, sigma_guide, sigma_distance)
    return jnp.stack(weights, axis=-1), jnp.stack(pixels, axis=-1)
