"""Sub-pixel sample positions."""

import numpy as np


def halton(index: int, base: int) -> float:
    """The radical inverse of ``index`` (>= 1) in ``base``: (0, 1), evenly spread."""
    result, fraction = 0.0, 1.0
    while index > 0:
        fraction /= base
        result += fraction * (index % base)
        index //= base
    return result


def jitter_sequence(length: int, *, period: int = 16, every_frame: bool = False) -> np.ndarray:
    """Jitter of each frame, pixels in [-0.5, 0.5): Halton (2, 3).

    Frame n takes element n // 2, so that even frames alone and odd frames alone cover the pixel (SPEC section 0):
    plain Halton by n puts even and odd n into opposite halves. The two frames of a pair share a jitter.

    Args:
      length: number of frames.
      period: elements before the sequence repeats.
      every_frame: index by n instead: for renderers that show colour of every frame (native TAA).

    Returns:
      ``[length, 2]`` float32, (x, y).
    """
    steps = range(length) if every_frame else [n // 2 for n in range(length)]
    points = [(halton(1 + k % period, 2) - 0.5, halton(1 + k % period, 3) - 0.5) for k in steps]
    return np.asarray(points, np.float32).reshape(length, 2)


def reference_samples(count: int) -> np.ndarray:
    """Positions ``[count, 2]`` in [0, 1)^2 of the reference's samples in a pixel: a golden-ratio lattice.

    As many distinct x as y, so that near-vertical and near-horizontal edges both get ``count`` shades; the same in
    every pixel and frame, so that the reference does not flicker.
    """
    index = np.arange(count)
    x, y = (index + 0.5) / count, (index * 0.6180339887498949 + 0.5 / count) % 1.0
    return np.stack([x, y], axis=-1).astype(np.float32)
