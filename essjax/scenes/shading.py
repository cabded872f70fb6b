"""Light: sky, ambient, Lambert and GGX highlights under lights with hard shadows, and one mirror bounce."""

import jax
import jax.numpy as jnp

from essjax.scenes import geometry, textures
from essjax.scenes._vec import Vec, dot, larger, mix, normalize, reflect, saturate, select, smaller, vec
from essjax.scenes.materials import Surface, surface
from essjax.scenes.world import World
from essjax.typing import Array

OFFSET = 2e-3
"""Metres by which rays start off the surface."""


def _constant(values: Array, first: int) -> Vec:
    return Vec(x=values[first], y=values[first + 1], z=values[first + 2])


def sky(world: World, direction: Vec, width: Array, run: Array) -> Vec:
    """Radiance from infinitely far: gradient, clouds, ground, and a sun that is brighter than the display.

    Args:
      world: the scene now.
      direction: unit, world.
      width: angle of a pixel, radians: what the clouds are filtered with.
      run: scalar bool, whether any ray needs it.
    """
    zenith, horizon, ground = (_constant(world.sky, k) for k in (0, 3, 6))
    up = direction.y
    height = saturate(up)
    color = mix(horizon, zenith, 1.0 - (1.0 - height) * (1.0 - height))
    spread = 1.0 / (larger(up, 0.0) + 0.12)
    u, v = direction.x * spread * world.sky[17], direction.z * spread * world.sky[17]
    noise, _, _ = textures.fractal_noise(u, v, jnp.full_like(u, 5.0), width * spread * spread * world.sky[17], run)
    cloud = saturate((noise + world.sky[16] - 1.0) * 4.0) * saturate(up * 6.0)
    sun_direction, sun_color = _constant(world.sky, 9), _constant(world.sky, 12)
    towards = dot(direction, sun_direction)
    color = mix(color, horizon * 1.1 + sun_color * 0.015, cloud)
    glow = saturate(1.0 - (1.0 - towards) * 8.0)
    disc = saturate((towards - 1.0 + world.sky[15]) / (0.2 * world.sky[15] + 1e-6))
    color = color + sun_color * (disc * (1.0 - 0.8 * cloud) + 0.02 * glow * glow * glow)
    return mix(color, ground, saturate(-up * 40.0))


def ambient(world: World, direction: Vec) -> Vec:
    """Blur the sky: light from around ``direction`` (unit)."""
    above = (_constant(world.sky, 0) + _constant(world.sky, 3)) * 0.5
    return mix(_constant(world.sky, 6), above, saturate(0.5 + 0.5 * direction.y)) * world.sky[18]


def _highlight(s: Surface, view: Vec, light: Vec, reflectance: Vec) -> Vec:
    """GGX with the visibility and Fresnel approximation of Karis 2013 for real-time use; no power functions."""
    half = normalize(view + light)
    n_h, l_h = saturate(dot(s.normal, half)), saturate(dot(light, half))
    rough = larger(s.roughness, 0.12)
    alpha2 = rough * rough * rough * rough
    d = n_h * n_h * (alpha2 - 1.0) + 1.0
    return reflectance * (alpha2 / (12.566 * d * d * larger(l_h * l_h, 0.1) * (rough + 0.5)))


def reflectance_of(s: Surface) -> Vec:
    """Specular reflectance at normal incidence: 0.08 * specular for dielectrics, base colour for metals."""
    plain = 0.08 * s.specular * (1.0 - s.metallic)
    return s.base_color * s.metallic + vec(plain, plain, plain)


def direct(world: World, s: Surface, view: Vec) -> Vec:
    """Diffuse light and highlights from the lights that reach the surface. ``view`` points to the viewer."""
    diffuse = s.base_color * ((1.0 - s.metallic) * (1.0 / 3.14159))
    specular = reflectance_of(s)
    start = s.position + s.smooth_normal * OFFSET

    def one(index, total):
        row = jax.lax.dynamic_index_in_dim(world.lights, index, keepdims=False)
        to_light = select(row[3] > 0.5, _constant(row, 0) - start, _constant(row, 0) + start * 0.0)
        distance2 = dot(to_light, to_light)
        distance = jnp.sqrt(distance2)
        light = to_light * (1.0 / distance)
        cosine = dot(s.normal, light)
        lit = s.hit & (cosine > 0.0) & (dot(s.smooth_normal, light) > 0.0)
        reach = jnp.where(row[3] > 0.5, distance - OFFSET, geometry.FAR)
        # A ray that cannot matter ends before it starts: its limit is 0.
        _, blocker = geometry.trace(world, start, light, jnp.where(lit, reach, 0.0))
        strength = jnp.where(lit & (blocker < 0), cosine, 0.0)
        strength = strength * jnp.where(row[3] > 0.5, 1.0 / larger(distance2, 0.25), 1.0)  # a lamp is no point
        return total + (diffuse + _highlight(s, view, light, specular)) * _constant(row, 4) * strength

    return jax.lax.fori_loop(0, world.light_count, one, s.base_color * 0.0)


def environment(world: World, s: Surface, direction: Vec) -> Vec:
    """Ambient light, and the blurred sky in what is not a traced mirror."""
    soft = s.base_color * (1.0 - s.metallic) * ambient(world, s.normal)
    # Twice: what stands around reflects light too, and metal that sees only the dim sky looks black.
    gloss = (2.0 - 1.4 * s.roughness) * jnp.where(s.mirror > 0.0, 0.0, 1.0)
    return soft + reflectance_of(s) * ambient(world, reflect(direction, s.normal)) * gloss


def mirror_weight(s: Surface, direction: Vec) -> Vec:
    """Colour that multiplies the mirror image: Schlick's Fresnel term."""
    grazing = 1.0 - saturate(-dot(s.normal, direction))
    fresnel = grazing * grazing * grazing * grazing * grazing
    f0 = reflectance_of(s)
    return (f0 + (vec(1.0, 1.0, 1.0) - f0) * fresnel) * s.mirror + vec(s.mirror, s.mirror, s.mirror) * 0.15


def radiance(world: World, origin: Vec, direction: Vec, pixel_angle: Array) -> Vec:
    """Linear HDR radiance along each ray, mirror bounces included.

    Args:
      world: the scene now.
      origin: ``[N]`` per component, metres.
      direction: unit.
      pixel_angle: ``[]`` angle of a pixel (radians), what textures are filtered with.
    """
    zero = direction.x * 0.0

    def segment(_, state):
        origin, direction, weight, travelled, color = state
        t, row = geometry.trace(
            world, origin, direction, jnp.where(weight.x + weight.y + weight.z > 0, geometry.FAR, 0.0)
        )
        s = surface(world, row, origin, direction, t, (travelled + t) * pixel_angle)
        lit = direct(world, s, -direction) + environment(world, s, direction) + s.emission
        color = color + weight * select(s.hit, lit, sky(world, direction, zero + pixel_angle, jnp.any(row < 0)))
        weight = select(s.hit & (s.mirror > 0.0), weight * mirror_weight(s, direction), vec(zero, zero, zero))
        mirrored = normalize(reflect(direction, mix(s.smooth_normal, s.normal, 0.3 + zero)))
        return s.position + s.smooth_normal * OFFSET, mirrored, weight, travelled + t, color

    start = (origin, direction, vec(zero + 1.0, zero + 1.0, zero + 1.0), zero, vec(zero, zero, zero))
    color = jax.lax.fori_loop(0, 1 + world.bounces, segment, start)[-1]
    return Vec(x=smaller(color.x, 60000.0), y=smaller(color.y, 60000.0), z=smaller(color.z, 60000.0))
