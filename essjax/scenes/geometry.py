"""Rays against tables of primitives: a loop over primitives, all rays at once in every step.

The loop keeps the nearest distance and its row. Measured on 2 cores it tests 500 M pairs/s, four to six times as many
as one ``[primitives, rays]`` array with argmin, and its trip count is data, so scenes of any size share a compilation.
Directions are unit length in the world; transforms keep the ray parameter, so t is metres in every space.
"""

import jax
import jax.numpy as jnp

from essjax.scenes._vec import Vec, dot, larger, normalize, smaller
from essjax.scenes.world import BOX, CAPACITY, OFFSET, RECT, ROD, ROW_KIND, ROW_MEMBER, SPHERE, World, columns
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


def _lane_sum(values: Array) -> Array:
    return values.reshape(-1, 128).sum(axis=0).sum() if values.shape[0] % 128 == 0 else values.sum()


def _lane_max(values: Array) -> Array:
    return values.reshape(-1, 128).max(axis=0).max() if values.shape[0] % 128 == 0 else values.max()


def _candidates(world: World, origin: Vec, direction: Vec, active: Array) -> tuple[Array, list[Array]]:
    """Rows that any of the active rays may hit, and how many of each kind: order ``[P]``, counts.

    All rays start in a ball and point into a cone about their mean direction; a primitive is left out when its bounding
    sphere touches neither. Neighbouring pixels traced together meet a fraction of the scene's primitives.
    """
    count = larger(_lane_sum(jnp.where(active, 1.0, 0.0)), 1.0)
    mean = lambda v: _lane_sum(jnp.where(active, v, 0.0)) / count
    centre = Vec(x=mean(origin.x), y=mean(origin.y), z=mean(origin.z))
    axis = normalize(Vec(x=mean(direction.x), y=mean(direction.y), z=mean(direction.z)))
    away = origin - centre
    ball = jnp.sqrt(_lane_max(jnp.where(active, dot(away, away), 0.0))) + 1e-3
    cosine = 1.0 - _lane_max(jnp.where(active, 1.0 - dot(direction, axis), 0.0)) - 1e-5
    sine = jnp.sqrt(larger(1.0 - cosine * cosine, 0.0))

    affine = world.to_world.reshape(-1, 3, 4)
    half = jnp.sqrt((affine[:, :, :3] ** 2).sum(axis=1))
    kind = jnp.asarray(ROW_KIND)
    radius = jnp.where(kind == SPHERE, half.max(axis=-1), jnp.sqrt((half**2).sum(axis=-1)))
    reach = radius * 1.001 + ball
    to = Vec(x=affine[:, 0, 3] - centre.x, y=affine[:, 1, 3] - centre.y, z=affine[:, 2, 3] - centre.z)
    along = dot(to, axis)
    across = jnp.sqrt(larger(dot(to, to) - along * along, 0.0))
    met = (across * cosine - along * sine <= reach) & (along >= -reach)
    used = jnp.asarray(ROW_MEMBER) < world.counts[kind]
    keep = used & (met | (cosine < 0.1)) & jnp.any(active)
    order = jnp.argsort(jnp.where(keep, 2 * kind, 2 * kind + 1)).astype(jnp.int32)
    return order, [jnp.sum((keep & (kind == k)).astype(jnp.int32)) for k in range(len(CAPACITY))]


def _nearest(table: Array, order: Array, count: Array, kind: int, shape: Callable, ray: tuple, best: tuple) -> tuple:
    def body(member, best):
        distance, row = best
        index = order[OFFSET[kind] + member]
        matrix = jax.lax.dynamic_index_in_dim(table, index, keepdims=False)
        m = [matrix[k] for k in range(12)]
        t = shape(_transform_point(m, ray[0]), _transform_direction(m, ray[1]))
        closer = t < distance
        return jnp.where(closer, t, distance), jnp.where(closer, index, row)

    return jax.lax.fori_loop(0, count, body, best)


def trace(world: World, origin: Vec, direction: Vec, limit: Float[Array, "N"]) -> tuple[Array, Int[Array, "N"]]:
    """Nearest hit closer than ``limit`` (metres): distance ``[N]`` and table row ``[N]``, -1 where nothing is hit.

    Rays whose limit is 0 cost nothing where all of them have it; rays that lie close together cost less.
    """
    order, counts = _candidates(world, origin, direction, limit > 0.0)
    best = (limit, jnp.full(limit.shape, -1, jnp.int32))
    for kind, shape in _SHAPES:
        best = _nearest(world.to_local, order, counts[kind], kind, shape, (origin, direction), best)
    return best


def matrix_of(table: Float[Array, "P 12"], rows: Int[Array, "N"]) -> list[Array]:
    """Gather the 12 entries of each ray's transform, planar."""
    planar = columns(table, rows)
    return [planar[k] for k in range(12)]


def local_hit(m: list[Array], origin: Vec, direction: Vec, t: Array) -> Vec:
    """Hit point in the unit shape's space; ``m`` from ``matrix_of(world.to_local, rows)``."""
    return _transform_point(m, origin) + _transform_direction(m, direction) * t


def to_world(world: World, rows: Int[Array, "N"], local: Vec) -> Vec:
    """World position (metres) of a point of the unit shape."""
    return _transform_point(matrix_of(world.to_world, rows), local)


def local_normal(kind: Array, p: Vec, half: Vec) -> Vec:
    """Return the unit outward normal, in object space (metres, unrotated), at point ``p`` of ``kind``'s unit shape."""
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
    """Turn a direction given in object space (metres, unrotated) into the world; ``m`` is the to-local transform."""
    n = normal * half  # the rows of m are the object's axes divided by the half size
    return Vec(
        x=m[0] * n.x + m[4] * n.y + m[8] * n.z,
        y=m[1] * n.x + m[5] * n.y + m[9] * n.z,
        z=m[2] * n.x + m[6] * n.y + m[10] * n.z,
    )
