"""G-buffer guided warping (ExtraSS section 4.2, eq 1-3; SPEC 1).

Around the reprojected position 33 pixels of the previous frame are candidates; the four whose G-buffers and positions
fit best are blended. Selection works on packed integer keys: the bits of a non-negative float order like the float,
so the cost with its low 6 bits replaced by the candidate's number sorts by cost, ties by number. Costs that agree to
2^-17 count as ties. A network of minima and maxima, unrolled, finds the four best without indices, and their numbers
leave it as one integer per pixel: one loop over pixels that keeps everything in registers. The winners' weights are
then computed anew in full precision, which is also the only part that gradients see.
"""

from functools import partial

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
IMPLEMENTATIONS = ("network", "reference")


def candidate_offsets() -> np.ndarray:
    """The 33 offsets ``[33, 2]`` (x, y) of eq 1 in the order that breaks ties: centre, then by stride, row, column."""
    ring = [(s * k, s * l) for s in STRIDES for l in (-1, 0, 1) for k in (-1, 0, 1) if (k, l) != (0, 0)]  # noqa: E741
    return np.array([(0, 0), *ring], np.int32)


def guides(gbuffers: GBuffers) -> Image:
    """The guide of eq 2: base colour and normal, ``[..., H, W, 6]``."""
    return jnp.concatenate(surface_guides(gbuffers), axis=-1)


def _keys(guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> list[Array]:
    """The key of each of the 33 candidates, ``[H, W]``: cost bits, the low 6 its number."""
    height, width, channels = guide.shape
    # Costs are sums of squares of scaled differences. The border is +inf: a candidate there costs +inf and is never
    # usable, without any comparison of positions. One plane per channel, as gathers of single numbers are cheapest.
    scale = jnp.sqrt(0.5 * inverse)
    margin = 2 * _REACH + 1
    stride = width + 2 * margin
    planes = [
        jnp.pad(guide_previous[..., k] * scale[k], margin, constant_values=jnp.inf).reshape(-1) for k in range(channels)
    ]
    planes = jax.lax.optimization_barrier(planes)
    here = [guide[..., k] * scale[k] for k in range(channels)]
    target = pixel_positions(height, width) + motion
    # Beyond this clamp all candidates are outside already.
    x = jnp.clip(target[..., 0], -_REACH - 0.5, width + _REACH + 0.5)
    y = jnp.clip(target[..., 1], -_REACH - 0.5, height + _REACH + 0.5)
    column, row = jnp.floor(x), jnp.floor(y)
    start = (row.astype(jnp.int32) + margin) * stride + column.astype(jnp.int32) + margin
    fraction = (x - column - 0.5, y - row - 0.5)
    keys = []
    for candidate, offset in enumerate(candidate_offsets()):
        index = start + int(offset[1] * stride + offset[0])
        differences = [here[k] - gather_pixels(planes[k], index) for k in range(channels)]
        away = [scale[channels + k] * (fraction[k] - float(offset[k])) for k in range(2)]
        cost = jnp.asarray(sum(d * d for d in [*differences, *away]))
        bits = jax.lax.bitcast_convert_type(cost, jnp.int32) & ~_ID_MASK
        keys.append(jnp.where(cost < jnp.inf, bits, _UNUSABLE) | candidate)  # NaN is unusable too
    return keys


def _best_by_network(keys: list[Array]) -> list[Array]:
    """The four smallest, in order: each key in turn passes four minima."""
    best: list[Array] = [jnp.full_like(keys[0], np.iinfo(np.int32).max)] * WINNERS
    for key in keys:
        kept = []
        for other in best:
            kept.append(jnp.minimum(key, other))
            key = jnp.maximum(key, other)
        best = kept
    return best


def _best_by_sorting(keys: list[Array]) -> list[Array]:
    return list(jnp.sort(jnp.stack(keys), axis=0)[:WINNERS])


def _pack(best: list[Array]) -> Array:
    """Numbers of the winners, 6 bits each; ``_ID_MASK`` where the candidate cannot be used."""
    numbers = [jnp.where(key < _UNUSABLE, key & _ID_MASK, _ID_MASK) for key in best]
    return sum(number << (6 * rank) for rank, number in enumerate(numbers))  # type: ignore[return-value]


def _winner(packed: Array, rank: Array | int, motion: Array) -> tuple[Array, Array, Array]:
    """Of the winner of a rank: whether it can be used, its column and its row."""
    height, width = motion.shape[:2]
    number = (packed >> (6 * rank)) & _ID_MASK
    usable = number < _ID_MASK
    # Where nothing is usable this is the centre clamped to the image: the nearest border pixel.
    number = jnp.where(usable, number, 0)
    target = jnp.clip(pixel_positions(height, width) + motion, -_FAR, _FAR)
    center = jnp.floor(target).astype(jnp.int32)
    # Coordinate by coordinate: pairs would be written out.
    column, row = (center[..., k] + jnp.asarray(candidate_offsets()[:, k])[number] for k in range(2))
    return usable, jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1)


@jax.custom_batching.sequential_vmap
def _select_alone(guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> Array:
    """The network as a program of its own, for XLA:CPU.

    Fused with what reads its result it falls apart into gathers that are written out (20 times slower; jax 0.10 removes
    barriers too early to prevent that). A branch is a border that nothing is fused across. Its condition may not be
    batched, a batched branch would compute both sides; and it must not be known to the compiler.
    """
    height, width = motion.shape[:2]
    return jax.lax.cond(
        jnp.any(jnp.isfinite(motion)),
        lambda *arrays: _pack(_best_by_network(_keys(*arrays))),
        lambda *arrays: _pack([jnp.full((height, width), _UNUSABLE)] * WINNERS),
        guide_previous, guide, motion, inverse,
    )  # fmt: skip


def _select(implementation: str, *arrays: Array) -> Array:
    """Packed numbers of the four best candidates, ``[H, W]``; arguments of ``_keys``."""
    if implementation == "reference":
        return _pack(_best_by_sorting(_keys(*arrays)))
    if jax.default_backend() == "cpu":
        return _select_alone(*arrays)
    return jax.lax.optimization_barrier(_pack(_best_by_network(_keys(*arrays))))


def _weigh(
    guide_previous: Array, guide: Array, motion: Array, inverse: Array, *, implementation: str
) -> tuple[Array, tuple[Array, ...]]:
    """Weights ``[4, H, W]`` and pixel numbers, four of ``[H, W]``, of the winners; all that gradients pass through."""
    height, width, channels = guide.shape
    packed = _select(implementation, *jax.lax.stop_gradient((guide_previous, guide, motion, inverse)))
    rank = jnp.arange(WINNERS, dtype=jnp.int32)[:, None, None]
    usable, column, row = _winner(packed, rank, motion)
    flat, pixel = guide_previous.reshape(-1), row * width + column
    target = pixel_positions(height, width) + motion
    # Number by number: gathers of rows would be written out, these fuse.
    apart = [guide[..., k] - gather_pixels(flat, pixel * channels + k) for k in range(channels)]
    away = [target[..., 0] - column - 0.5, target[..., 1] - row - 0.5]
    squares = [inverse[k] * d * d for k, d in enumerate([*apart, *away])]
    # With all 33 unusable the first takes everything. A constant replaces the cost, so no gradient passes.
    unusable = jnp.where(rank == 0, 0.0, -jnp.inf)
    logits = jnp.where(usable, -0.5 * jnp.asarray(sum(squares)), unusable)
    # The pixels once more, rank by rank: four stacked planes would have to be written out, these fuse.
    winners = [_winner(packed, k, motion) for k in range(WINNERS)]
    return jax.nn.softmax(logits, axis=0), tuple(row * width + column for _, column, row in winners)


def _warp_one(radiance: Array, *arrays: Array, implementation: str) -> Array:
    weights, pixels = _weigh(*arrays, implementation=implementation)
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


def _run(kernel, images, guide_previous, guide, motion, sigma_guide, sigma_distance, implementation):
    if implementation not in IMPLEMENTATIONS:
        raise ValueError(f"implementation: expected one of {', '.join(IMPLEMENTATIONS)}, got {implementation!r}.")
    check_channels("guide", guide, None)
    size = guide.shape[-3:-1]
    for image in images:
        check_channels("radiance", image, None, size)
    check_channels("guide_previous", guide_previous, guide.shape[-1], size)
    check_channels("motion", motion, 2, size)
    inverse = _inverse_variances(sigma_guide, sigma_distance, guide.shape[-1])
    arrays = (*images, guide_previous.astype(jnp.float32), guide.astype(jnp.float32), motion.astype(jnp.float32))
    kernel = partial(kernel, implementation=implementation)
    return over_leading_axes(kernel, (3,) * len(arrays) + (1,), *arrays, inverse)


def gbuffer_guided_warp(
    radiance: Image,
    guide_previous: Image,
    guide: Image,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
    implementation: str = "network",
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
      implementation: of the selection. "network" is fast on every backend; "reference" sorts 33 stacked keys, needs 30
        times the memory, and chooses the same.

    Returns:
      ``[..., H, W, C]``.

    Raises:
      ValueError: sizes differ, ``sigma_guide`` is neither a number nor one per channel, or unknown implementation.
    """
    return _run(_warp_one, (radiance,), guide_previous, guide, motion, sigma_guide, sigma_distance, implementation)


def guided_weights(
    guide_previous: Image,
    guide: Image,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
    implementation: str = "network",
) -> tuple[Array, Array]:
    """What ``gbuffer_guided_warp`` blends: to look at, and to warp several images alike.

    Returns:
      Weights ``[..., H, W, 4]``, sum 1, best first, and pixel numbers ``[..., H, W, 4]`` (row * W + column) in the
      previous frame; a number whose weight is 0 has no meaning.
    """
    weights, pixels = _run(_weigh, (), guide_previous, guide, motion, sigma_guide, sigma_distance, implementation)
    return jnp.moveaxis(weights, -3, -1), jnp.stack(pixels, axis=-1)
