"""Candidates of the guided warp, and the numbers that its XLA program and its Triton kernel share."""

import numpy as np

STRIDES = (1, 3, 5, 9)
LIMIT = 1e15  # scaled guides beyond this match nothing
BORDER = 1e17  # the scaled guide of what cannot be used: squared, and summed over channels, still finite
UNUSABLE = 1e33  # costs of candidates with such a guide are above, all others below
LEAST = 1e-30  # added to costs: their keys are normal numbers, which no backend flushes to zero
REACH = max(STRIDES)
MARGIN = 2 * REACH + 1
"""Pixels around the planes of the previous guides that match nothing: reads never need a comparison of positions."""
FAR = 1e6  # pixels; keeps integers from overflowing


def candidate_offsets() -> np.ndarray:
    """List the 33 offsets ``[33, 2]`` (x, y) of eq 1 in the order that breaks ties: centre, stride, row, column."""
    ring = [(s * k, s * l) for s in STRIDES for l in (-1, 0, 1) for k in (-1, 0, 1) if (k, l) != (0, 0)]  # noqa: E741
    return np.array([(0, 0), *ring], np.int32)
