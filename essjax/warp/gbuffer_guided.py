"""G-buffer guided warping (ExtraSS section 4.2, eq 1-3; SPEC 1).

Around the reprojected position 33 pixels of the previous frame are candidates; the four whose G-buffers and positions
fit best are blended. Selection works on packed keys: the cost with the low 6 of its bits replaced by the candidate's
number sorts by cost, ties by number. Costs that agree to 2^-17 count as ties. A network of minima and maxima, unrolled,
finds the four best without indices, and their numbers leave it as one integer per pixel: one loop over pixels that
keeps everything in registers. The winners' weights are then computed anew in full precision, which is also the only
part that gradients see.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from essjax import kernels
from essjax.frames import GBuffers
from essjax.typing import Array, Guide, Image, Motion
from essjax.warp._batch import check_channels, over_leading_axes
from essjax.warp.candidates import BORDER, FAR, LEAST, LIMIT, MARGIN, REACH, UNUSABLE, candidate_offsets
from essjax.warp.depth_guides import depth_guide, normals_from_depth
from essjax.warp.sampling import gather_pixels

WINNERS = 4
_SORT_FOUR = ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2))
_SORT_BITONIC = ((0, 2), (1, 3), (0, 1), (2, 3))
SIGMA_GUIDE = (0.15, 0.15, 0.15, 0.14, 0.14, 0.14)
"""Base colour, normal: chosen on validation frames (experiments/LOG.md); the paper gives none."""
SIGMA_DISTANCE = 2.0
_ID_MASK = 63  # 6 bits hold a candidate's number
_LEAST_SIGMA = 1e-13  # smaller ones count as this: costs stay finite
SELECTIONS = ("network", "reference")
IMPLEMENTATIONS = ("auto", *SELECTIONS, "triton")


def guides(gbuffers: GBuffers) -> Guide:
    """Make the guide of eq 2: base colour and normal, ``[..., H, W, 6]``.

    Where they are absent depth stands in: its logarithm for base colour, normals that are estimated from it.
    """
    base = depth_guide(gbuffers.depth) if gbuffers.base_color is None else gbuffers.base_color
    normal = normals_from_depth(gbuffers.depth) if gbuffers.normal is None else gbuffers.normal
    return jnp.concatenate([base, normal], axis=-1)


def _smaller(a: Array, b: Array) -> Array:
    """Take the minimum of numbers that are not NaN: one instruction, where ``jnp.minimum`` takes care of NaN."""
    return jnp.where(a < b, a, b)


def _larger(a: Array, b: Array) -> Array:
    return jnp.where(a < b, b, a)


def _sort_pairs(keys: list[Array], *pairs: tuple[int, int]) -> list[Array]:
    """Compare and exchange, pair by pair."""
    keys = list(keys)
    for i, j in pairs:
        keys[i], keys[j] = _smaller(keys[i], keys[j]), _larger(keys[i], keys[j])
    return keys


def _coordinates(motion: Array) -> tuple[Array, Array]:
    """Reprojected x and y, ``[H, W]`` each: pairs would be written out."""
    size = motion.shape[:2]
    x, y = (jax.lax.broadcasted_iota(jnp.float32, size, axis) + 0.5 for axis in (1, 0))
    return x + motion[..., 0], y + motion[..., 1]


def _scaled(image: Array, scale: Array, instead: float) -> list[Array]:
    """Planes of guides in units of their sigmas (times the root of 2); ``instead`` of what can match nothing."""
    planes = [image[..., k] * scale[k] for k in range(image.shape[-1])]
    return [jnp.where(jnp.abs(plane) < LIMIT, plane, instead) for plane in planes]


def _keys(guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> list[Array]:
    """Make a key per candidate, 33 times ``[H, W]``: the bits of its cost, the low 6 its number, read as a float."""
    height, width, channels = guide.shape
    # Costs are sums of squares of scaled differences. The border is so far from every guide that a candidate there is
    # never usable, without any comparison of positions; so is what is not finite. One plane per channel, as gathers of
    # single numbers are cheapest.
    scale = jnp.sqrt(0.5 * inverse)
    stride = width + 2 * MARGIN
    planes = [jnp.pad(p, MARGIN, constant_values=BORDER).reshape(-1) for p in _scaled(guide_previous, scale, BORDER)]
    planes = jax.lax.optimization_barrier(planes)
    here = _scaled(guide, scale, -BORDER)
    x, y = _coordinates(motion)
    # Beyond this clamp all candidates are outside already.
    x = jnp.clip(x, -REACH - 0.5, width + REACH + 0.5)
    y = jnp.clip(y, -REACH - 0.5, height + REACH + 0.5)
    column, row = jnp.floor(x), jnp.floor(y)
    start = (row.astype(jnp.int32) + MARGIN) * stride + column.astype(jnp.int32) + MARGIN
    fraction = (x - column - 0.5, y - row - 0.5)
    keys = []
    for candidate, offset in enumerate(candidate_offsets()):
        index = start + int(offset[1] * stride + offset[0])
        away = [scale[channels + k] * (fraction[k] - float(offset[k])) for k in range(2)]
        apart = [here[k] - gather_pixels(planes[k], index) for k in range(channels)]
        cost = jnp.asarray(sum((d * d for d in [*away, *apart]), start=LEAST))
        bits = jax.lax.bitcast_convert_type(cost, jnp.int32) & ~_ID_MASK
        keys.append(jax.lax.bitcast_convert_type(bits | candidate, jnp.float32))
    return keys


def _best_by_network(keys: list[Array]) -> list[Array]:
    """Find the four smallest, in order: fours are sorted and merged, dropping the larger half."""
    best, rest = keys[:WINNERS], keys[WINNERS:]
    best = _sort_pairs(best, *_SORT_FOUR)
    while rest:
        four, rest = rest[:WINNERS], rest[WINNERS:]
        if len(four) == WINNERS:
            # Rising, then falling: the smaller of each pair are the four smallest, and half sorted.
            four = _sort_pairs(four, *_SORT_FOUR)[::-1]
            best = _sort_pairs([_smaller(a, b) for a, b in zip(best, four, strict=True)], *_SORT_BITONIC)
        else:
            for key in four:
                best = _sort_pairs([*best, key], *((rank, WINNERS) for rank in range(WINNERS)))[:WINNERS]
    return best


def _best_by_sorting(keys: list[Array]) -> list[Array]:
    return list(jnp.sort(jnp.stack(keys), axis=0)[:WINNERS])


def _pack(best: list[Array]) -> Array:
    """Numbers of the winners, 6 bits each; ``_ID_MASK`` where the candidate cannot be used."""
    bits = [jax.lax.bitcast_convert_type(key, jnp.int32) & _ID_MASK for key in best]
    numbers = [jnp.where(key < UNUSABLE, number, _ID_MASK) for key, number in zip(best, bits, strict=True)]
    return sum(number << (6 * rank) for rank, number in enumerate(numbers))  # type: ignore[return-value]


def _winner(packed: Array, rank: Array | int, motion: Array) -> tuple[Array, Array, Array]:
    """Tell of the winner of a rank whether it can be used, its column and its row."""
    number = (packed >> (6 * rank)) & _ID_MASK
    usable = number < _ID_MASK
    # Where nothing is usable this is the centre clamped to the image: the nearest border pixel.
    number = jnp.where(usable, number, 0)
    place = []
    for k, coordinate in enumerate(_coordinates(motion)):
        center = jnp.floor(jnp.clip(coordinate, -FAR, FAR)).astype(jnp.int32)
        offset = gather_pixels(jnp.asarray(candidate_offsets()[:, k]), number)
        place.append(jnp.clip(center + offset, 0, motion.shape[1 - k] - 1))
    return usable, place[0], place[1]


@jax.custom_batching.sequential_vmap
def _select_alone(guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> Array:
    """Run the network as a program of its own, for XLA:CPU.

    Fused with what reads its result it falls apart into gathers that are written out (20 times slower; jax 0.10 removes
    barriers too early to prevent that). A branch is a border that nothing is fused across. Its condition may not be
    batched, a batched branch would compute both sides; and it must not be known to the compiler.
    """
    arrays = guide_previous, guide, motion, inverse
    return jax.lax.cond(jnp.any(jnp.isfinite(motion)), _select_some, _select_nothing, *arrays)


# Functions of the module, not lambdas: called eagerly, ``cond`` compiles new ones again.
def _select_some(*arrays: Array) -> Array:
    return _pack(_best_by_network(_keys(*arrays)))


def _select_nothing(*arrays: Array) -> Array:
    """Return the constant for no winner, plus a zero that varies like the arrays, as shard_map wants of branches."""
    zero = sum(jnp.max(array).astype(jnp.int32) for array in arrays) * 0
    return _pack([jnp.full(arrays[2].shape[:2], jnp.inf, jnp.float32)] * WINNERS) + zero


def _select(implementation: str, *arrays: Array) -> Array:
    """Packed numbers of the four best candidates, ``[H, W]``; arguments of ``_keys``."""
    if implementation == "reference":
        return _pack(_best_by_sorting(_keys(*arrays)))
    if kernels.backend() == "cpu":
        return _select_alone(*arrays)
    return jax.lax.optimization_barrier(_pack(_best_by_network(_keys(*arrays))))


def _weigh(
    packed: Array, guide_previous: Array, guide: Array, motion: Array, inverse: Array
) -> tuple[Array, tuple[Array, ...]]:
    """Weights ``[4, H, W]`` and pixel numbers, four of ``[H, W]``, of the winners; all that gradients pass through."""
    height, width, channels = guide.shape
    rank = jnp.arange(WINNERS, dtype=jnp.int32)[:, None, None]
    usable, column, row = _winner(packed, rank, motion)
    flat, pixel = guide_previous.reshape(-1), row * width + column
    # Number by number: gathers of rows would be written out, these fuse.
    apart = [guide[..., k] - gather_pixels(flat, pixel * channels + k) for k in range(channels)]
    x, y = _coordinates(motion)
    apart = [jnp.where(usable, d, 0.0) for d in (*apart, x - column - 0.5, y - row - 0.5)]  # else NaN times 0 is NaN
    squares = [inverse[k] * d * d for k, d in enumerate(apart)]
    # With all 33 unusable the first takes everything. A constant replaces the cost, so no gradient passes.
    unusable = jnp.where(rank == 0, jnp.float32(0.0), -jnp.inf)
    logits = jnp.where(usable, -0.5 * jnp.asarray(sum(squares)), unusable)
    # A softmax term by term: a reduction over four planes is slow on XLA:CPU.
    top = jax.lax.stop_gradient(functools.reduce(_larger, logits))
    exponentials = [jnp.exp(logit - top) for logit in logits]
    total = jnp.asarray(sum(exponentials))
    weights = jnp.stack([exponential / total for exponential in exponentials])
    # The pixels once more, rank by rank: four stacked planes would have to be written out, these fuse.
    winners = [_winner(packed, k, motion) for k in range(WINNERS)]
    # The barrier halves the time: without it every channel of the image computes the weights again.
    return jax.lax.optimization_barrier(weights), tuple(row * width + column for _, column, row in winners)


def _blend(packed: Array, radiance: Array, *arrays: Array) -> Array:
    """Blend the image from packed winners and all that gradients pass through."""
    weights, pixels = _weigh(packed, *arrays)
    flat = radiance.reshape(-1, radiance.shape[-1])
    values = [gather_pixels(flat, pixel).astype(jnp.float32) for pixel in pixels]
    total = sum(weight[..., None] * value for weight, value in zip(weights, values, strict=True))
    return jnp.asarray(total).astype(radiance.dtype)


@jax.custom_jvp
def _kernel(radiance: Array, guide_previous: Array, guide: Array, motion: Array, inverse: Array) -> tuple[Array, Array]:
    """Run the Triton kernel on one image: the warped image, and which candidates won (as ``_select``)."""
    from essjax.warp.gbuffer_guided_triton import guided  # an optional package

    scale = jnp.sqrt(0.5 * inverse)
    planes = _scaled(guide_previous, scale, BORDER)
    planes += [jnp.zeros_like(planes[0])] * (len(planes) % 2)
    pairs = jnp.stack([jnp.stack(planes[k : k + 2], axis=-1) for k in range(0, len(planes), 2)])
    planes = jnp.pad(pairs, [(0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)], constant_values=BORDER)
    image, packed = guided(*(array[None] for array in (radiance, planes, guide, motion, scale)))
    return image[0], packed[0]


@_kernel.defjvp
def _derivative(primals, tangents):
    image, packed = _kernel(*primals)  # by this rule again where derivatives are differentiated
    tangent = jax.jvp(functools.partial(_blend, packed), primals, tangents)[1]
    return (image, packed), (tangent, np.zeros(packed.shape, jax.dtypes.float0))


def _chosen(implementation: str, known: tuple[str, ...] = IMPLEMENTATIONS) -> str:
    """Choose the implementation that is used.

    Raises:
      ValueError: not one of ``known``, or it cannot run here.
    """
    if implementation not in known:
        raise ValueError(f"implementation: expected one of {', '.join(known)}, got {implementation!r}.")
    if implementation == "triton" and not kernels.available():
        raise ValueError(
            f"implementation: 'triton' needs a GPU and the package jax-triton, and JAX runs on "
            f"{kernels.backend()}. Install essjax[gpu], or leave the choice to 'auto'."
        )
    return ("triton" if kernels.available() else "network") if implementation == "auto" else implementation


def _inverse_variances(sigma_guide, sigma_distance, channels: int) -> Array:
    sigma_guide = jnp.asarray(sigma_guide, jnp.float32)
    if sigma_guide.ndim > 1 or (sigma_guide.ndim == 1 and sigma_guide.shape[0] != channels):
        raise ValueError(
            f"sigma_guide: expected one number or one for each of the {channels} guide channels, got shape "
            f"{sigma_guide.shape}."
        )
    distance = jnp.broadcast_to(jnp.asarray(sigma_distance, jnp.float32), (2,))
    sigmas = jnp.concatenate([jnp.broadcast_to(sigma_guide, (channels,)), distance])
    return 1.0 / jnp.maximum(sigmas, _LEAST_SIGMA) ** 2


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
    guide_previous: Guide,
    guide: Guide,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
    implementation: str = "auto",
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
      implementation: "network" runs on every backend; "triton" is one kernel for GPUs, needs ``jax-triton``; "auto"
        takes that where it runs, else the network; "reference" sorts 33 stacked keys, needs 30 times the memory. All
        choose the same.

    Returns:
      ``[..., H, W, C]``.

    Raises:
      ValueError: sizes differ, ``sigma_guide`` is neither a number nor one per channel, or the implementation is
        unknown or cannot run here.
    """
    chosen = _chosen(implementation)

    def warp(radiance, *arrays):
        if chosen == "triton":
            return _kernel(radiance, *arrays)[0]
        return _blend(_select(chosen, *jax.lax.stop_gradient(arrays)), radiance, *arrays)

    return _run(warp, (radiance,), guide_previous, guide, motion, sigma_guide, sigma_distance)


def guided_weights(
    guide_previous: Guide,
    guide: Guide,
    motion: Motion,
    *,
    sigma_guide: float | Array | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float | Array = SIGMA_DISTANCE,
    implementation: str = "network",
) -> tuple[Array, Array]:
    """Return what ``gbuffer_guided_warp`` blends: to look at, and to warp several images alike.

    Returns:
      Weights ``[..., H, W, 4]``, sum 1, best first, and pixel numbers ``[..., H, W, 4]`` (row * W + column) in the
      previous frame; a number whose weight is 0 has no meaning.
    """
    chosen = _chosen(implementation, SELECTIONS)

    def weigh(*arrays):
        return _weigh(_select(chosen, *jax.lax.stop_gradient(arrays)), *arrays)

    weights, pixels = _run(weigh, (), guide_previous, guide, motion, sigma_guide, sigma_distance)
    return jnp.moveaxis(weights, -3, -1), jnp.stack(pixels, axis=-1)
