"""Motion fields: jitter difference, composition along the path, upsampling, dilation, splatting."""

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.sizes import Size, ratios
from essjax.typing import Array, Image, Jitter, Mask, Motion, Places, Plane
from essjax.warp._batch import check_channels
from essjax.warp._splat import splat_nearest
from essjax.warp.sampling import inside_mask, sample
from essjax.warp.upsample import check_jitter, jitter_aligned_upsample


def jittered_motion(motion: Motion, jitter: Jitter, jitter_previous: Jitter) -> Motion:
    """Point to where a warp between jittered frames reads: ``motion + (jitter - jitter_previous)`` (SPEC 0).

    Pixel x of frame t was sampled at x + j_t; that point was at x + j_t + motion in frame t-1, whose pixels were
    sampled at their centres + j_{t-1}. Only for low-resolution frames: references and HR history are unjittered.

    Args:
      motion: ``[..., H, W, 2]`` unjittered, pixels.
      jitter: ``[..., 2]`` of the current frame, pixels of the same resolution.
      jitter_previous: ``[..., 2]`` of the frame that is read.

    Raises:
      ValueError: the motion is not ``[..., H, W, 2]``, or a jitter not ``[..., 2]``.
    """
    check_channels("motion", motion, 2)
    return motion + (check_jitter(jitter) - check_jitter(jitter_previous))[..., None, None, :]


def compose_motion(
    motion: Motion,
    previous: Motion,
    *,
    jitter: Jitter | None = None,
    jitter_previous: Jitter | None = None,
    valid_previous: Mask | None = None,
    mode: str = "bilinear",
) -> tuple[Motion, Mask]:
    """Motion over two steps, followed along the path (SPEC 1): t to t-1, then what t-1 says there.

    Chain it for more steps: ``compose_motion(m_t, compose_motion(m_t1, m_t2)[0])`` leads from t to t-3.

    Args:
      motion: ``[..., H, W, 2]`` t to t-1, unjittered, pixels.
      previous: ``[..., H, W, 2]`` t-1 to an earlier frame, stored at the pixels of t-1.
      jitter: ``[..., 2]`` of frame t. With ``jitter_previous`` it moves the lookup only, never the result, which stays
        unjittered.
      jitter_previous: ``[..., 2]`` of frame t-1; give both or none.
      valid_previous: ``[..., H, W, 1]`` 1 where ``previous`` can be trusted; read nearest along the path.
      mode: how ``previous`` is interpolated, see ``sample``.

    Returns:
      The motion ``[..., H, W, 2]`` from t to the earlier frame and its mask ``[..., H, W, 1]``: 1 where every position
      on the path is inside the image (and ``valid_previous``).

    Raises:
      ValueError: only one of the jitters is given, or sizes differ.
    """
    check_channels("previous", previous, 2, motion.shape[-3:-1])
    if (jitter is None) != (jitter_previous is None):
        raise ValueError("compose_motion: expected both jitter and jitter_previous or neither, got one.")
    lookup = motion if jitter is None or jitter_previous is None else jittered_motion(motion, jitter, jitter_previous)
    positions = pixel_positions(motion.shape[-3], motion.shape[-2]) + lookup
    total = motion + sample(previous, positions, mode=mode)
    valid = inside_mask(lookup) * inside_mask(total)
    if valid_previous is not None:
        valid = valid * sample(valid_previous, positions, mode="nearest", outside="zeros")
    return total, valid


def upsample_motion(motion: Motion, size: Size, *, jitter: Jitter | None = None, mode: str = "bilinear") -> Places:
    """Motion at a higher resolution, in its pixels: values times the ratio of each axis.

    HR pixel P reads at (P + 0.5) / ratio - jitter, because LR motion is stored at the jittered sample positions
    (SPEC 0).

    Args:
      motion: ``[..., H, W, 2]`` LR pixels.
      size: (height, width) of the output.
      jitter: ``[..., 2]`` of the frame, LR pixels; 0 if None.
      mode: "nearest" keeps silhouettes sharp, "bilinear" keeps motion smooth; see ``sample``.

    Returns:
      ``[..., *size, 2]`` HR pixels.
    """
    check_channels("motion", motion, 2)
    jitter = jnp.zeros(2, motion.dtype) if jitter is None else jitter
    upsampled = jitter_aligned_upsample(motion, size, jitter, mode=mode)
    along_x, along_y = ratios(motion.shape[-3:-1], size)
    return upsampled * (along_x if along_x == along_y else jnp.array([along_x, along_y], motion.dtype))


def _shifted(image: Array, dy: int, dx: int, radius: int, height: int, width: int) -> Array:
    """Cut out the window of an image padded by ``radius`` whose pixel (y, x) is the original's (y + dy, x + dx)."""
    return image[..., radius + dy : radius + dy + height, radius + dx : radius + dx + width, :]


def dilate_motion(motion: Image, depth: Plane, *, radius: int = 1) -> Image:
    """Motion of the nearest surface in the (2 radius + 1)^2 neighbourhood, so that edges move with the foreground.

    Args:
      motion: ``[..., H, W, 2]`` pixels.
      depth: ``[..., H, W, 1]`` positive view-space z, background +inf. The centre wins ties, then the first in rows.
      radius: pixels; 0 returns the motion unchanged.

    Returns:
      ``[..., H, W, 2]``.

    Raises:
      ValueError: sizes differ or the radius is negative.
    """
    height, width = motion.shape[-3:-1]
    check_channels("depth", depth, 1, (height, width))
    if radius < 0:
        raise ValueError(f"radius: expected >= 0 pixels, got {radius}.")
    margin = [(radius, radius), (radius, radius), (0, 0)]
    pad = lambda image, **how: jnp.pad(image, [(0, 0)] * (image.ndim - 3) + margin, **how)  # noqa: E731
    padded_depth, padded_motion = pad(depth, constant_values=jnp.inf), pad(motion, mode="edge")
    offsets = [(dy, dx) for dy in range(-radius, radius + 1) for dx in range(-radius, radius + 1) if (dy, dx) != (0, 0)]
    nearest, result = depth, motion
    for dy, dx in offsets:
        other = _shifted(padded_depth, dy, dx, radius, height, width)
        closer = other < nearest
        nearest = jnp.where(closer, other, nearest)
        result = jnp.where(closer, _shifted(padded_motion, dy, dx, radius, height, width), result)
    return jax.lax.optimization_barrier(result)  # computed once, not again in every gather that reads it


def splat_motion(values: Image, depth: Plane, motion: Motion) -> tuple[Image, Plane, Mask]:
    """Carry pixels to where their motion leads: ``splat_nearest``, its cracks filled.

    A crack (a pixel that nothing was written to, next to one that was) takes the values of the nearest surface around.

    Args:
      values: ``[..., H, W, C]`` of the current frame, for example motion.
      depth: ``[..., H, W, 1]`` of the current frame, background +inf.
      motion: ``[..., H, W, 2]`` pixels, current to previous, with the jitter difference where frames are jittered.

    Returns:
      On the previous frame's pixels: the values ``[..., H, W, C]`` and the depth that came with them, 0 where nothing
      is known, and ``[..., H, W, 1]``: 1 where a pixel was written to, 0.5 in filled cracks, 0 where nothing is known.
    """
    splatted, covered = splat_nearest(jnp.concatenate([values, depth], axis=-1), depth, motion)
    # Finite, so that background counts as nearer than nothing.
    key = jnp.where(covered > 0, jnp.minimum(splatted[..., -1:], jnp.finfo(depth.dtype).max), jnp.inf)
    neighbour = dilate_motion(jnp.concatenate([splatted, covered], axis=-1), key)
    filled = jnp.where(covered > 0, splatted, neighbour[..., :-1])
    return filled[..., :-1], filled[..., -1:], jnp.maximum(covered, 0.5 * neighbour[..., -1:])
