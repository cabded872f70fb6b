"""The G-buffer guided warp as one Triton kernel, for CUDA GPUs where ``jax_triton`` is installed.

One thread keeps the keys of one pixel in registers, so nothing lies in memory between the guides and the image. Keys,
network and weights are those of ``gbuffer_guided``, whose XLA version is the reference and gives the gradients
(docs/adr/0004-top-four-in-log-space.md). Without a GPU the kernel runs in Triton's interpreter
(``TRITON_INTERPRET=1``), which is how it is tested.
"""

from typing import Any

import jax
import jax.numpy as jnp
import triton
import triton.language as tl

from essjax import kernels
from essjax.typing import Array
from essjax.warp.candidates import BORDER, FAR, LEAST, LIMIT, MARGIN, REACH, UNUSABLE, candidate_offsets

BLOCK = (1, 128)
"""Rows and columns of a program's tile."""
WARPS = 4


@triton.jit
def _exchange(a, b):
    return tl.minimum(a, b), tl.maximum(a, b)


@triton.jit
def _sort_four(a, b, c, d):
    a, b = _exchange(a, b)
    c, d = _exchange(c, d)
    a, c = _exchange(a, c)
    b, d = _exchange(b, d)
    b, c = _exchange(b, c)
    return a, b, c, d


@triton.jit
def _merge_fours(a, b, c, d, e, f, g, h):
    """Merge two sorted fours: the four smallest, sorted."""
    a, b, c, d = tl.minimum(a, h), tl.minimum(b, g), tl.minimum(c, f), tl.minimum(d, e)
    a, c = _exchange(a, c)
    b, d = _exchange(b, d)
    a, b = _exchange(a, b)
    c, d = _exchange(c, d)
    return a, b, c, d


@triton.jit
def _cost(window, here, scale_x, scale_y, x, y, column, row, stride, plane, least: tl.constexpr):
    """Half the sum of the squares in eq 2, all scaled, of the candidate ``column``, ``row`` pixels from the centre."""
    away_x = scale_x * (x - column)
    away_y = scale_y * (y - row)
    cost = least + away_x * away_x + away_y * away_y
    at = window + (row * stride + column)
    for k in tl.static_range(len(here) // 2):
        pair = tl.load(at + k * plane)  # two channels by one load
        first = here[2 * k] - pair.to(tl.int32).to(tl.float32, bitcast=True)
        second = here[2 * k + 1] - (pair >> 32).to(tl.int32).to(tl.float32, bitcast=True)
        cost += first * first
        cost += second * second
    return cost


@triton.jit
def _key(window, here, scale_x, scale_y, x, y, offsets, number, stride, plane, least: tl.constexpr):
    """Bits of a candidate's cost, the low 6 its number."""
    column, row = tl.load(offsets + 2 * number), tl.load(offsets + 2 * number + 1)
    cost = _cost(window, here, scale_x, scale_y, x, y, column, row, stride, plane, least)
    return (cost.to(tl.int32, bitcast=True) & -64) | number


@triton.jit
def guided_kernel(
    radiance, planes, guide, motion, scale, offsets, image, packed,
    height: tl.constexpr, width: tl.constexpr, depth: tl.constexpr, channels: tl.constexpr, shared: tl.constexpr,
    count: tl.constexpr, margin: tl.constexpr, reach: tl.constexpr, limit: tl.constexpr,
    border: tl.constexpr, unusable: tl.constexpr, least: tl.constexpr, far: tl.constexpr,
    block_rows: tl.constexpr, block_columns: tl.constexpr,
):  # fmt: skip
    """Warp one tile of one image of a batch.

    Args:
      radiance: ``[B, H, W, depth]``.
      planes: previous guides, scaled, two by two (an odd one beside zeros), with a border of ``margin``:
        ``[B, ceil(channels / 2), H + 2 margin, W + 2 margin, 2]``.
      guide: ``[B, H, W, channels]``.
      motion: ``[B, H, W, 2]``.
      scale: ``[B, channels + 2]``: 1 / (sqrt(2) sigma) of guides and of both directions.
      offsets: of the candidates, int32 ``[33, 2]``.
      image: result, as ``radiance``.
      packed: result, int32 ``[B, H, W]``: see ``gbuffer_guided._pack``.
      height: of the images.
      width: of the images.
      depth: channels of the radiance.
      channels: of the guides.
      shared: of the first five arrays, whether there is one for the whole batch.
      count: of candidates.
      margin: of ``planes``.
      reach: largest offset.
      limit: scaled guides beyond this match nothing.
      border: such a guide's value.
      unusable: costs from which on a candidate cannot be used.
      least: added to costs.
      far: positions are clamped to this, pixels.
      block_rows: of a tile.
      block_columns: of a tile.
    """
    stride: tl.constexpr = width + 2 * margin
    plane: tl.constexpr = stride * (height + 2 * margin)
    item = tl.program_id(2).to(tl.int64)  # of large batches more numbers than int32 counts
    # What sticks out of the image repeats its last row and column: no masks.
    row = tl.minimum(tl.program_id(1) * block_rows + tl.arange(0, block_rows), height - 1)[:, None]
    column = tl.minimum(tl.program_id(0) * block_columns + tl.arange(0, block_columns), width - 1)[None, :]
    pixel = row * width + column
    if not shared[0]:
        radiance += item * (height * width * depth)
    if not shared[1]:
        planes += item * ((channels + 1) // 2 * 2 * plane)
    if not shared[2]:
        guide += item * (height * width * channels)
    if not shared[3]:
        motion += item * (height * width * 2)
    if not shared[4]:
        scale += item * (channels + 2)

    to_x = column + 0.5 + tl.load(motion + 2 * pixel)
    to_y = row + 0.5 + tl.load(motion + 2 * pixel + 1)
    x = tl.minimum(tl.maximum(to_x, -reach - 0.5), width + reach + 0.5)
    y = tl.minimum(tl.maximum(to_y, -reach - 0.5), height + reach + 0.5)
    first_column, first_row = tl.floor(x), tl.floor(y)
    window = (
        planes.to(tl.pointer_type(tl.int64))
        + (first_row.to(tl.int32) + margin) * stride
        + first_column.to(tl.int32)
        + margin
    )
    x, y = x - first_column - 0.5, y - first_row - 0.5
    scale_x, scale_y = tl.load(scale + channels), tl.load(scale + channels + 1)
    here = ()
    for k in tl.static_range(channels):
        value = tl.load(guide + pixel * channels + k) * tl.load(scale + k)
        here = here + (tl.where(tl.abs(value) < limit, value, -border),)
    if channels % 2:
        here = here + (tl.zeros_like(x),)

    a = _key(window, here, scale_x, scale_y, x, y, offsets, 0, stride, plane, least)
    b = _key(window, here, scale_x, scale_y, x, y, offsets, 1, stride, plane, least)
    c = _key(window, here, scale_x, scale_y, x, y, offsets, 2, stride, plane, least)
    d = _key(window, here, scale_x, scale_y, x, y, offsets, 3, stride, plane, least)
    a, b, c, d = _sort_four(a, b, c, d)
    for n in tl.range(4, count // 4 * 4, 4):
        e = _key(window, here, scale_x, scale_y, x, y, offsets, n, stride, plane, least)
        f = _key(window, here, scale_x, scale_y, x, y, offsets, n + 1, stride, plane, least)
        g = _key(window, here, scale_x, scale_y, x, y, offsets, n + 2, stride, plane, least)
        h = _key(window, here, scale_x, scale_y, x, y, offsets, n + 3, stride, plane, least)
        e, f, g, h = _sort_four(e, f, g, h)
        a, b, c, d = _merge_fours(a, b, c, d, e, f, g, h)
    for n in tl.static_range(count // 4 * 4, count):
        e = _key(window, here, scale_x, scale_y, x, y, offsets, n, stride, plane, least)
        a, e = _exchange(a, e)
        b, e = _exchange(b, e)
        c, e = _exchange(c, e)
        d = tl.minimum(d, e)

    # The winners' costs anew, their low bits are gone. With all 33 unusable the first takes everything.
    keys = (a, b, c, d)
    numbers = ()
    costs = ()
    together = tl.zeros_like(a)
    for rank in tl.static_range(4):
        usable = keys[rank].to(tl.float32, bitcast=True) < unusable
        together = together | (tl.where(usable, keys[rank] & 63, 63) << (6 * rank))
        number = tl.where(usable, keys[rank] & 63, 0)
        across, down = tl.load(offsets + 2 * number), tl.load(offsets + 2 * number + 1)
        cost = _cost(window, here, scale_x, scale_y, x, y, across, down, stride, plane, 0.0)
        costs = costs + (tl.where(usable, cost, 0.0 if rank == 0 else float("inf")),)
        numbers = numbers + (number,)
    lowest = tl.minimum(tl.minimum(costs[0], costs[1]), tl.minimum(costs[2], costs[3]))
    center_column = tl.floor(tl.minimum(tl.maximum(to_x, -far), far)).to(tl.int32)
    center_row = tl.floor(tl.minimum(tl.maximum(to_y, -far), far)).to(tl.int32)
    weights = ()
    winners = ()
    total = tl.zeros_like(lowest)
    for rank in tl.static_range(4):
        weight = tl.exp(lowest - costs[rank])
        total += weight
        weights = weights + (weight,)
        across, down = tl.load(offsets + 2 * numbers[rank]), tl.load(offsets + 2 * numbers[rank] + 1)
        winner_column = tl.minimum(tl.maximum(center_column + across, 0), width - 1)
        winner_row = tl.minimum(tl.maximum(center_row + down, 0), height - 1)
        winners = winners + (winner_row * width + winner_column,)
    image += item * (height * width * depth)
    packed += item * (height * width)
    for k in tl.static_range(depth):
        value = tl.zeros_like(total)
        for rank in tl.static_range(4):
            value += (weights[rank] / total) * tl.load(radiance + winners[rank] * depth + k).to(tl.float32)
        tl.store(image + pixel * depth + k, value)
    tl.store(packed + pixel, together)


def constants(radiance: Any, guide: Any, shared: tuple[bool, ...]) -> dict[str, Any]:
    """Collect what the kernel knows when it is compiled.

    Args:
      radiance: ``[B or 1, H, W, C]``.
      guide: ``[B or 1, H, W, G]``.
      shared: see ``guided_kernel``.
    """
    return {
        "height": radiance.shape[1], "width": radiance.shape[2], "depth": radiance.shape[3], "channels": guide.shape[3],
        "shared": shared, "count": len(candidate_offsets()), "margin": MARGIN, "reach": REACH, "limit": LIMIT,
        "border": BORDER, "unusable": UNUSABLE, "least": LEAST, "far": FAR,
        "block_rows": BLOCK[0], "block_columns": BLOCK[1],
    }  # fmt: skip


def grid(height: int, width: int, batch: int) -> tuple[int, int, int]:
    """Programs along columns, rows and images."""
    return triton.cdiv(width, BLOCK[1]), triton.cdiv(height, BLOCK[0]), batch


@kernels.over_batches
def guided(radiance: Array, planes: Array, guide: Array, motion: Array, scale: Array) -> list[Array]:
    """Call ``guided_kernel``: its arguments and results as arrays; leading axes are B, or 1 for all of a batch."""
    arrays = radiance, planes, guide, motion, scale
    batch = max(array.shape[0] for array in arrays)
    height, width, depth = radiance.shape[1:]
    return kernels.call(
        guided_kernel,
        *arrays,
        jnp.asarray(candidate_offsets()),
        out_shape=[
            jax.ShapeDtypeStruct((batch, height, width, depth), radiance.dtype),
            jax.ShapeDtypeStruct((batch, height, width), jnp.int32),
        ],
        grid=grid(height, width, batch),
        num_warps=WARPS,
        **constants(radiance, guide, tuple(array.shape[0] == 1 for array in arrays)),
    )
