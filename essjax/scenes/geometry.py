"""Rays against tables of primitives: a loop over primitives, all rays at once in every step.

The loop keeps the nearest distance and its row. Measured on 2 cores it tests 500 M pairs/s, four to six times as many
as one ``[primitives, rays]`` array with argmin, and its trip count is data, so scenes of any size share a compilation.
Directions are unit length in the world; transforms keep the ray parameter, so t is metres in every space.
"""

import jax
import jax.numpy as jnp

from essjax.scenes.vec import Vec, dot, larger, normalize, smaller
from essjax.scenes.world import BOX, OFFSET, RECT, ROD, SPHERE, World
from essjax.typing import Array, Callable, Float, Int

FAR = 1e9
NEAR = 1e-3
"""Metres; hits closer than this belong to the surface that the ray starts on."""


def _transform_point(m: list[Array], p: Vec) -> Vec:
    return Vec(
        x=m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3],
        y=m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7],
        z=m[8] * p.x + m[9] * p.y + m[10] * p.z + m[11],
    )


def _transform_direction(m: list[Array], d: Vec) -> Vec:
    return Vec(
        x=m[0] * d.x + m[1] * d.y + m[2] * d.z,
        y=m[4] * d.x + m[5] * d.y + m[6] * d.z,
        z=m[8] * d.x + m[9] * d.y + m[10] * d.z,
    )


def _interval(near: Array, far: Array, hit: Array) -> Array:
    """Entry of a convex shape, or its exit where the ray starts inside."""
    t = jnp.where(near > NEAR, near, far)
    return jnp.where(hit & (near <= far) & (t > NEAR), t, FAR)


def _slab(o: Array, inverse: Array) -> tuple[Array, Array]:
    middle, half = -o * inverse, jnp.abs(inverse)
    return middle - half, middle + half


def _rect(o: Vec, d: Vec) -> Array:
    t = -o.z / d.z
    inside = (jnp.abs(o.x + t * d.x) <= 1.0) & (jnp.abs(o.y + t * d.y) <= 1.0)
    return jnp.where(inside & (t > NEAR), t, FAR)


def _box(o: Vec, d: Vec) -> Array:
    near_x, far_x = _slab(o.x, 1.0 / d.x)
    near_y, far_y = _slab(o.y, 1.0 / d.y)
    near_z, far_z = _slab(o.z, 1.0 / d.z)
    return _interval(larger(larger(near_x, near_y), near_z), smaller(smaller(far_x, far_y), far_z), jnp.bool_(True))


def _sphere(o: Vec, d: Vec) -> Array:
    # From the closest approach, not from the ray's origin: the usual discriminant cancels for small, distant shapes.
    inverse = 1.0 / dot(d, d)
    middle = -dot(o, d) * inverse
    closest = o + d * middle
    rest = 1.0 - dot(closest, closest)
    half = jnp.sqrt(larger(rest, 0.0) * inverse)
    return _interval(middle - half, middle + half, rest > 0.0)


def _rod(o: Vec, d: Vec) -> Array:
    inverse = 1.0 / larger(d.x * d.x + d.y * d.y, 1e-12)
    middle = -(o.x * d.x + o.y * d.y) * inverse
    x, y = o.x + middle * d.x, o.y + middle * d.y
    rest = 1.0 - (x * x + y * y)
    half = jnp.sqrt(larger(rest, 0.0) * inverse)
    near, far = _slab(o.z, 1.0 / d.z)
    return _interval(larger(middle - half, near), smaller(middle + half, far), rest > 0.0)


_SHAPES = ((RECT, _rect), (BOX, _box), (SPHERE, _sphere), (ROD, _rod))


def _nearest(world: World, kind: int, shape: Callable, origin: Vec, direction: Vec, best: tuple) -> tuple:
    def body(index, best):
        distance, row = best
        matrix = jax.lax.dynamic_index_in_dim(world.to_local, index, keepdims=False)
        m = [matrix[k] for k in range(12)]
        t = shape(_transform_point(m, origin), _transform_direction(m, direction))
        closer = t < distance
        return jnp.where(closer, t, distance), jnp.where(closer, index, row)

    return jax.lax.fori_loop(OFFSET[kind], OFFSET[kind] + world.counts[kind], body, best)


def trace(world: World, origin: Vec, direction: Vec, limit: Float[Array, "N"]) -> tuple[Array, Int[Array, "N"]]:
    """Nearest hit closer than ``limit`` (metres): distance ``[N]`` and table row ``[N]``, -1 where nothing is hit."""
    best = (limit, jnp.full(limit.shape, -1, jnp.int32))
    for kind, shape in _SHAPES:
        best = _nearest(world, kind, shape, origin, direction, best)
    return best


def matrix_of(table: Float[Array, "P 12"], rows: Int[Array, "N"]) -> list[Array]:
    """The 12 entries of each ray's transform, planar."""
    return [jnp.take(table[:, k], rows, mode="clip") for k in range(12)]


def local_hit(m: list[Array], origin: Vec, direction: Vec, t: Array) -> Vec:
    """Hit point in the unit shape's space; ``m`` from ``matrix_of(world.to_local, rows)``."""
    return _transform_point(m, origin) + _transform_direction(m, direction) * t


def to_world(world: World, rows: Int[Array, "N"], local: Vec) -> Vec:
    """World position (metres) of a point of the unit shape."""
    return _transform_point(matrix_of(world.to_world, rows), local)


def local_normal(kind: Array, p: Vec, half: Vec) -> Vec:
    """Unit outward normal, in object space (metres, unrotated), at the point ``p`` of the unit shape of ``kind``."""
    ax, ay, az = jnp.abs(p.x), jnp.abs(p.y), jnp.abs(p.z)
    is_rect, is_box, is_sphere = kind == RECT, kind == BOX, kind == SPHERE
    on_x = is_box & (ax >= ay) & (ax >= az)
    on_y = is_box & ~on_x & (ay >= az)
    on_z = is_rect | (is_box & ~on_x & ~on_y) | ((kind == ROD) & (az * az >= ax * ax + ay * ay))
    flat = on_x | on_y | on_z
    away = jnp.where(is_sphere, 1.0, 0.0)
    normal = Vec(
        x=jnp.where(flat, jnp.where(on_x, jnp.sign(p.x), 0.0), p.x / half.x),
        y=jnp.where(flat, jnp.where(on_y, jnp.sign(p.y), 0.0), p.y / half.y),
        z=jnp.where(flat, jnp.where(on_z, jnp.where(is_rect, 1.0, jnp.sign(p.z)), 0.0), away * p.z / half.z),
    )
    return normalize(normal)


def rotate_to_world(m: list[Array], half: Vec, normal: Vec) -> Vec:
    """A direction given in object space (metres, unrotated) turned into the world; ``m`` is the to-local transform."""
    n = normal * half  # the rows of m are the object's axes divided by the half size
    return Vec(
        x=m[0] * n.x + m[4] * n.y + m[8] * n.z,
        y=m[1] * n.x + m[5] * n.y + m[9] * n.z,
        z=m[2] * n.x + m[6] * n.y + m[10] * n.z,
    )
