"""Where the previous frame showed another surface, and what to read there instead."""

import jax
import jax.numpy as jnp

from essjax.buffers import BUFFERS
from essjax.cameras import pixel_positions
from essjax.color import sum_channels
from essjax.frames import GBuffers
from essjax.typing import Array, Jitter, Mask, Motion, Plane
from essjax.warp._batch import check_channels
from essjax.warp.motion import jittered_motion, splat_motion
from essjax.warp.sampling import axis_taps, fetch, inside_mask, sample

_MIN_N_DOT_V = 0.1
_TYPICAL_N_DOT_V = 0.25  # where the channel is absent: towards grazing, so that floors are not holes
_OFF_SCREEN = 1e9  # pixels: a splat drops what goes there
_COMPARED = ("depth", "normal", "world_position", "stencil", "n_dot_v")
_MIN_TAP_WEIGHT = 0.1  # a tap that bilinear interpolation hardly reads proves little


def occlusion_motion(motion: Motion, depth: Plane, hole: Mask) -> Motion:
    """Occlusion motion vectors (Zeng et al. 2021, "Temporally Reliable Motion Vectors"; SPEC 2).

    A disoccluded pixel's own motion leads to the occluder. Instead it takes the motion of the surface that stood there
    in the previous frame, so that the lookup lands beside the occluder, on background that was visible:
    motion is splatted to t-1, nearest depth wins, and read at pixel + motion. Holes themselves are not splatted: they
    were not visible there, and would show through the cracks that a splat leaves where t-1 was magnified. Cracks are
    filled from their nearest-depth neighbour; where that finds nothing either, the motion stays.

    Args:
      motion: ``[..., H, W, 2]`` pixels, current to previous; with the jitter difference where frames are jittered.
      depth: ``[..., H, W, 1]`` of the current frame, background +inf.
      hole: ``[..., H, W, 1]`` from ``hole_mask``: 1 valid, 0 hole. Motion changes only in holes.

    Returns:
      ``[..., H, W, 2]``.
    """
    check_channels("hole", hole, 1, motion.shape[-3:-1])
    visible_motion = jnp.where(hole < 0.5, _OFF_SCREEN, motion)
    filled, _, known = splat_motion(motion, depth, visible_motion)
    positions = pixel_positions(motion.shape[-3], motion.shape[-2]) + motion
    found = sample(jnp.concatenate([filled, known], axis=-1), positions, mode="nearest", outside="zeros")
    return jnp.where((hole < 0.5) & (found[..., 2:] > 0), found[..., :2], motion)


def _agreement(a: Array | None, b: Array | None) -> Array:
    """Cosine between two normals; 1 where one of them is missing (no buffer, zero vector)."""
    if a is None or b is None:
        return jnp.ones((), jnp.float32)
    lengths = jnp.sqrt(sum_channels(a * a) * sum_channels(b * b))
    return jnp.where(lengths > 1e-6, sum_channels(a * b) / jnp.maximum(lengths, 1e-6), 1.0)


def _same_surface(
    current: GBuffers, previous: GBuffers, normal_threshold, position_threshold, depth_threshold, stencil_threshold
) -> Array:
    """Test the three conditions (ExtraNet eq 8-10) between aligned pixels; bool ``[..., H, W, 1]``."""
    sky, sky_previous = ~jnp.isfinite(current.depth), ~jnp.isfinite(previous.depth)
    depth = jnp.where(sky, 1.0, current.depth)
    depth_previous = jnp.where(sky_previous, 1.0, previous.depth)
    normals = _agreement(current.normal, previous.normal) >= normal_threshold
    depths = jnp.abs(depth - depth_previous) <= depth_threshold * jnp.minimum(depth, depth_previous)
    if current.world_position is not None and previous.world_position is not None:
        n_dot_v = _TYPICAL_N_DOT_V if current.n_dot_v is None else jnp.maximum(current.n_dot_v, _MIN_N_DOT_V)
        footprint = depth / (current.depth.shape[-3] * n_dot_v)
        difference = current.world_position - previous.world_position
        moved = jnp.sqrt(sum_channels(difference**2))
        static = moved <= position_threshold * footprint
    else:
        static = normals & depths
    if current.stencil is not None and previous.stencil is not None:
        static = jnp.where(current.stencil > 0, normals, static)
        static &= jnp.abs(current.stencil - previous.stencil) <= stencil_threshold
    return jnp.where(sky | sky_previous, sky & sky_previous, static)


def hole_mask(
    current: GBuffers,
    previous: GBuffers,
    motion: Motion,
    *,
    jitter: Jitter | None = None,
    jitter_previous: Jitter | None = None,
    normal_threshold: float = 0.98,
    position_threshold: float = 2.0,
    depth_threshold: float = 0.1,
    stencil_threshold: float = 0.5,
    front_threshold: float = 0.02,
) -> Mask:
    """Where the previous frame showed the same surface: three conditions on G-buffers (ExtraNet eq 8-10; SPEC 2).

    Surfaces differ where the stencil does; where they are dynamic (stencil > 0) and normals disagree; where they are
    static and the world position moved by more than ``position_threshold`` footprints of a pixel,
    ``depth / (H * NoV)``, which is scale-free (a vertical field of view near 53 degrees makes it exact); between sky
    and surface. A pixel is a hole where of the up to four pixels that bilinear interpolation mainly reads none shows
    its surface and all show something in front: what lies behind it, or beside it, has not hidden it. Where a rope
    is seen now and the sky was before, the rope was there, and the samples missed it. Off screen is a hole.

    Absent channels: without ``n_dot_v`` it counts as 0.25; without ``stencil`` everything counts as static; without
    ``world_position`` static pixels are compared by normal and by depth (relatively) instead - that of
    the two frames, so a fast camera along its axis needs a larger ``depth_threshold``. Normals that are zero or
    absent agree with all: depth alone decides then.

    Args:
      current: ``[..., H, W, C]`` each.
      previous: of the frame that is warped.
      motion: ``[..., H, W, 2]`` pixels, current to previous, unjittered.
      jitter: ``[..., 2]`` of the current frame; give both or none (unjittered buffers).
      jitter_previous: ``[..., 2]`` of the previous frame.
      normal_threshold: smallest cosine between normals of the same dynamic surface.
      position_threshold: largest move of a static surface, in pixel footprints.
      depth_threshold: largest relative difference in depth, where there is no world position.
      stencil_threshold: largest difference in id; the released code uses 1, here any difference counts.
      front_threshold: relative difference in depth from which on a surface lies in front of another.

    Returns:
      float32 ``[..., H, W, 1]``: 1 valid, 0 hole.

    Raises:
      ValueError: sizes or numbers of channels differ, or only one of the jitters is given.
    """
    check_channels("motion", motion, 2)
    height, width = motion.shape[-3:-1]
    for name in _COMPARED:
        for which, gbuffers in (("current", current), ("previous", previous)):
            image = getattr(gbuffers, name)
            if image is not None:
                check_channels(f"{which}.{name}", image, BUFFERS[name].channels, (height, width))
    if (jitter is None) != (jitter_previous is None):
        raise ValueError("hole_mask: expected both jitter and jitter_previous or neither, got one.")
    lookup = motion if jitter is None or jitter_previous is None else jittered_motion(motion, jitter, jitter_previous)
    positions = pixel_positions(height, width) + lookup
    columns = axis_taps(positions[..., 0], width, "bilinear", "zeros")
    rows = axis_taps(positions[..., 1], height, "bilinear", "zeros")
    valid = jnp.zeros((*positions.shape[:-1], 1), bool)
    for row in rows:
        for column in columns:
            there = jax.tree.map(lambda image, x=column.index, y=row.index: fetch(image, x, y), previous)
            same = _same_surface(
                current, there, normal_threshold, position_threshold, depth_threshold, stencil_threshold
            )
            same |= ~(there.depth < (1.0 - front_threshold) * current.depth)
            valid |= same & (row.weight * column.weight > _MIN_TAP_WEIGHT)[..., None]
    # Computed once: fused into all that read it, the 4 taps would be fetched again for every read.
    return jax.lax.optimization_barrier(valid.astype(jnp.float32) * inside_mask(lookup))
