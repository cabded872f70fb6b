"""Bicubic reads from bilinear fetches, against direct sums over pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.warp import sample, sample_by_fetches
from tests.warp.test_sampling import cubic

H, W = 7, 10
read = jax.jit(sample_by_fetches, static_argnames=("fetches", "parameter"))


def random_read(seed=3):
    rng = np.random.default_rng(seed)
    positions = rng.uniform((-2, -2), (W + 2, H + 2), (6, 5, 2))
    positions[0, 0] = 3.5, 2.5  # a pixel centre
    return rng.uniform(-1, 2, (H, W, 3)).astype(np.float32), positions.astype(np.float32)


def without_corners(image, x, y, a):
    """12 of the 4x4 pixels, in float64, divided by the sum of their weights."""
    column, row = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
    total, weights = np.zeros(3), 0.0
    for r in range(row - 1, row + 3):
        for c in range(column - 1, column + 3):
            if r in (row - 1, row + 2) and c in (column - 1, column + 2):
                continue
            weight = cubic(y - r - 0.5, a) * cubic(x - c - 0.5, a)
            total += weight * image[np.clip(r, 0, H - 1), np.clip(c, 0, W - 1)]
            weights += weight
    return total / weights


def test_nine_fetches_are_the_bicubic_kernel():
    image, positions = random_read()
    expected = sample(image, positions, mode="bicubic-0.75")
    np.testing.assert_allclose(read(image, positions), expected, atol=2e-5)


@pytest.mark.parametrize("a", [-0.75, -0.5])
def test_five_fetches_leave_out_the_corners(a):
    image, positions = random_read(4)
    expected = np.array([[without_corners(image, *p, a) for p in row] for row in positions])
    np.testing.assert_allclose(read(image, positions, fetches=5, parameter=a), expected, atol=2e-5)


def test_leading_axes_and_errors():
    image, positions = random_read(5)
    both = read(jnp.stack([image, image[::-1]]), jnp.asarray(positions)[None], fetches=5)
    np.testing.assert_allclose(both[0], read(image, positions, fetches=5), rtol=1e-6)
    with pytest.raises(ValueError, match="fetches: expected 5 or 9, got 4"):
        sample_by_fetches(image, positions, fetches=4)
    with pytest.raises(ValueError, match=r"positions: expected \[..., H, W, 2\]"):
        sample_by_fetches(image, image)
