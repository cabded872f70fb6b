"""Pull-push: what stays, what a hole may become, and images whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.warp import fill_holes
from tests.helpers import random_image

H, W = 11, 18
fill = jax.jit(fill_holes)


def holes(seed=0):
    """Random holes and one large one."""
    mask = np.random.default_rng(seed).uniform(size=(2, H, W, 1)) > 0.3
    mask[:, 2:9, 4:13] = False
    return mask


def test_valid_pixels_stay_and_holes_are_averages():
    image, mask = np.asarray(random_image(1, 2, H, W, 3, low=0.5)), holes()
    filled = np.asarray(fill(np.where(mask, image, np.nan), mask.astype(np.float32)))
    np.testing.assert_allclose(np.where(mask, filled, 0), np.where(mask, image, 0), rtol=1e-6)
    for b in range(2):
        for c in range(3):
            valid = image[b, ..., c][mask[b, ..., 0]]
            assert valid.min() - 1e-5 <= filled[b, ..., c].min() and filled[b, ..., c].max() <= valid.max() + 1e-5


def test_constant_stays_constant():
    mask = holes(2).astype(np.float32)
    np.testing.assert_allclose(fill(0.7 * jnp.ones((2, H, W, 3)), mask), 0.7, rtol=1e-5)


def test_a_hole_takes_the_colour_of_its_side():
    """Left half 1, right half 3, a hole in each."""
    image = np.where(np.arange(W) < 9, 1.0, 3.0)[None, None, :, None] * np.ones((2, H, W, 3))
    mask = np.ones((2, H, W, 1), np.float32)
    mask[:, 4:6, 2:4], mask[:, 4:6, 14:16] = 0, 0
    np.testing.assert_allclose(fill(image, mask), image, atol=0.2)


def test_one_valid_pixel_fills_the_image_and_none_gives_zero():
    image, mask = random_image(3, 2, H, W, 3), np.zeros((2, H, W, 1), np.float32)
    mask[0, 10, 17] = 1.0  # the corner of odd sizes
    filled = fill(image, mask)
    np.testing.assert_allclose(filled[0], jnp.broadcast_to(image[0, 10, 17], (H, W, 3)), rtol=1e-5)
    np.testing.assert_array_equal(filled[1], 0.0)


def test_half_trust_is_half_way():
    image = jnp.ones((2, H, W, 3)).at[0, 5, 8].set(3.0)
    mask = jnp.ones((2, H, W, 1)).at[0, 5, 8].set(0.5)
    value = float(fill(image, mask)[0, 5, 8, 0])
    assert 2.0 < value < 2.5  # half of 3, half of a neighbourhood near 1 that still holds some of the 3


def test_sizes_must_agree():
    with pytest.raises(ValueError, match=r"mask: expected \[..., 4, 5, 1\], got \(5, 4, 1\)"):
        fill_holes(jnp.zeros((4, 5, 3)), jnp.zeros((5, 4, 1)))
