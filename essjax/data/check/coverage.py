"""At which rates the rendered frames alone cover the pixel: what their jitter says, without any picture."""

from collections.abc import Sequence

import numpy as np

from essjax.data.check.finding import Finding
from essjax.typing import Jitter

ROW = "jitter, rates"
RATES = (1, 2, 3, 4)
WINDOW = 16
"""Rendered frames that must cover it together: an accumulation looks back about as far."""
FEWEST = 6
"""Rendered frames below which nothing is said."""
COVERS = 1.6
"""Largest gap, in that of a square grid of as many points, that still covers: Halton (2, 3) has 1.0 to 1.5."""
NOTHING = 1e-3
_GRID = 32


def largest_gap(points: Jitter) -> float:
    """Largest distance from any place in the pixel to the nearest sample, over that of a square grid of as many.

    Args:
      points: ``[N, 2]`` pixels; the pixel repeats in both directions.

    Returns:
      1 for a grid, at least about 0.9; growing without bound where a part of the pixel is never seen.
    """
    places = (np.stack(np.meshgrid(*2 * [np.arange(_GRID)]), axis=-1).reshape(-1, 1, 2) + 0.5) / _GRID - 0.5
    apart = np.abs(places - np.asarray(points)) % 1.0
    nearest = (np.minimum(apart, 1.0 - apart) ** 2).sum(axis=-1).min(axis=1)
    return float(np.sqrt(2 * len(points) * nearest.max()))


def judge_coverage(jitters: Sequence[Jitter]) -> Finding:
    """Say at which rates 1:k every run of rendered frames covers the pixel.

    Args:
      jitters: of all frames of each sequence, ``[T, 2]``, in order.
    """
    if not max((np.abs(jitter).max() for jitter in jitters), default=0.0) > NOTHING:
        return Finding(ROW, "not decidable", "the frames have no jitter")
    gaps = {}
    for rate in RATES:
        windows = [
            rendered[start : start + WINDOW]
            for jitter in jitters
            for rendered in (np.asarray(jitter)[phase::rate] for phase in range(rate))
            for start in range(0, len(rendered), WINDOW)
        ]
        found = [largest_gap(window) for window in windows if len(window) >= FEWEST]
        if found:
            gaps[rate] = max(found)
    if not gaps:
        return Finding(ROW, "not decidable", f"there are fewer than {FEWEST} frames in a row")
    good = [f"1:{rate}" for rate, gap in gaps.items() if gap <= COVERS]
    bad = [f"1:{rate} (gaps {gap:.1f} times a grid's)" for rate, gap in gaps.items() if gap > COVERS]
    numbers = {f"1:{rate}": round(gap, 2) for rate, gap in gaps.items()}
    found = f"the rendered frames cover the pixel at {', '.join(good)}" if good else "they cover it at no rate"
    found += f"; not at {', '.join(bad)}" if bad else ""
    if gaps[min(gaps)] <= COVERS:
        return Finding(ROW, "ok", found, "", numbers)
    fix = "render with a sequence that covers the pixel: Halton (2, 3) for 1:1, docs/conventions.md for every rate"
    return Finding(ROW, "warning", found, fix, numbers)
