"""Materials: a description for scene builders, and the surface that a ray finds."""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.scenes import geometry, textures
from essjax.scenes._vec import Vec, dot, larger, mix, normalize, saturate, select, smaller, stage
from essjax.scenes.world import ROD, World, material_columns
from essjax.typing import Array, Float, Int, pytree

Rgb = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Material:
    """Two colours mixed by a pattern, in object space, so that it sticks to whatever moves.

    Attributes:
      a: first colour in [0, 1], linear.
      b: second colour, where the pattern is 1 (joints, glyphs, ...).
      pattern: ``textures.PLAIN`` ... ``textures.NOISE``.
      frequency: cells per metre along u.
      aspect: cells per metre along v, over ``frequency``.
      shift: how far odd rows are moved, in cells.
      gap: half width of joints, or radius of dots, in cells.
      variation: how much brightness differs from cell to cell, [0, 1].
      grime: contrast of the noise laid over everything, [0, 1].
      grime_frequency: cells of that noise per metre.
      bump: height of the normal detail, 0 for none.
      roughness: of the first colour, [0, 1].
      roughness_b: of the second; None: the same.
      metallic: [0, 1].
      specular: [0, 1]; 0.5 is a dielectric of 4 % reflectance.
      emission: radiance of the first colour over its base colour.
      emission_b: of the second.
      mirror: weight of the traced mirror image, 0 for none.
    """

    a: Rgb = (0.5, 0.5, 0.5)
    b: Rgb = (0.2, 0.2, 0.2)
    pattern: int = textures.PLAIN
    frequency: float = 1.0
    aspect: float = 1.0
    shift: float = 0.0
    gap: float = 0.05
    variation: float = 0.0
    grime: float = 0.2
    grime_frequency: float = 2.0
    bump: float = 0.0
    roughness: float = 0.7
    roughness_b: float | None = None
    metallic: float = 0.0
    specular: float = 0.5
    emission: float = 0.0
    emission_b: float = 0.0
    mirror: float = 0.0

    def columns(self) -> dict[str, float]:
        """Values of the table's columns."""
        rough_b = self.roughness if self.roughness_b is None else self.roughness_b
        rgb = dict(zip(("a_r", "a_g", "a_b", "b_r", "b_g", "b_b"), (*self.a, *self.b), strict=True))
        return rgb | {
            "pattern": self.pattern, "frequency": self.frequency, "aspect": self.aspect, "shift": self.shift,
            "gap": self.gap, "variation": self.variation, "grime": self.grime,
            "grime_frequency": self.grime_frequency, "bump": self.bump, "roughness_a": self.roughness,
            "roughness_b": rough_b, "metallic": self.metallic, "specular": self.specular,
            "emission_a": self.emission, "emission_b": self.emission_b, "mirror": self.mirror,
        }  # fmt: skip


@pytree
class Surface:
    """All that a ray found, one value per ray.

    Attributes:
      hit: bool.
      row: table row, -1 where nothing was hit.
      id: stencil id, a float.
      local: hit point in the unit shape's space: a name for the material point that does not move.
      position: world, metres.
      normal: world, unit, with bump detail, facing the ray.
      smooth_normal: the same without bump detail.
      base_color: [0, 1].
      roughness: [0, 1].
      metallic: [0, 1].
      specular: [0, 1].
      emission: radiance.
      mirror: weight of the mirror image.
      n_dot_v: [0, 1].
    """

    hit: Array
    row: Array
    id: Array
    local: Vec
    position: Vec
    normal: Vec
    smooth_normal: Vec
    base_color: Vec
    roughness: Array
    metallic: Array
    specular: Array
    emission: Vec
    mirror: Array
    n_dot_v: Array


def _texture_plane(kind: Array, p: Vec, normal: Vec, half: Vec) -> tuple[Array, Array, Vec, Vec]:
    """Texture coordinates (metres) and their directions, all in object space: the plane the normal points out of most.

    The side of a rod is unrolled instead, with |x| + |y| for the angle.
    """
    q = p * half
    ax, ay, az = jnp.abs(normal.x), jnp.abs(normal.y), jnp.abs(normal.z)
    zero, one = jnp.zeros_like(ax), jnp.ones_like(ax)
    on_x, on_y = (ax >= ay) & (ax >= az), ay >= az
    u = jnp.where(on_x, q.z, q.x)
    v = jnp.where(~on_x & on_y, q.z, q.y)
    along_u = Vec(x=jnp.where(on_x, zero, one), y=zero, z=jnp.where(on_x, one, zero))
    along_v = Vec(x=zero, y=jnp.where(~on_x & on_y, zero, one), z=jnp.where(~on_x & on_y, one, zero))
    side = (kind == ROD) & (az < 0.5)
    angle = p.y / (jnp.abs(p.x) + jnp.abs(p.y) + 1e-6)
    turn = jnp.where(p.x < 0, 2.0 - angle, angle) * (1.5708 * half.x)
    tangent = Vec(x=-normal.y, y=normal.x, z=zero)
    along_z = Vec(x=zero, y=zero, z=one)
    return (
        jnp.where(side, turn, u),
        jnp.where(side, q.z, v),
        select(side, tangent, along_u),
        select(side, along_z, along_v),
    )


def surface(
    world: World, rows: Int[Array, "N"], origin: Vec, direction: Vec, t: Float[Array, "N"], footprint: Float[Array, "N"]
) -> Surface:
    """Look up the surface at distance ``t`` along each ray.

    Args:
      world: the scene now.
      rows: from ``geometry.trace``; -1 gives a surface with ``hit`` false and finite, meaningless values.
      origin: ray origins, metres.
      direction: unit ray directions.
      t: distances, metres.
      footprint: width of a pixel on a surface facing the ray, metres: what textures are filtered with.
    """
    run = jnp.any(rows >= 0)
    at = material_columns(world, rows)
    m = geometry.matrix_of(world.to_local, rows)
    place = stage(run, _place, at, m, origin, direction, t, footprint)
    frequency = at["grime_frequency"]
    noise = textures.fractal_noise(place.u * frequency, place.v * frequency, place.seed, place.width * frequency, run)
    pattern = stage(run, _pattern, at, place, noise[0])
    return stage(run, _finish, at, m, rows, place, noise, pattern, direction)


@pytree
class _Place:
    """Where on which texture a ray ends."""

    local: Vec
    position: Vec
    outward: Vec
    smooth: Vec
    facing: Array
    u: Array
    v: Array
    along_u: Vec
    along_v: Vec
    seed: Array
    width: Array


def _place(at: dict[str, Array], m: list[Array], origin: Vec, direction: Vec, t: Array, footprint: Array) -> _Place:
    half = Vec(x=at["half_x"], y=at["half_y"], z=at["half_z"])
    local = geometry.local_hit(m, origin, direction, t)
    outward = geometry.local_normal(at["kind"], local, half)
    smooth = geometry.rotate_to_world(m, half, outward)
    smooth = normalize(smooth)
    cosine = dot(smooth, direction)
    u, v, along_u, along_v = _texture_plane(at["kind"], local, outward, half)
    seed = at["seed"] + 17.0 * jnp.floor(2.0 * outward.x + 0.5) + 31.0 * jnp.floor(2.0 * outward.y + 0.5)
    # Between the two widths of the slanted footprint, as anisotropic filters do; 1e-6 keeps divisions finite.
    width = larger(footprint * jax.lax.rsqrt(larger(jnp.abs(cosine), 0.15)), 1e-6)
    return _Place(
        local=local, position=origin + direction * t, outward=outward, smooth=smooth,
        facing=jnp.where(cosine > 0.0, -1.0, 1.0), u=u, v=v, along_u=along_u, along_v=along_v, seed=seed, width=width,
    )  # fmt: skip


def _pattern(at: dict[str, Array], place: _Place, noise: Array) -> tuple[Array, Array, Array, Array]:
    cells, aspect = at["frequency"], at["aspect"]
    return textures.evaluate(
        at["pattern"], place.u * cells, place.v * cells * aspect, place.width * cells * larger(aspect, 1.0),
        at["shift"], at["gap"], place.seed, noise,
    )  # fmt: skip


def _finish(at: dict[str, Array], m, rows: Array, place: _Place, noise, pattern, direction: Vec) -> Surface:
    mask, random, slope_u, slope_v = pattern
    tone = textures.contrast(random, at["variation"] * (1.0 - mask)) * textures.contrast(noise[0], at["grime"])
    pure = mix(Vec(x=at["a_r"], y=at["a_g"], z=at["a_b"]), Vec(x=at["b_r"], y=at["b_g"], z=at["b_b"]), mask)
    base = Vec(x=smaller(pure.x * tone, 1.0), y=smaller(pure.y * tone, 1.0), z=smaller(pure.z * tone, 1.0))

    half = Vec(x=at["half_x"], y=at["half_y"], z=at["half_z"])
    tilt_u = at["bump"] * (0.5 * noise[1] - 1.5 * slope_u)
    tilt_v = at["bump"] * (0.5 * noise[2] - 1.5 * slope_v)
    tilted = place.outward * place.facing - place.along_u * tilt_u - place.along_v * tilt_v
    bumped = normalize(geometry.rotate_to_world(m, half, tilted))
    smooth = place.smooth * place.facing
    away = dot(bumped, direction) > -0.02  # a bump must not turn a visible surface away from the viewer
    normal = select(away, smooth, bumped)
    mixed = lambda name: at[name + "_a"] + (at[name + "_b"] - at[name + "_a"]) * mask
    return Surface(
        hit=rows >= 0,
        row=rows,
        id=at["id"],
        local=place.local,
        position=place.position,
        normal=normal,
        smooth_normal=smooth,
        base_color=base,
        roughness=saturate(mixed("roughness")),
        metallic=at["metallic"],
        specular=at["specular"],
        emission=pure * mixed("emission"),
        mirror=at["mirror"],
        n_dot_v=saturate(-dot(normal, direction)),
    )
