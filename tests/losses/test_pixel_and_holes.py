import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from essjax.losses import (
    charbonnier,
    feature_l1,
    hardest,
    l1,
    masked_mean,
    occlusion,
    spatio_temporal,
    sum_of_means,
    temporal_l1,
)
from tests.helpers import random_image

pytestmark = pytest.mark.usefixtures("strict_numerics")
SEEDS = st.integers(0, 10_000)
SHAPE = (2, 5, 7, 3)


@given(seed=SEEDS)
def test_l1_and_charbonnier_match_numpy(seed):
    a, b = random_image(seed, *SHAPE), random_image(seed + 1, *SHAPE)
    difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    np.testing.assert_allclose(jax.jit(l1)(a, b), np.abs(difference), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jit(charbonnier)(a, b), np.sqrt(difference**2 + 1e-6), rtol=1e-5)


def test_charbonnier_by_hand():
    value = charbonnier(jnp.full((1, 1, 1), 4.0), jnp.full((1, 1, 1), 1.0), epsilon2=16.0)
    assert float(value[0, 0, 0]) == pytest.approx(5.0)  # sqrt(3^2 + 4^2)


@pytest.mark.parametrize("loss", [l1, charbonnier])
def test_gradient_is_finite_where_images_agree(loss):
    image = random_image(0, *SHAPE)
    assert np.isfinite(jax.grad(lambda x: jnp.sum(loss(x, image)))(image)).all()


@pytest.mark.parametrize("loss", [l1, charbonnier])
def test_shapes_that_would_broadcast_are_refused(loss):
    with pytest.raises(
        ValueError, match=r"prediction and target: expected the same shape, got \(5, 7, 3\) and \(5, 7, 1\)"
    ):
        loss(jnp.zeros((5, 7, 3)), jnp.zeros((5, 7, 1)))


@pytest.mark.parametrize("loss", [l1, charbonnier])
def test_sixteen_bit_images_are_compared_in_float32_and_integers_refused(loss):
    """1 + 2^-8 squared needs more than 8 bits."""
    a, b = jnp.array([[[2.0]]], jnp.bfloat16), jnp.array([[[0.9921875]]], jnp.bfloat16)
    assert loss(a, b).dtype == jnp.float32 and float(loss(a, b)[0, 0, 0]) == pytest.approx(1.0078125, rel=1e-6)
    with pytest.raises(ValueError, match="prediction: expected floating-point values, got uint8"):
        loss(a.astype(jnp.uint8), b.astype(jnp.uint8))


def test_masked_mean_of_sixteen_bits_sums_in_float32():
    """256 x 256 ones sum to 65536, beyond float16."""
    ones = jnp.ones((256, 256, 1), jnp.float16)
    assert float(masked_mean(ones, ones)) == 1.0 and masked_mean(ones, ones).dtype == jnp.float32


@given(seed=SEEDS)
def test_masked_mean_matches_numpy(seed):
    values, mask = random_image(seed, *SHAPE), random_image(seed + 1, *SHAPE[:-1], 1, high=1.0)
    mask = jnp.where(mask < 0.4, 0.0, mask)
    wide = np.broadcast_to(np.asarray(mask, np.float64), SHAPE)
    np.testing.assert_allclose(masked_mean(values, mask), np.average(values, weights=wide), rtol=1e-5)
    per_image = [np.average(values[k], weights=wide[k]) for k in range(2)]
    np.testing.assert_allclose(masked_mean(values, mask, axis=(-3, -2, -1)), per_image, rtol=1e-5)


def test_masked_mean_is_safe_when_empty_and_ignores_what_is_masked():
    values = random_image(3, *SHAPE)
    empty = jnp.zeros((*SHAPE[:-1], 1))
    value, gradient = jax.value_and_grad(masked_mean)(values, empty)
    assert value == 0.0 and (np.asarray(gradient) == 0.0).all()
    poisoned = values.at[0, 0, 0].set(jnp.nan).at[0, 0, 1].set(jnp.inf)
    mask = jnp.ones((*SHAPE[:-1], 1)).at[0, 0, :2].set(0.0)
    value, gradient = jax.value_and_grad(masked_mean)(poisoned, mask)
    expected = np.asarray(values)[np.broadcast_to(np.asarray(mask) > 0, SHAPE)].mean()
    assert value == pytest.approx(expected, rel=1e-5)
    assert np.isfinite(gradient).all()


def test_occlusion_by_hand():
    prediction = jnp.array([[[1.0, 2.0, 3.0], [9.0, 9.0, 9.0]]])  # one row of two pixels
    target = jnp.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    hole = jnp.array([[[1.0], [0.0]]])
    per_pixel = occlusion(prediction, target, hole)
    np.testing.assert_array_equal(per_pixel, [[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]])
    # Eq 11: ||m a - m b||_1 / sum(m) = 6, here per channel.
    assert float(masked_mean(per_pixel, hole)) == pytest.approx(2.0)
    assert float(masked_mean(occlusion(prediction, target, 0.0 * hole), 0.0 * hole)) == 0.0


@given(seed=SEEDS)
def test_hardest_pixels_match_a_sort(seed):
    """Eq 6 per image: the mean over the 35 pixels' worst tenth (4 of them), channels averaged first."""
    errors = random_image(seed, *SHAPE)
    weights = jax.jit(hardest)(errors)
    worst = np.sort(np.asarray(errors, np.float64).mean(axis=-1).reshape(2, -1), axis=-1)[:, -4:]
    assert weights.shape == (2, 5, 7, 1) and set(np.unique(weights)) == {0.0, 1.0}
    np.testing.assert_array_equal(weights.sum(axis=(1, 2, 3)), 4.0)
    assert float(masked_mean(errors, weights)) == pytest.approx(worst.mean(), rel=1e-5)
    assert float(jnp.mean(errors * weights)) == pytest.approx(worst.sum() / 70, rel=1e-5)


def test_hardest_pixels_share_ties_and_have_no_gradient():
    errors = jnp.array([[[2.0], [1.0], [1.0], [0.0], [1.0], [0.0]]])  # one row of six pixels
    np.testing.assert_allclose(hardest(errors, share=0.5)[0, :, 0], [1, 2 / 3, 2 / 3, 0, 2 / 3, 0], rtol=1e-6)
    np.testing.assert_array_equal(hardest(errors, share=1e-6)[0, :, 0], [1, 0, 0, 0, 0, 0])  # at least one
    gradient = jax.grad(lambda x: masked_mean(x, hardest(x, share=0.5)))(errors)
    np.testing.assert_allclose(gradient[0, :, 0], np.array([1, 2 / 3, 2 / 3, 0, 2 / 3, 0]) / 3, rtol=1e-6)
    with pytest.raises(ValueError, match=r"share: expected a number in \(0, 1\], got 0"):
        hardest(errors, share=0)


def test_temporal_l1_looks_at_valid_pixels_only():
    image, warped = random_image(1, *SHAPE), random_image(2, *SHAPE)
    valid = jnp.asarray(np.random.default_rng(0).uniform(size=(*SHAPE[:-1], 1)) < 0.5, jnp.float32)
    expected = np.where(np.asarray(valid) > 0, np.abs(np.asarray(image) - np.asarray(warped)), 0.0)
    np.testing.assert_allclose(jax.jit(temporal_l1)(image, warped, valid), expected, rtol=1e-6)
    ghost = warped.at[:].set(jnp.where(valid > 0, warped, jnp.inf))  # whatever the history holds in a hole
    gradient = jax.grad(lambda x: jnp.sum(temporal_l1(x, ghost, valid)))(image)
    assert np.isfinite(gradient).all()
    assert (np.asarray(gradient)[np.broadcast_to(np.asarray(valid) == 0, SHAPE)] == 0).all()
    with pytest.raises(ValueError, match="image and warped_previous: expected the same shape"):
        temporal_l1(image, warped[..., :1], valid)


def test_feature_l1_per_level():
    a = [random_image(k, 2, 8 // 2**k, 6 // 2**k, 4 * (k + 1)) for k in range(2)]
    b = [random_image(k + 10, *level.shape) for k, level in enumerate(a)]
    levels = feature_l1(a, b)
    expected = 0.0
    for x, y, level in zip(a, b, levels, strict=True):
        np.testing.assert_allclose(level, np.abs(np.asarray(x) - np.asarray(y)), rtol=1e-6)
        expected += np.abs(np.asarray(x, np.float64) - np.asarray(y, np.float64)).mean()
    assert float(sum_of_means(levels)) == pytest.approx(expected, rel=1e-5)
    assert float(sum_of_means([])) == 0.0
    with pytest.raises(ValueError, match="as many levels on both sides, got 2 and 1"):
        feature_l1(a, b[:1])


@pytest.mark.parametrize("theta", [0.0, 0.3, 1.0])
def test_spatio_temporal_is_equation_54(theta):
    x, y = (np.asarray(random_image(seed, *SHAPE, low=-1.0, high=1.0), np.float64) for seed in (1, 2))
    expected = np.abs(x) + np.abs(y) + theta * (np.abs(x - y) - np.abs(x) - np.abs(y))
    got = spatio_temporal(jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32), theta=theta)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_spatio_temporal_messages():
    image = jnp.zeros((5, 7, 3))
    with pytest.raises(ValueError, match=r"theta: expected a share in \[0, 1\], got 1.5"):
        spatio_temporal(image, image, theta=1.5)
    with pytest.raises(ValueError, match="error and error_previous: expected the same shape"):
        spatio_temporal(image, image[..., :1], theta=0.5)
