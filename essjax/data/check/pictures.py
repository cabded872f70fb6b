"""Pictures of the warp: the reference before, warped, the reference itself, and how they differ."""

from pathlib import Path

import numpy as np
from PIL import Image

from essjax.color import display
from essjax.data.check.pairs import Step
from essjax.data.check.readings import READINGS, motions_of
from essjax.warp import backward_warp, upsample_motion

GAIN = 4.0
"""Errors are shown this many times as bright."""


def _pixels(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)


def warp_picture(step: Step, reading: str) -> np.ndarray:
    """``[sH, 3 sW + 2 gaps, 3]`` bytes: warped, present, absolute difference times ``GAIN``, as displayed."""
    assert step.reference_before is not None
    motion = motions_of(step)[reading]
    warped = backward_warp(step.reference_before, upsample_motion(motion, step.output, jitter=step.now.jitter))
    grey = np.float32(0.18 / step.key)  # whatever the unit of radiance, middle grey looks like middle grey
    shown, present = np.asarray(display(warped * grey)), np.asarray(display(step.reference * grey))
    gap = np.ones((shown.shape[0], 4, 3), np.float32)
    return _pixels(np.concatenate([shown, gap, present, gap, np.abs(shown - present) * GAIN], axis=1))


def write_pictures(folder: Path, step: Step, best: int) -> list[Path]:
    """Write the warp as stated, and as the best reading says if that is another one; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index in dict.fromkeys((0, best)):
        name = READINGS[index].replace(" ", "-").replace(",", "").replace("/", "-").translate({40: None, 41: None})
        path = folder / f"{step.sequence}.{step.number:04d}.{name}.png"
        Image.fromarray(warp_picture(step, READINGS[index])).save(path, optimize=True)
        paths.append(path)
    return paths
