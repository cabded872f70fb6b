"""Comparing readings and locating a minimum, by hand."""

import numpy as np
import pytest

from essjax.data.check.compare import Comparison
from essjax.data.check.jitter import SHIFTS, locate_minimum


def test_comparison_by_hand():
    """Two readings 1 px apart in half of 800 pixels, errors 0.1 and 0.2: 20 log10 2 = 6.02 dB; a third is missing."""
    comparison = Comparison(("stated", "other", "missing"))
    lookups, usable = np.zeros((3, 20, 40, 2)), np.ones((3, 20, 40), bool)
    lookups[1, :10, :, 1], usable[2] = 1.0, False
    errors = np.stack([np.full((20, 40), 0.1), np.full((20, 40), 0.2), np.full((20, 40), np.nan)])
    comparison.add(errors, lookups, usable)
    assert comparison.count[0, 1] == 400 and comparison.count[0, 2] == 0
    assert comparison.margin(0, 1) == pytest.approx(6.0206, abs=1e-3) == -comparison.margin(1, 0)
    assert comparison.best() == 0 and comparison.rivals() == [1]
    turned = Comparison(comparison.names)
    turned.add(errors[[1, 0, 2]], lookups, usable)
    assert turned.best() == 1


def test_minimum_by_hand():
    """A paraboloid around (0.3, -0.15): a parabola through three points finds its vertex exactly."""
    surface = (SHIFTS[None] - 0.3) ** 2 + 2 * (SHIFTS[:, None] + 0.15) ** 2
    np.testing.assert_allclose(locate_minimum(surface), [0.3, -0.15], atol=1e-9)
