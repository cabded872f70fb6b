"""Sub-pixel sample positions."""

import numpy as np


def halton(index: int, base: int) -> float:
    """Compute the radical inverse of ``index`` (>= 1) in ``base``: (0, 1), evenly spread."""
    result, fraction = 0.0, 1.0
    while index > 0:
        fraction /= base
        result += fraction * (index % base)
        index //= base
    return result


PATTERNS = ("kronecker", "dlctus")
"""Names of the jitter patterns: see ``jitter_sequence``."""
KRONECKER_STEP = (0.829019, 0.600993)
"""From each frame to the next, modulo a pixel, (x, y). Of 30,000 steps the one whose multiples by 1, 2, 3 and 4 cover
the pixel most evenly, 4 to 128 frames long (docs/adr/0016-rates.md)."""
HIGH_RESOLUTION_ORDER = (
    (0, 0), (1, 2), (3, 2), (2, 0), (0, 1), (0, 3), (2, 2), (3, 0),
    (1, 0), (0, 2), (2, 3), (3, 1), (1, 1), (1, 3), (3, 3), (2, 1),
)  # fmt: skip
"""(x, y) of the 4x4 output pixels in an input pixel, each once. No two consecutive ones touch, not even across the
border of the input pixel or from the last to the first, and any four in a row lie in different quadrants."""
HOURGLASS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""(x, y) of the 2x2 output pixels in an input pixel: along the top, the diagonal, along the bottom, the diagonal."""


def dlctus_pattern(scale: int) -> np.ndarray:
    """Return the 16 sample positions of DLCTUS (thesis 002 section 4.2.2, figure 6), pixels in [-0.5, 0.5).

    At 4x4 every sample is the centre of an output pixel; at 2x2 the output pixels are visited in an hourglass, and
    each takes elements 2 to 5 of Halton (2, 3) in turn. The figure's order at 4x4 is not in the text: ours has the
    property that the text asks for, no two consecutive neighbours.

    Args:
      scale: 2 or 4.

    Returns:
      ``[16, 2]`` float32, (x, y).

    Raises:
      ValueError: another scale.
    """
    if scale == 4:
        positions = (np.asarray(HIGH_RESOLUTION_ORDER) + 0.5) / 4
    elif scale == 2:
        inside = [(halton(element, 2), halton(element, 3)) for element in range(2, 6)]
        positions = (np.asarray(inside)[:, None] + np.asarray(HOURGLASS)).reshape(16, 2) / 2
    else:
        raise ValueError(f"jitter: the pattern dlctus exists for the scales 2 and 4, got {scale}. Use kronecker.")
    return (positions - 0.5).astype(np.float32)


def jitter_sequence(length: int, *, pattern: str = "kronecker", scale: int = 2) -> np.ndarray:
    """Jitter of each frame, pixels in [-0.5, 0.5).

    "kronecker": n times ``KRONECKER_STEP``, modulo a pixel; it does not repeat. Every frame, every second, every third
    and every fourth cover the pixel alike, from whichever they begin, for methods that render one frame of so many.
    "dlctus" is ``dlctus_pattern``, indexed by n: for methods that get every frame rendered. Half the frames alone see
    half of it.

    Args:
      length: number of frames.
      pattern: "kronecker" or "dlctus".
      scale: output size over input size, for "dlctus".

    Returns:
      ``[length, 2]`` float32, (x, y).

    Raises:
      ValueError: an unknown pattern, or one that does not exist for this scale.
    """
    if pattern not in PATTERNS:
        raise ValueError(f"jitter: expected one of {', '.join(PATTERNS)}, got {pattern!r}.")
    if pattern == "dlctus":
        return dlctus_pattern(scale)[np.arange(length) % 16].reshape(length, 2)
    points = np.arange(length)[:, None] * np.asarray(KRONECKER_STEP) % 1.0
    return (points - 0.5).astype(np.float32)


def reference_samples(count: int) -> np.ndarray:
    """Positions ``[count, 2]`` in [0, 1)^2 of the reference's samples in a pixel: a golden-ratio lattice.

    As many distinct x as y, so that near-vertical and near-horizontal edges both get ``count`` shades; the same in
    every pixel and frame, so that the reference does not flicker.
    """
    index = np.arange(count)
    x, y = (index + 0.5) / count, (index * 0.6180339887498949 + 0.5 / count) % 1.0
    return np.stack([x, y], axis=-1).astype(np.float32)
