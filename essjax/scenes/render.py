"""From a ``World`` to images: jitted functions of flat lists of rays, and the loop that feeds them.

Image positions are *screen positions*: pixels from the image centre, over the image width. So nothing here depends on the
resolution, and one compilation (per number of rays in a chunk) serves every image.
"""

import functools
import os
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from essjax.scenes import geometry
from essjax.scenes.jitter import reference_samples
from essjax.scenes.materials import Surface, surface
from essjax.scenes.shading import direct, environment, mirror_weight, radiance
from essjax.scenes.vec import Vec, dot, normalize, stack
from essjax.scenes.world import World, column
from essjax.typing import Array, Callable, Float

CPU_CHUNK = 16384
"""Rays per call: what fits a core's cache. Accelerators get more."""
ACCELERATOR_CHUNK = 1 << 20
STEADY_TOLERANCE = 0.02
"""Largest change of x/(1+x) radiance of a material point between frames that still counts as steady lighting."""


def _camera(world: World) -> tuple[list[Vec], Vec]:
    m = world.camera_to_world
    axes = [Vec(x=m[0, k], y=m[1, k], z=m[2, k]) for k in range(3)]
    return axes, Vec(x=m[0, 3], y=m[1, 3], z=m[2, 3])


def primary_rays(world: World, x: Array, y: Array) -> tuple[Vec, Vec, Array]:
    """Origin, unit direction and cosine to the optical axis of the rays through screen positions (x right, y down)."""
    (right, up, back), eye = _camera(world)
    a, b = x / world.focal, -y / world.focal
    cosine = jax.lax.rsqrt(a * a + b * b + 1.0)
    direction = (right * a + up * b - back) * cosine
    return eye + direction * 0.0, direction, cosine


def screen_position(world: World, offset: Vec) -> tuple[Array, Array]:
    """Screen position of a point given relative to the camera; far outside where it lies behind the camera."""
    (right, up, back), _ = _camera(world)
    depth = jnp.maximum(-dot(back, offset), 1e-6)
    return world.focal * dot(right, offset) / depth, -world.focal * dot(up, offset) / depth


@jax.jit
def average_color(world: World, x: Array, y: Array, dx: Array, dy: Array, angle: Array) -> Float[Array, "N 3"]:
    """Mean radiance over the samples ``(dx, dy)`` ``[S]`` around each screen position ``(x, y)`` ``[N]``."""
    origin, direction, _ = primary_rays(world, (x[None] + dx[:, None]).ravel(), (y[None] + dy[:, None]).ravel())
    color = stack(radiance(world, origin, direction, angle))
    return color.reshape(dx.shape[0], x.shape[0], 3).mean(axis=0)


def _shade_without_mirror(world: World, s: Surface, direction: Vec) -> Array:
    return stack(direct(world, s, -direction) + environment(world, s, direction) + s.emission)


def _follow(world: World, previous: World, s: Surface, direction: Vec) -> tuple[Vec, Vec, Array, Array]:
    """Ray of the previous frame towards the same material point (sky: direction), its length, whether it sees it."""
    _, eye = _camera(previous)
    there = geometry.to_world(previous, s.row, s.local) - eye
    distance = jnp.where(s.hit, jnp.sqrt(dot(there, there)), geometry.FAR)
    towards = normalize(Vec(x=jnp.where(s.hit, there.x, direction.x), y=jnp.where(s.hit, there.y, direction.y),
                            z=jnp.where(s.hit, there.z, direction.z)))  # fmt: skip
    origin = eye + towards * 0.0
    t, row = geometry.trace(previous, origin, towards, jnp.full_like(distance, geometry.FAR))
    near = jnp.abs(t - distance) < 2e-3 * distance + 5e-3
    seen = jnp.where(s.hit, (row == s.row) & near, row < 0)
    return origin, towards, distance, seen


@jax.jit
def buffers(
    world: World, previous: World, x: Array, y: Array, half_height: Array, angle: Array
) -> dict[str, Float[Array, "N C"]]:
    """Everything a frame holds at the screen positions ``(x, y)`` ``[N]``; motion in image widths.

    Args:
      world: the scene now.
      previous: the scene one frame earlier (``world`` itself at a cut).
      x: screen positions, right.
      y: screen positions, down.
      half_height: ``[]`` half the image height over its width.
      angle: ``[]`` pixel angle for the texture filter, radians.
    """
    origin, direction, cosine = primary_rays(world, x, y)
    t, row = geometry.trace(world, origin, direction, jnp.full_like(x, geometry.FAR))
    s = surface(world, row, origin, direction, t, t * angle)
    previous_origin, towards, distance, seen = _follow(world, previous, s, direction)
    previous_x, previous_y = screen_position(previous, towards)
    (_, _, back), _ = _camera(previous)
    on_screen = (jnp.abs(previous_x) <= 0.5) & (jnp.abs(previous_y) <= half_height) & (dot(back, towards) < -1e-3)

    before = surface(previous, row, previous_origin, towards, distance, t * angle)
    now = _shade_without_mirror(world, s, direction)
    then = _shade_without_mirror(previous, before, towards)
    change = jnp.max(jnp.abs(now / (1.0 + now) - then / (1.0 + then)), axis=-1)
    mirror = mirror_weight(s, direction)
    is_mirror = (s.mirror > 0.0) & (jnp.maximum(jnp.maximum(mirror.x, mirror.y), mirror.z) > 0.02)
    steady = ~s.hit | ((change < STEADY_TOLERANCE) & ~is_mirror)

    hit = s.hit[:, None]
    one = lambda value: jnp.where(hit, value[:, None], 0.0)
    return {
        "color": stack(radiance(world, origin, direction, angle)),
        "base_color": jnp.where(hit, stack(s.base_color), 0.0),
        "normal": jnp.where(hit, stack(s.normal), 0.0),
        "depth": jnp.where(hit, (t * cosine)[:, None], jnp.inf),
        "roughness": one(s.roughness),
        "metallic": one(s.metallic),
        "specular": one(s.specular),
        "world_position": jnp.where(hit, stack(s.position), 0.0),
        "stencil": one(column(world, row, "id")),
        "n_dot_v": one(s.n_dot_v),
        "motion": jnp.stack([previous_x - x, previous_y - y], axis=-1),
        "valid": (seen & on_screen).astype(jnp.float32)[:, None],
        "steady": steady.astype(jnp.float32)[:, None],
    }


@jax.jit
def sample_statistics(world: World, x: Array, y: Array, dx: Array, dy: Array, angle: Array) -> dict[str, Array]:
    """Ranges over the samples ``(dx, dy)`` ``[S]`` of each pixel: what ``sequence.subsample_statistics`` returns."""
    shape = (dx.shape[0], x.shape[0])
    origin, direction, cosine = primary_rays(world, (x[None] + dx[:, None]).ravel(), (y[None] + dy[:, None]).ravel())
    t, row = geometry.trace(world, origin, direction, jnp.full_like(direction.x, geometry.FAR))
    s = surface(world, row, origin, direction, t, t * angle)
    depth = jnp.where(s.hit, t * cosine, jnp.inf).reshape(*shape, 1)
    color = stack(radiance(world, origin, direction, angle)).reshape(*shape, 3)

    def spread(normal: Vec) -> Array:
        normals = jnp.where(s.hit[:, None], stack(normal), 0.0).reshape(*shape, 3)
        return jnp.abs(normals - normals[:1]).sum(axis=-1, keepdims=True).max(axis=0)

    return {
        "depth_min": depth.min(axis=0), "depth_max": depth.max(axis=0),
        "color_min": color.min(axis=0), "color_max": color.max(axis=0),
        "normal_spread": spread(s.normal), "normal_spread_smooth": spread(s.smooth_normal),
    }  # fmt: skip


def screen_grid(width: int, height: int, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat screen positions ``[H * W]`` of pixel centres + ``offset`` (x, y) in pixels."""
    x = (np.arange(width) + 0.5 + float(offset[0]) - 0.5 * width) / width
    y = (np.arange(height) + 0.5 + float(offset[1]) - 0.5 * height) / width
    grid_x, grid_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return grid_x.ravel(), grid_y.ravel()


def chunk_size() -> int:
    """Rays per jitted call on the default backend."""
    return CPU_CHUNK if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK


@functools.cache
def _threads() -> ThreadPoolExecutor:
    workers = min(os.cpu_count() or 1, 8) if jax.default_backend() == "cpu" else 1
    return ThreadPoolExecutor(workers, thread_name_prefix="essjax-render")


def in_chunks(function: Callable, x: np.ndarray, y: np.ndarray, rays_per_pixel: int = 1) -> dict[str, np.ndarray]:
    """Call ``function(x, y)`` on equal pieces, in parallel on a CPU, and join the arrays it returns.

    XLA:CPU runs the small loops of the ray caster on one core; a Python thread per core (the call releases the GIL)
    keeps all of them busy.
    """
    total = x.shape[0]
    pieces = max(1, -(-total * rays_per_pixel // chunk_size()))
    if jax.default_backend() == "cpu":  # an even share for every core
        cores = min(os.cpu_count() or 1, 8)
        pieces = -(-pieces // cores) * cores
    size = -(-total // pieces)
    padded = [np.pad(v, (0, pieces * size - total)).reshape(pieces, size) for v in (x, y)]
    jobs = [
        _threads().submit(lambda a, b: jax.device_get(function(a, b)), *piece) for piece in zip(*padded, strict=True)
    ]
    results = [job.result() for job in jobs]
    return {name: np.concatenate([result[name] for result in results])[:total] for name in results[0]}


def pixel_angle(world: World, width: int, mip_bias: float = 0.0) -> np.float32:
    """Angle of a pixel (radians) at the image centre, times 2 ** ``mip_bias``."""
    return np.float32(2.0**mip_bias / (float(world.focal) * width))


def _as_image(flat: np.ndarray, width: int, height: int) -> np.ndarray:
    return flat.reshape(height, width, -1)


def render_reference(world: World, width: int, height: int, *, spp: int = 64) -> np.ndarray:
    """Anti-aliased image ``[H, W, 3]``: ``spp`` samples per pixel, box filter."""
    world = jax.device_put(world)
    offsets = (reference_samples(spp) - 0.5) / width
    angle = pixel_angle(world, width)
    x, y = screen_grid(width, height, np.zeros(2))
    function = lambda a, b: {"color": average_color(world, a, b, offsets[:, 0], offsets[:, 1], angle)}
    return _as_image(in_chunks(function, x, y, spp)["color"], width, height)


def render_buffers(
    world: World, previous: World, width: int, height: int, jitter: np.ndarray, angle: np.float32
) -> dict[str, np.ndarray]:
    """``buffers`` as images ``[H, W, C]``; motion in pixels; ``steady`` eroded by a pixel, ``stencil`` int32."""
    world, previous = jax.device_put((world, previous))
    x, y = screen_grid(width, height, jitter)
    half_height = np.float32(0.5 * height / width)
    images = in_chunks(lambda a, b: buffers(world, previous, a, b, half_height, angle), x, y)
    images = {name: _as_image(flat, width, height) for name, flat in images.items()}
    images["motion"] = images["motion"] * np.float32(width)
    images["stencil"] = np.rint(images["stencil"]).astype(np.int32)
    images["steady"] = _erode(images["steady"])
    return images


def _erode(mask: np.ndarray) -> np.ndarray:
    """Smallest value of the 3x3 neighbourhood: a shadow's edge that passes near a sample also touches its pixel."""
    padded = np.pad(mask, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = mask.shape[:2]
    return np.min([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)


def render_statistics(world: World, width: int, height: int, *, spp: int = 64) -> dict[str, np.ndarray]:
    """``sample_statistics`` as images ``[H, W, C]``."""
    world = jax.device_put(world)
    offsets = (reference_samples(spp) - 0.5) / width
    angle = pixel_angle(world, width)
    x, y = screen_grid(width, height, np.zeros(2))
    images = in_chunks(lambda a, b: sample_statistics(world, a, b, offsets[:, 0], offsets[:, 1], angle), x, y, spp)
    return {name: _as_image(flat, width, height) for name, flat in images.items()}
