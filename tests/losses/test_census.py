import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from essjax.losses import census, feature_census
from tests.helpers import random_image

pytestmark = pytest.mark.usefixtures("strict_numerics")
SEEDS = st.integers(0, 10_000)


def oracle(a, b, window):
    """Pixel by pixel, neighbour by neighbour, in float64."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    height, width, channels = a.shape
    radius, result = window // 2, np.zeros((height, width, 1))
    for y in range(radius, height - radius):
        for x in range(radius, width - radius):
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    for c in range(channels):
                        p, q = a[y + dy, x + dx, c] - a[y, x, c], b[y + dy, x + dx, c] - b[y, x, c]
                        squared = (p / np.sqrt(0.81 + p * p) - q / np.sqrt(0.81 + q * q)) ** 2
                        result[y, x, 0] += squared / (0.1 + squared)
    return result / (window**2 * channels)


@given(seed=SEEDS)
def test_census_matches_a_loop(seed):
    a, b = random_image(seed, 9, 11, 3), random_image(seed + 1, 9, 11, 3)
    grey = [np.asarray(x, np.float64) @ np.array([[0.2989], [0.5870], [0.1140]]) for x in (a, b)]
    np.testing.assert_allclose(jax.jit(census)(a, b), oracle(*grey, 7), atol=2e-6)


@given(seed=SEEDS)
def test_feature_census_matches_a_loop(seed):
    a, b = random_image(seed, 5, 6, 4, low=-2.0), random_image(seed + 1, 5, 6, 4, low=-2.0)
    np.testing.assert_allclose(jax.jit(feature_census)(a, b), oracle(a, b, 3), atol=2e-6)


def test_leading_axes_are_independent():
    a, b = random_image(0, 2, 3, 8, 9, 3), random_image(1, 2, 3, 8, 9, 3)
    whole = jax.jit(census)(a, b)
    assert whole.shape == (2, 3, 8, 9, 1)
    np.testing.assert_allclose(whole[1, 2], jax.jit(census)(a[1, 2], b[1, 2]), atol=1e-6)


def test_brightness_offset_costs_nothing_and_the_border_is_masked():
    image = random_image(2, 12, 10, 3)
    np.testing.assert_allclose(jax.jit(census)(image, image + 0.25), 0.0, atol=1e-6)
    cost = np.asarray(jax.jit(census)(image, random_image(3, 12, 10, 3)))
    assert (cost[3:-3, 3:-3] > 0).all()
    assert cost[3:-3, 3:-3].sum() == pytest.approx(cost.sum())


@pytest.mark.parametrize("loss, channels", [(census, 3), (feature_census, 5)])
def test_gradient_is_finite_at_equal_and_flat_images(loss, channels):
    noise, flat = random_image(4, 9, 8, channels), jnp.ones((9, 8, channels))
    gradient = jax.jit(jax.grad(lambda x, y: jnp.mean(loss(x, y))))
    for a, b in ((noise, noise), (flat, flat), (flat, noise), (1e4 * noise, flat)):
        assert np.isfinite(gradient(a, b)).all()


def test_gradient_matches_finite_differences():
    a, b = random_image(5, 4, 5, 2), random_image(6, 4, 5, 2)
    jax.test_util.check_grads(
        lambda x: jnp.sum(feature_census(x, jnp.asarray(b))), (a,), order=1, modes=["rev"], eps=1e-2
    )


def test_messages():
    with pytest.raises(ValueError, match="window: expected an odd size >= 3, got 4"):
        census(jnp.zeros((9, 9, 3)), jnp.zeros((9, 9, 3)), window=4)
    with pytest.raises(ValueError, match=r"at least 7x7 pixels \(the window\), got 20x6"):
        census(jnp.zeros((6, 20, 3)), jnp.zeros((6, 20, 3)))
    with pytest.raises(ValueError, match="expected 3 or 1 channels, got 8. Use feature_census"):
        census(jnp.zeros((9, 9, 8)), jnp.zeros((9, 9, 8)))
