"""Warps, pure and for any leading axes: sampling, motion fields, guided warping, occlusion, upsampling.

Images are ``[..., H, W, C]``, motion is ``[..., H, W, 2]`` in pixels (x right, y down), current to previous; pixel
centres lie at +0.5. All functions may be jitted, vmapped and differentiated.
"""

from essjax.warp._splat import splat, splat_nearest
from essjax.warp.backward import backward_warp
from essjax.warp.candidates import candidate_offsets
from essjax.warp.depth_guides import depth_guide, normals_from_depth
from essjax.warp.fetches import sample_by_fetches
from essjax.warp.fill import fill_holes
from essjax.warp.gbuffer_guided import gbuffer_guided_warp, guided_weights, guides
from essjax.warp.half_grid import half_grid_offset, half_size, to_half_grid
from essjax.warp.motion import compose_motion, dilate_motion, jittered_motion, splat_motion, upsample_motion
from essjax.warp.occlusion import hole_mask, occlusion_motion
from essjax.warp.resample import Resampled, gaussian_resample, tent_resample
from essjax.warp.sampling import inside_mask, sample
from essjax.warp.upsample import (
    depth_to_space,
    jitter_aligned_upsample,
    nearest_upsample,
    sample_zero_upsampled,
    space_to_depth,
    zero_upsample,
)

__all__ = [
    "Resampled", "backward_warp", "candidate_offsets", "compose_motion", "depth_guide", "depth_to_space",
    "dilate_motion", "fill_holes", "gaussian_resample", "gbuffer_guided_warp", "guided_weights", "guides",
    "half_grid_offset", "half_size", "hole_mask", "inside_mask", "jitter_aligned_upsample", "jittered_motion",
    "nearest_upsample", "normals_from_depth", "occlusion_motion", "sample", "sample_by_fetches",
    "sample_zero_upsampled", "space_to_depth", "splat", "splat_motion", "splat_nearest", "tent_resample",
    "to_half_grid", "upsample_motion", "zero_upsample",
]  # fmt: skip
