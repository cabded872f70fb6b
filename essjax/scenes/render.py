"""From a ``World`` to images: jitted functions of flat lists of rays, and the loop that feeds them.

Image positions are *screen positions*: pixels from the image centre, over the image width. So nothing here depends on
the resolution, and one compilation serves every image.
"""

import functools
import os
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from essjax import kernels
from essjax.scenes import geometry
from essjax.scenes._vec import Vec, dot, normalize, select, stack
from essjax.scenes.jitter import reference_samples
from essjax.scenes.materials import Surface, surface
from essjax.scenes.shading import direct, environment, mirror_weight, radiance
from essjax.scenes.world import World
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
def color_along(world: World, x: Array, y: Array, angle: Array) -> Float[Array, "N 3"]:
    """Radiance at the screen positions ``(x, y)`` ``[N]``; ``angle`` of a pixel (radians) filters the textures."""
    origin, direction, _ = primary_rays(world, x, y)
    return stack(radiance(world, origin, direction, angle))


def _spread(x: Array, y: Array, offsets: Array) -> list[Array]:
    """All samples of all pixels, samples first: ``[S * N]``, right and down."""
    return [(v[None] + offsets[:, k, None]).ravel() for k, v in enumerate((x, y))]


@jax.jit
def average_color(world: World, x: Array, y: Array, offsets: Array, angle: Array) -> Float[Array, "N 3"]:
    """Mean of ``color_along`` over ``offsets`` ``[S, 2]`` around each screen position."""
    return color_along(world, *_spread(x, y, offsets), angle).reshape(len(offsets), x.size, 3).mean(axis=0)


def _follow(previous: World, s: Surface, direction: Vec) -> tuple[Vec, Vec, Array]:
    """Ray of the previous frame towards the same material point (sky: direction), and its length."""
    _, eye = _camera(previous)
    there = geometry.to_world(previous, s.row, s.local) - eye
    distance = jnp.where(s.hit, jnp.sqrt(dot(there, there)), geometry.FAR)
    towards = normalize(select(s.hit, there, direction))
    return eye + towards * 0.0, towards, distance


@jax.jit
def buffers(
    world: World, previous: World, x: Array, y: Array, half_height: Array, angle: Array
) -> dict[str, Float[Array, "N C"]]:
    """Everything a frame holds but colour, at the screen positions ``(x, y)`` ``[N]``; motion in image widths.

    Args:
      world: the scene now.
      previous: the scene one frame earlier (``world`` itself at a cut).
      x: screen positions, right.
      y: screen positions, down.
      half_height: ``[]`` half the image height over its width.
      angle: ``[]`` pixel angle for the texture filter, radians.
    """
    origin, direction, cosine = primary_rays(world, x, y)

    # Now and then are two rounds of one scan, not two copies of the ray caster: half the compile time.
    def instant(carry, step):
        origin, direction, known, known_row, first = carry
        then, scene = step
        t, row = geometry.trace(scene, origin, direction, jnp.full_like(x, geometry.FAR))
        expected, expected_row = jnp.where(then, known, t), jnp.where(then, known_row, row)
        near = jnp.abs(t - expected) < 2e-3 * expected + 5e-3
        seen = jnp.where(expected_row >= 0, (row == expected_row) & near, row < 0)
        first = jnp.where(then, first, t)
        s = surface(scene, expected_row, origin, direction, expected, first * angle)
        shade = stack(direct(scene, s, -direction) + environment(scene, s, direction) + s.emission)
        back = _follow(previous, s, direction)
        return (*back, expected_row, first), (s, shade, seen, t, back[1])

    start = (origin, direction, x * 0.0, jnp.zeros(x.shape, jnp.int32), x * 0.0)
    worlds = jax.tree.map(lambda a, b: jnp.stack([a, b]), world, previous)
    _, (surfaces, shades, seen, distances, rays) = jax.lax.scan(instant, start, (jnp.array([False, True]), worlds))
    s, towards, t = jax.tree.map(lambda leaf: leaf[0], (surfaces, rays, distances))

    previous_x, previous_y = screen_position(previous, towards)
    (_, _, back), _ = _camera(previous)
    on_screen = (jnp.abs(previous_x) <= 0.5) & (jnp.abs(previous_y) <= half_height) & (dot(back, towards) < -1e-3)
    toned = shades / (1.0 + shades)
    change = jnp.max(jnp.abs(toned[0] - toned[1]), axis=-1)
    mirror = mirror_weight(s, direction)
    is_mirror = (s.mirror > 0.0) & (jnp.maximum(jnp.maximum(mirror.x, mirror.y), mirror.z) > 0.02)
    steady = ~s.hit | ((change < STEADY_TOLERANCE) & ~is_mirror)

    hit = s.hit[:, None]
    one = lambda value: jnp.where(hit, value[:, None], 0.0)
    three = lambda value: jnp.where(hit, stack(value), 0.0)
    return {
        "base_color": three(s.base_color),
        "normal": three(s.normal),
        "smooth_normal": three(s.smooth_normal),
        "depth": jnp.where(hit, (t * cosine)[:, None], jnp.inf),
        "roughness": one(s.roughness),
        "metallic": one(s.metallic),
        "specular": one(s.specular),
        "world_position": three(s.position),
        "stencil": one(s.id),
        "n_dot_v": one(s.n_dot_v),
        "motion": jnp.stack([previous_x - x, previous_y - y], axis=-1),
        "valid": (seen[1] & on_screen).astype(jnp.float32)[:, None],
        "steady": steady.astype(jnp.float32)[:, None],
    }


@jax.jit
def surfaces(world: World, previous: World, x: Array, y: Array, angle: Array) -> dict[str, Float[Array, "N C"]]:
    """Find each sample's normal with and without bumps (0 where nothing is hit), its depth, motion in image widths."""
    origin, direction, cosine = primary_rays(world, x, y)
    t, row = geometry.trace(world, origin, direction, jnp.full_like(x, geometry.FAR))
    s = surface(world, row, origin, direction, t, t * angle)
    hit = s.hit[:, None]
    previous_x, previous_y = screen_position(previous, _follow(previous, s, direction)[1])
    return {
        "normal": jnp.where(hit, stack(s.normal), 0.0),
        "smooth_normal": jnp.where(hit, stack(s.smooth_normal), 0.0),
        "depth": jnp.where(hit, (t * cosine)[:, None], jnp.inf),
        "motion": jnp.stack([previous_x - x, previous_y - y], axis=-1),
    }


def screen_grid(width: int, height: int, offset: np.ndarray, *, tall: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Flat screen positions ``[H * W]`` of pixel centres + ``offset`` (x, y) in pixels; ``tall`` as rendered."""
    x = (np.arange(width) + 0.5 + float(offset[0]) - 0.5 * width) / width
    y = tall * (np.arange(height) + 0.5 + float(offset[1]) - 0.5 * height) / width
    grid_x, grid_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return grid_x.ravel(), grid_y.ravel()


def chunk_size() -> int:
    """Rays per jitted call on the default backend."""
    return CPU_CHUNK if kernels.backend() == "cpu" else ACCELERATOR_CHUNK


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(os.cpu_count() or 1, 16), thread_name_prefix="essjax-render")


@functools.lru_cache(8)
def tile_order(width: int, height: int, tile: int) -> np.ndarray:
    """List all pixels tile by tile: rays that are traced together should lie together. Shared: do not write."""
    y, x = np.divmod(np.arange(width * height), width)
    return np.lexsort((x, y, x // tile, y // tile))


def in_tiles(
    function: Callable, x: np.ndarray, y: np.ndarray, width: int, height: int, *, rays: int, samples: int = 1
) -> dict[str, np.ndarray]:
    """Call ``function(x, y)`` on compact groups of pixels, in parallel on a CPU: images ``[H, W, C]`` by name.

    XLA:CPU runs the small loops of the ray caster on one core; a Python thread per core (the call releases the GIL)
    keeps all of them busy.

    Args:
      function: of screen positions ``[rays // samples]``; returns arrays with that leading axis.
      x: flat screen positions, right.
      y: flat screen positions, down.
      width: of the image, pixels.
      height: of the image, pixels.
      rays: per call at most; the same in all calls for one image, so that there is one compilation.
      samples: per pixel.
    """
    size = max(1, rays // samples)
    if kernels.backend() != "cpu":  # calls alike, but no small image padded to a chunk that is made for large ones
        size = -(-width * height // -(-width * height // size))
    order = tile_order(width, height, max(1, int(size**0.5)))
    pieces = -(-order.size // size)
    padded = np.pad(order, (0, pieces * size - order.size), mode="edge").reshape(pieces, size)
    if kernels.backend() == "cpu":
        run = lambda part: jax.device_get(function(x[part], y[part]))
        results = [run(padded[0])]  # alone: threads that meet an uncompiled function would each compile it
        results += _threads().map(run, padded[1:])
    else:  # all calls are queued before the first result is waited for
        results = jax.device_get([function(x[part], y[part]) for part in padded])
    images = {}
    for name in results[0]:
        flat = np.concatenate([result[name] for result in results])[: order.size]
        image = np.empty_like(flat)
        image[order] = flat
        images[name] = image.reshape(height, width, -1)
    return images


def pixel_angle(world: World, width: int, mip_bias: float = 0.0) -> np.float32:
    """Angle of a pixel (radians) at the image centre, times 2 ** ``mip_bias``."""
    return np.float32(2.0**mip_bias / (float(world.focal) * width))


def _sample_offsets(spp: int, width: int, tall: float) -> np.ndarray:
    """Screen positions of a pixel's samples, from its centre, ``[spp, 2]``."""
    return ((reference_samples(spp) - 0.5) * [1.0, tall] / width).astype(np.float32)


def render_reference(world: World, width: int, height: int, *, spp: int = 64, tall: float = 1.0) -> np.ndarray:
    """Anti-aliased image ``[H, W, 3]``: ``spp`` samples per pixel, box filter.

    ``tall``: height of a pixel over its width; not 1 where the image shows what one of another shape does.
    """
    world = jax.device_put(world)
    offsets = _sample_offsets(spp, width, tall)
    angle, rays = pixel_angle(world, width), max(chunk_size(), spp)
    x, y = screen_grid(width, height, np.zeros(2), tall=tall)
    return in_tiles(
        lambda a, b: {"color": average_color(world, a, b, offsets, angle)}, x, y, width, height, rays=rays, samples=spp
    )["color"]


def render_buffers(
    world: World,
    previous: World,
    width: int,
    height: int,
    jitter: np.ndarray,
    angle: np.float32,
    *,
    tall: float = 1.0,
) -> dict[str, np.ndarray]:
    """``buffers`` and one-sample ``color`` as images ``[H, W, C]``; motion in pixels, ``stencil`` int32.

    ``tall``: see ``render_reference``.

    ``steady`` is eroded by a pixel: a shadow's edge that passes near a sample also touches its pixel.
    """
    world, previous = jax.device_put((world, previous))
    x, y = screen_grid(width, height, jitter, tall=tall)
    half_height = np.float32(0.5 * tall * height / width)
    images = in_tiles(
        lambda a, b: buffers(world, previous, a, b, half_height, angle), x, y, width, height, rays=chunk_size() // 4
    )
    images |= in_tiles(lambda a, b: {"color": color_along(world, a, b, angle)}, x, y, width, height, rays=chunk_size())
    images["motion"] = images["motion"] * np.asarray([width, width / tall], np.float32)
    images["stencil"] = np.rint(images["stencil"]).astype(np.int32)
    images["steady"] = _erode(images["steady"])
    return images


def _erode(mask: np.ndarray) -> np.ndarray:
    """Smallest value of the 3x3 neighbourhood."""
    padded = np.pad(mask, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = mask.shape[:2]
    return np.min([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)


def render_statistics(
    world: World, previous: World, width: int, height: int, *, spp: int = 64, tall: float = 1.0
) -> dict[str, np.ndarray]:
    """Render the images of ``frames.SampleRanges``, ``[H, W, C]``, and the same samples' ``reference``.

    ``tall``: see ``render_reference``.
    """
    world, previous = jax.device_put((world, previous))
    offsets = _sample_offsets(spp, width, tall)
    angle, rays = pixel_angle(world, width), max(chunk_size(), spp)
    in_pixels = np.asarray([width, width / tall], np.float32)

    def ranges(x, y):
        places = _spread(x, y, offsets)
        samples = {"color": color_along(world, *places, angle), **surfaces(world, previous, *places, angle)}
        samples = {name: s.reshape(spp, x.size, -1) for name, s in samples.items()}
        reference = samples["color"].mean(axis=0)
        samples = jax.device_get(samples)
        color, depth = samples["color"], samples["depth"]
        distance = lambda n: np.abs(n - n[:1]).sum(axis=-1, keepdims=True).max(axis=0)
        nearest = np.broadcast_to(depth.argmin(axis=0)[None], (1, x.size, 2))
        return {
            "depth_min": depth.min(axis=0), "depth_max": depth.max(axis=0),
            "color_min": color.min(axis=0), "color_max": color.max(axis=0),
            "normal_spread": distance(samples["normal"]), "normal_spread_smooth": distance(samples["smooth_normal"]),
            "motion": np.take_along_axis(samples["motion"], nearest, axis=0)[0] * in_pixels,
            "reference": reference,
        }  # fmt: skip

    x, y = screen_grid(width, height, np.zeros(2), tall=tall)
    return in_tiles(ranges, x, y, width, height, rays=rays, samples=spp)
