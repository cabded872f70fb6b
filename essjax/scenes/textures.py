"""Procedural patterns on a plane: checker, cells with joints (bricks, tiles), glyphs, stripes, dots, noise.

All take positions in cells and the footprint of a pixel in cells. Edges are as soft as the footprint, and a pattern
whose cells shrink below it fades to its mean: a mip map without a map. Everything is arithmetic that vectorises: no
sine, no power, no table.
"""

import jax.numpy as jnp

from essjax.scenes._vec import larger, saturate, smaller, stage
from essjax.typing import Array

PLAIN, CHECKER, CELLS, GLYPHS, STRIPES, DOTS, NOISE = range(7)
GLYPH_ROWS = 7
GLYPH_COLUMNS = 7
"""A glyph is a mirrored 5x5 bitmap with a margin of one in a 7x7 cell."""


def hash_cell(x: Array, y: Array, seed: Array) -> Array:
    """Hash the integer cell (x, y), given as floats, to a pseudo-random uint32."""
    ix, iy, iz = (v.astype(jnp.int32).astype(jnp.uint32) for v in (x, y, seed))
    h = ix * jnp.uint32(0x27D4EB2D) ^ iy * jnp.uint32(0x165667B1) ^ iz * jnp.uint32(0x9E3779B1)
    h = (h ^ (h >> 15)) * jnp.uint32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE35)
    return h ^ (h >> 16)


def to_unit(h: Array) -> Array:
    """uint32 to [0, 1); by way of int32, for which CPUs have an instruction."""
    return (h >> 8).astype(jnp.int32).astype(jnp.float32) * (1.0 / (1 << 24))


def _corners(u: Array, v: Array, seed: Array) -> tuple[Array, ...]:
    u0, v0 = jnp.floor(u), jnp.floor(v)
    places = ((u0, v0), (u0 + 1.0, v0), (u0, v0 + 1.0), (u0 + 1.0, v0 + 1.0))
    return tuple(to_unit(hash_cell(a, b, seed)) for a, b in places)


def _interpolate(corners: tuple[Array, ...], u: Array, v: Array) -> tuple[Array, Array, Array]:
    a, b, c, d = corners
    fu, fv = u - jnp.floor(u), v - jnp.floor(v)
    su, sv = fu * fu * (3.0 - 2.0 * fu), fv * fv * (3.0 - 2.0 * fv)
    du, dv = 6.0 * fu * (1.0 - fu), 6.0 * fv * (1.0 - fv)
    value = a + (b - a) * su + (c - a) * sv + (a - b - c + d) * su * sv
    return value, ((b - a) + (a - b - c + d) * sv) * du, ((c - a) + (a - b - c + d) * su) * dv


def fractal_noise(u: Array, v: Array, seed: Array, width: Array, run: Array) -> tuple[Array, Array, Array]:
    """Two octaves of smooth noise, each faded where the footprint ``width`` (cells) exceeds it; mean 0.5.

    Returns the value in [0, 1] and its derivatives along u and v; zeros unless the scalar ``run``.
    """
    u1, v1 = u * 2.7 + 3.1, v * 2.7 + 7.7
    hashes = stage(run, lambda u, v, u1, v1, s: (_corners(u, v, s), _corners(u1, v1, s + 1.0)), u, v, u1, v1, seed)
    n0, du0, dv0 = _interpolate(hashes[0], u, v)
    n1, du1, dv1 = _interpolate(hashes[1], u1, v1)
    k0, k1 = 0.65 * fade(width), 0.35 * fade(width * 2.7)
    return 0.5 + k0 * (n0 - 0.5) + k1 * (n1 - 0.5), k0 * du0 + 2.7 * k1 * du1, k0 * dv0 + 2.7 * k1 * dv1


def fade(width: Array) -> Array:
    """1 where a pixel is smaller than half a cell, 0 where it covers a whole one."""
    return saturate(2.0 - 2.0 * width)


def _edge(distance: Array, width: Array) -> Array:
    """0 below the edge at 0, 1 above, as soft as the footprint."""
    return saturate(distance / width + 0.5)


def _glyph(fu: Array, fv: Array, cell: Array) -> Array:
    column, row = jnp.floor(fu * GLYPH_COLUMNS), jnp.floor(fv * GLYPH_ROWS)
    inside = (column >= 1.0) & (column <= 5.0) & (row >= 1.0) & (row <= 5.0)
    bit = (row - 1.0) * 3.0 + jnp.abs(column - 3.0)  # mirrored about the middle column: 5 rows x 3 bits
    bit = jnp.where(inside, bit, 0.0).astype(jnp.int32).astype(jnp.uint32)
    return jnp.where(inside & (((cell >> bit) & 1) == 1), 1.0, 0.0)


def evaluate(
    kind: Array, u: Array, v: Array, width: Array, shift: Array, gap: Array, seed: Array, noise: Array
) -> tuple[Array, Array, Array, Array]:
    """One pattern per ray, chosen by ``kind`` (a float).

    Args:
      kind: PLAIN ... NOISE.
      u: position in cells, along the rows.
      v: position in cells, across the rows.
      width: footprint of a pixel in cells.
      shift: how far odd rows are moved, in cells (0.5: bricks).
      gap: half width of the joints of CELLS; radius of DOTS.
      seed: of the cells' hashes, a whole number.
      noise: ``fractal_noise`` there, thresholded by NOISE.

    Returns:
      mask in [0, 1] (0: first colour, 1: second), a random number in [0, 1) per cell (faded to 0.5), and the slope of
      the joints' edges along u and v.
    """
    row = jnp.floor(v)
    u = u + shift * (row - 2.0 * jnp.floor(row * 0.5))
    cell_u = jnp.floor(u)
    fu, fv = u - cell_u, v - row
    cell = hash_cell(cell_u, row, seed)
    random = to_unit(cell)
    edge_u, edge_v = smaller(fu, 1.0 - fu), smaller(fv, 1.0 - fv)
    parity = cell_u + row
    sign = 1.0 - 2.0 * (parity - 2.0 * jnp.floor(parity * 0.5))

    checker = 0.5 - 0.5 * sign * saturate(2.0 * edge_u / width) * saturate(2.0 * edge_v / width)
    joints = 1.0 - _edge(edge_u - gap, width) * _edge(edge_v - gap, width)
    stripes = _edge(larger(0.25 - jnp.abs(fu - 0.5), -edge_u), width)
    radius = gap * (0.5 + 0.5 * random)
    dots = _edge(radius - jnp.sqrt((fu - 0.5) * (fu - 0.5) + (fv - 0.5) * (fv - 0.5)), width)
    mask = jnp.where(kind == CHECKER, checker, 0.0)
    mean = jnp.where(kind == CHECKER, 0.5, 0.0)
    # What each fades to is its mean: (5 / 7)^2 / 2 of a glyph's cell is ink, joints cover 4 gap (1 - gap) of theirs.
    for index, value, average in (
        (CELLS, joints, 4.0 * gap * (1.0 - gap)),
        (GLYPHS, _glyph(fu, fv, cell), 0.255),
        (STRIPES, stripes, 0.5),
        (DOTS, dots, 1.83 * gap * gap),
        (NOISE, _edge(noise - 0.5, 0.08 + width), 0.5),
    ):
        mask = jnp.where(kind == index, value, mask)
        mean = jnp.where(kind == index, average, mean)
    detail = jnp.where(kind == GLYPHS, width * 3.0, width)
    visible = fade(detail)
    mask = mean + (mask - mean) * visible
    bevel = 0.06
    slope = jnp.where(kind == CELLS, visible, 0.0)
    slope_u = slope * jnp.where((edge_u > gap) & (edge_u < gap + bevel), jnp.where(fu < 0.5, 1.0, -1.0), 0.0)
    slope_v = slope * jnp.where((edge_v > gap) & (edge_v < gap + bevel), jnp.where(fv < 0.5, 1.0, -1.0), 0.0)
    return mask, 0.5 + (random - 0.5) * visible, slope_u, slope_v


def contrast(value: Array, amount: Array) -> Array:
    """Return a factor around 1: ``1 + amount * (2 * value - 1)``, at least 0."""
    return larger(1.0 + amount * (2.0 * value - 1.0), 0.0)
