"""Guides for warps where base colour or normals were not rendered: depth knows surfaces apart, and how they lie."""

import jax.numpy as jnp

from essjax.color import sum_channels
from essjax.typing import Image, Plane, Vectors

FOCAL = 0.9
"""Focal length over the image's longer side, where no camera says it: a field of view of 58 degrees."""
DEPTH_GUIDE = 3.0
"""Factor of the logarithm of depth: with base colour's sigma of 0.15 a step of 5 % in depth is one of sigma."""
FARTHEST = 1e6
"""Depth of the background in metres, so that it is a guide like any other."""


def depth_guide(depth: Plane) -> Image:
    """Make a guide in place of base colour, ``[..., H, W, 3]``: log depth, which surfaces keep from frame to frame.

    Differences are relative, whatever the unit: at one sigma (0.15) they are 5 %.

    Args:
      depth: ``[..., H, W, 1]``, +inf on the background.
    """
    guide = DEPTH_GUIDE * jnp.log(jnp.clip(depth, 1e-6, FARTHEST))
    return jnp.concatenate([guide, jnp.zeros_like(guide), jnp.zeros_like(guide)], axis=-1)


def normals_from_depth(depth: Plane) -> Vectors:
    """Estimate normals in camera space from depth, ``[..., H, W, 3]``: (x right, y down, z towards the camera).

    Differences of log depth along x and y, of the two neighbours the nearer one in depth, so that a normal is not
    made of two surfaces. For comparing pixels of two frames in a row: a turn of the camera between them is small.

    Args:
      depth: ``[..., H, W, 1]``, +inf on the background, where the result is 0.
    """
    height, width = depth.shape[-3:-1]
    known = jnp.isfinite(depth)
    log = jnp.log(jnp.where(known, jnp.maximum(depth, 1e-6), 1.0))
    focal = FOCAL * max(height, width)

    def slope(axis: int):
        index = jnp.arange(depth.shape[axis])
        before, after = jnp.maximum(index - 1, 0), jnp.minimum(index + 1, depth.shape[axis] - 1)
        steps = []
        for near, far in ((before, index), (index, after)):
            step = jnp.take(log, far, axis) - jnp.take(log, near, axis)
            apart = (near == far).reshape(-1, *(1,) * (-axis - 1))
            usable = jnp.take(known, near, axis) & jnp.take(known, far, axis) & ~apart
            steps.append(jnp.where(usable, step, jnp.inf))
        chosen = jnp.where(jnp.abs(steps[0]) <= jnp.abs(steps[1]), *steps)
        return jnp.where(jnp.isfinite(chosen), focal * chosen, 0.0)

    normal = jnp.concatenate([slope(-2), slope(-3), jnp.ones_like(log)], axis=-1)
    return jnp.where(known, normal / jnp.sqrt(sum_channels(normal**2)), 0.0)
