"""Pinhole cameras: project, unproject, and the motion that follows from two cameras.

The camera looks along its -Z with +Y up (as Blender, glTF, OpenGL); the image has y down:
``x = center_x + focal_x * X / -Z``, ``y = center_y - focal_y * Y / -Z``. ``camera_to_world`` is for column vectors.
Depth is ``-Z``, positive, linear; the background is +inf. All functions take any leading axes.
"""

import jax
import jax.numpy as jnp

from essjax.typing import Array, Float, Matrix4, Motion, Plane, Positions, Vectors, pytree

_EXACT = jax.lax.Precision.HIGHEST
"""Some accelerators would round products to 10 bits: at 1000 m, a metre."""


@pytree
class Camera:
    """A pinhole camera; lengths in pixels of the frame that it belongs to.

    Attributes:
      camera_to_world: ``[..., 4, 4]`` rigid transform, metres.
      focal: ``[..., 2]`` focal length (x, y), pixels.
      center: ``[..., 2]`` principal point (x, y), pixels; the image centre is ``(W / 2, H / 2)``.
    """

    camera_to_world: Matrix4
    focal: Float[Array, "... 2"]
    center: Float[Array, "... 2"]


def pixel_positions(height: int, width: int, jitter: Float[Array, "... 2"] | None = None) -> Positions:
    """Sample positions ``[..., H, W, 2]`` in pixels: pixel centres, plus ``jitter`` (pixels) where given."""
    x, y = jnp.meshgrid(jnp.arange(width, dtype=jnp.float32) + 0.5, jnp.arange(height, dtype=jnp.float32) + 0.5)
    grid = jnp.stack([x, y], axis=-1)
    return grid if jitter is None else grid + jitter[..., None, None, :]


def _per_pixel(parameter: Array) -> Array:
    return parameter[..., None, None, :]


def _rotate(matrix: Array, vectors: Array) -> Array:
    return jnp.einsum("...ij,...hwj->...hwi", matrix, vectors, precision=_EXACT)


def camera_rays(camera: Camera, positions: Positions) -> Vectors:
    """Directions in camera space through ``positions`` with -Z = 1 (not unit length), ``[..., H, W, 3]``."""
    xy = (positions - _per_pixel(camera.center)) / _per_pixel(camera.focal)
    return jnp.concatenate([xy[..., :1], -xy[..., 1:], -jnp.ones_like(xy[..., :1])], axis=-1)


def project_camera_space(camera: Camera, points: Vectors) -> Positions:
    """Pixel positions of points in camera space; points behind the camera are pushed far outside the image."""
    depth = jnp.maximum(-points[..., 2:], 1e-6)
    flipped = points[..., :2] * jnp.array([1.0, -1.0], points.dtype)
    return _per_pixel(camera.center) + _per_pixel(camera.focal) * flipped / depth


def project(camera: Camera, points: Vectors) -> tuple[Positions, Plane]:
    """Project world positions (metres) ``[..., H, W, 3]``: pixel positions ``[..., H, W, 2]`` and depth (metres)."""
    rotation = camera.camera_to_world[..., :3, :3]
    origin = camera.camera_to_world[..., None, None, :3, 3]
    local = _rotate(jnp.swapaxes(rotation, -1, -2), points - origin)
    return project_camera_space(camera, local), -local[..., 2:]


def unproject(camera: Camera, positions: Positions, depth: Plane) -> Vectors:
    """World positions (metres) of pixel ``positions`` at view-space ``depth``; 0 where depth is not finite."""
    finite = jnp.isfinite(depth)
    local = camera_rays(camera, positions) * jnp.where(finite, depth, 0.0)
    world = _rotate(camera.camera_to_world[..., :3, :3], local) + camera.camera_to_world[..., None, None, :3, 3]
    return jnp.where(finite, world, 0.0)


def static_motion(camera: Camera, previous: Camera, positions: Positions, depth: Plane) -> Motion:
    """Motion of a static world seen by a moving camera, pixels; where depth is +inf it is ``sky_motion``."""
    moved, _ = project(previous, unproject(camera, positions, depth))
    return jnp.where(jnp.isfinite(depth), moved - positions, sky_motion(camera, previous, positions))


def sky_motion(camera: Camera, previous: Camera, positions: Positions) -> Motion:
    """Motion of infinitely far points, pixels: rays turned by the cameras' rotations, translation ignored."""
    before, now = (eye.camera_to_world[..., :3, :3] for eye in (previous, camera))
    to_previous = jnp.einsum("...ji,...jk->...ik", before, now, precision=_EXACT)
    return project_camera_space(previous, _rotate(to_previous, camera_rays(camera, positions))) - positions
