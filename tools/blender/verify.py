"""Prove the conventions of an imported clip on its own pictures: motion, jitter, and that motion has no jitter in it.

Run it in essjax's environment:  python tools/blender/verify.py DATASET

Every line compares what the dataset says with the alternatives; the statement must win. Exit code 1 if it does not.
"""

import sys
from itertools import pairwise
from typing import Any

import jax
import numpy as np

from essjax import cameras, warp
from essjax.data import Dataset, read_dataset, read_sequence
from essjax.frames import Sequence, select_time

ClipFrame = Any
"""An essjax ``Frame`` with all that the blender preset writes: colour, camera, world position, stencil."""
SIGNS = {"as stated": (1, 1), "none": (0, 0), "x flipped": (-1, 1), "y flipped": (1, -1), "both flipped": (-1, -1)}
MOTION_GAIN, MARGIN, RESIDUAL = 6.0, 0.5, 0.05
"""dB over no motion, dB over every alternative, pixels (99th percentile) that geometry may be off."""
HOLE_MASK = jax.jit(warp.hole_mask)
SILHOUETTE = 2
"""LR pixels around holes and background that do not count: the reference's pixels mix two surfaces there."""


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    """Of linear radiance after x / (1 + x), over the pixels ``[H, W, 1]`` of ``mask``."""
    squared = (a / (1 + a) - b / (1 + b)) ** 2
    return float(-10 * np.log10((squared * mask).sum() / (3 * mask.sum())))


def inner(region: np.ndarray) -> np.ndarray:
    """Pixels ``[H, W, 1]`` whose whole neighbourhood is in the region."""
    padded = np.pad(region, ((SILHOUETTE, SILHOUETTE), (SILHOUETTE, SILHOUETTE), (0, 0)))
    size = 2 * SILHOUETTE + 1
    return np.lib.stride_tricks.sliding_window_view(padded, (size, size), (0, 1)).min((-1, -2))


def motion_quality(
    now: ClipFrame, before: ClipFrame, reference: np.ndarray, reference_before: np.ndarray
) -> dict[str, float]:
    """PSNR of the previous reference warped to this one, on surfaces that were visible before."""
    scale = reference.shape[0] // now.motion.shape[0]
    jitters = {"jitter": now.jitter, "jitter_previous": before.jitter}
    valid = np.asarray(HOLE_MASK(now.gbuffers, before.gbuffers, now.motion, **jitters))
    mask = inner(valid * np.isfinite(now.gbuffers.depth)).repeat(scale, 0).repeat(scale, 1)
    motion = np.asarray(warp.upsample_motion(now.motion, scale, jitter=now.jitter))
    warped = {
        name: np.asarray(warp.backward_warp(reference_before, motion * np.asarray(s, np.float32)))
        for name, s in SIGNS.items()
    }
    return {name: psnr(image, reference, mask) for name, image in warped.items()}


def jitter_quality(frame: ClipFrame, reference: np.ndarray) -> dict[str, float]:
    """PSNR of the LR colour against the reference read at pixel centre + jitter."""
    height, width = frame.motion.shape[:2]
    scale, mask = reference.shape[0] // height, np.ones((height, width, 1))

    def read(sign: tuple[int, int]) -> np.ndarray:
        positions = cameras.pixel_positions(height, width, frame.jitter * np.asarray(sign, np.float32))
        return np.asarray(warp.sample(reference, scale * positions, mode="bicubic"))

    return {name: psnr(frame.color, np.maximum(read(sign), 0), mask) for name, sign in SIGNS.items()}


def _off(a: Any, b: Any, where: np.ndarray) -> float:
    """99th percentile of the distance in pixels."""
    return float(np.percentile(np.linalg.norm(np.asarray(a) - np.asarray(b), axis=-1)[where], 99))


def residuals(now: ClipFrame, before: ClipFrame) -> tuple[float, float]:
    """Pixels between rendered and camera motion on static surfaces, and between samples and pixel centre + jitter.

    The second projects world positions, which knows nothing of jitter.
    """
    height, width = now.motion.shape[:2]
    positions = cameras.pixel_positions(height, width, now.jitter)
    expected = cameras.static_motion(now.camera, before.camera, positions, now.gbuffers.depth)
    hit = np.isfinite(now.gbuffers.depth[..., 0])
    projected, _ = cameras.project(now.camera, now.gbuffers.world_position)
    static = hit & (np.asarray(now.gbuffers.stencil)[..., 0] == 0)
    return _off(now.motion, expected, static), _off(projected, positions, hit)


def report(title: str, qualities: list[dict[str, float]]) -> dict[str, float]:
    """Print and return the mean over frames."""
    mean = {name: float(np.mean([q[name] for q in qualities])) for name in SIGNS}
    print(f"{title:8}" + "  ".join(f"{name} {value:5.2f} dB" for name, value in mean.items()))
    return mean


def verify(sequence: Sequence) -> bool:
    """Print three lines; whether all conventions hold."""
    frames = [select_time(sequence.frames, t) for t in range(len(sequence.reference))]
    pairs = [(b, a, rb, ra) for (a, ra), (b, rb) in pairwise(zip(frames, sequence.reference, strict=True)) if not b.cut]
    motion = report("motion", [motion_quality(*pair) for pair in pairs])
    jitter = report("jitter", [jitter_quality(f, r) for f, r in zip(frames, sequence.reference, strict=True)])
    leak, shift = np.max([residuals(now, before) for now, before, *_ in pairs], axis=0)
    print(f"off by    {leak:.4f} px: motion of static surfaces against the cameras'")
    print(f"          {shift:.4f} px: samples against pixel centre + jitter")
    others = lambda means: max(value for name, value in means.items() if name != "as stated")
    return (
        motion["as stated"] > motion["none"] + MOTION_GAIN
        and motion["as stated"] > others(motion) + MARGIN
        and jitter["as stated"] > others(jitter) + MARGIN
        and max(leak, shift) < RESIDUAL
    )


def main() -> None:
    """Command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/blender/verify.py DATASET")
    dataset: Dataset = read_dataset(sys.argv[1])
    good = [verify(read_sequence(dataset, name)) for name in dataset.sequences]
    print("all conventions hold" if all(good) else "A CONVENTION DOES NOT HOLD")
    sys.exit(not all(good))


if __name__ == "__main__":
    main()
