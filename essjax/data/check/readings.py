"""How motion could have been meant, and what to do if one of these readings is the right one."""

import jax
import numpy as np

from essjax.cameras import pixel_positions, static_motion
from essjax.data.check.pairs import Step
from essjax.data.layout import SequenceInfo
from essjax.sizes import ratios
from essjax.typing import Array, Jitter, Motion

FIXES = {
    "as stated": "",
    "x flipped": "motion.X has the wrong sign: negate it at import (recipe: x in [motion])",
    "y flipped": "motion.Y has the wrong sign: negate it at import (y points down; recipe: y in [motion])",
    "both flipped": "motion points the wrong way: negate X and Y at import (previous = current + motion; recipe: "
    "sign in [motion])",
    "swapped": "motion.X and motion.Y are swapped: exchange them at import (recipe: motion in [channels])",
    "swapped, x flipped": "motion is stored as (y, -x): exchange X and Y at import, then negate X",
    "swapped, y flipped": "motion is stored as (-y, x): exchange X and Y at import, then negate Y",
    "swapped, both flipped": "motion is stored as (-y, -x): exchange X and Y at import and negate both",
    "times 2": "motion is too short: multiply it by 2 at import (recipe: scale, unit or encoding in [motion])",
    "times 1/2": "motion is too long: multiply it by 0.5 at import (recipe: scale, unit, resolution or encoding in "
    "[motion])",
    "times scale": "motion is too short: multiply it by {scale}, the scale, at import (recipe: scale in [motion])",
    "times 1/scale": "motion is in pixels of the reference: divide it by {scale} at import (recipe: resolution in "
    "[motion])",
    "times size (UV)": "motion is in UV units: multiply X by {width} and Y by {height} at import (recipe: unit in "
    "[motion])",
    "times half size (NDC)": "motion is in NDC: multiply X by {width}/2 and Y by -{height}/2 at import (recipe: unit "
    "and y in [motion])",
    "plus jitter": "motion has the jitter in it: add jitter(t) - jitter(t-1) to it at import",
    "minus jitter": "motion has the jitter in it: subtract jitter(t) - jitter(t-1) from it at import (recipe: jittered "
    "in [motion])",
    "squared (Unreal 5)": "motion is stored as its square root, as Unreal 5 does: decode it at import (recipe: "
    "encoding 'unreal5' in [motion])",
    "square root (Unreal 4)": "motion is not stored as its square root: take it as it is at import (recipe: encoding "
    "'unreal4' in [motion])",
    "none": "motion does not describe the pictures: is it that of another frame (off by one) or of another camera?",
    "of the cameras": "motion is not that of cameras and depth: is it that of another frame (off by one), or without "
    "the camera's part?",
}
"""Reading -> what to do if it explains the pictures best. The first is the dataset's; simple ones come first.
Recipes are those of ``essjax import --preset generic``."""
READINGS = tuple(FIXES)
NONE = READINGS.index("none")
JITTERED = ("plus jitter", "minus jitter")
"""Only unjittered references can tell whether jitter is in the motion: jittered frames are not asked."""


@jax.jit
def _camera_motion(now, before, jitter: Jitter, depth: Array) -> Motion:
    height, width = depth.shape[:2]
    return static_motion(now, before, pixel_positions(height, width, jitter), depth)


def camera_motion(step: Step) -> np.ndarray | None:
    """Motion of a static world under the cameras; None without cameras."""
    if step.before is None or step.now.camera is None or step.before.camera is None:
        return None
    depth = np.where(step.now.gbuffers.depth > 0, step.now.gbuffers.depth, np.inf)
    return np.asarray(_camera_motion(step.now.camera, step.before.camera, step.now.jitter, depth))


def jitter_step(step: Step) -> np.ndarray:
    """jitter(t) - jitter(t-1), LR pixels."""
    assert step.before is not None
    return np.asarray(step.now.jitter) - np.asarray(step.before.jitter)


def motions_of(step: Step) -> dict[str, np.ndarray]:
    """Every reading's motion ``[H, W, 2]``; NaN where the dataset lacks what it takes."""
    motion, jitter = np.asarray(step.now.motion, np.float32), jitter_step(step)
    (height, width), (along_x, along_y) = step.size, ratios(step.size, step.output)
    odd = {along_x, along_y}.isdisjoint({1, 2})  # else it is another reading
    swapped = motion[..., ::-1]
    times = lambda image, x, y: image * np.array([x, y], np.float32)
    cameras = camera_motion(step)
    missing = np.full_like(motion, np.nan)
    half = np.array([width / 2, height / 2], np.float32)
    ndc = motion / half
    result = {
        "as stated": motion,
        "x flipped": times(motion, -1, 1), "y flipped": times(motion, 1, -1), "both flipped": -motion,
        "swapped": swapped, "swapped, x flipped": times(swapped, -1, 1),
        "swapped, y flipped": times(swapped, 1, -1), "swapped, both flipped": -swapped,
        "times 2": motion * 2, "times 1/2": motion / 2,
        "times scale": times(motion, along_x, along_y) if odd else missing,
        "times 1/scale": times(motion, 1 / along_x, 1 / along_y) if odd else missing,
        "times size (UV)": times(motion, width, height),
        "times half size (NDC)": times(motion, width / 2, -height / 2),
        "plus jitter": motion + jitter, "minus jitter": motion - jitter,
        "squared (Unreal 5)": 0.5 * ndc * np.abs(ndc) * half,
        "square root (Unreal 4)": np.sign(ndc) * np.sqrt(2 * np.abs(ndc)) * half,
        "none": motion * 0,
        "of the cameras": missing if cameras is None else cameras,
    }  # fmt: skip
    return {name: np.ascontiguousarray(result[name]) for name in READINGS}


def fix_of(reading: str, info: SequenceInfo) -> str:
    """Say what to do if ``reading`` is the right one."""
    along_x, along_y = ratios(info.size, info.output)
    scale = f"{along_x:.4g}" if along_x == along_y else f"{along_x:.4g} (x) and {along_y:.4g} (y)"
    return FIXES[reading].format(width=info.width, height=info.height, scale=scale)
