import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from essjax.metrics import MAX_PSNR, psnr, ssim, ssim_map
from tests.helpers import random_image

SEEDS = st.integers(0, 10_000)
SHAPE = (2, 17, 23, 3)


def pair(seed):
    """A smooth random image in [0, 1] and a noisy copy, so that SSIM is neither 0 nor 1."""
    target = np.asarray(random_image(seed, *SHAPE, high=1.0))
    target = 0.25 * (target + np.roll(target, 1, -2) + np.roll(target, 1, -3) + np.roll(target, (1, 1), (-3, -2)))
    noise = np.random.default_rng(seed + 1).normal(0, 0.08, SHAPE)
    return jnp.asarray(np.clip(target + noise, 0, 1), jnp.float32), jnp.asarray(target)


@given(seed=SEEDS)
def test_psnr_matches_skimage(seed):
    a, b = pair(seed)
    expected = [peak_signal_noise_ratio(np.asarray(b[k]), np.asarray(a[k]), data_range=1) for k in range(2)]
    np.testing.assert_allclose(jax.jit(psnr)(a, b), expected, rtol=1e-5)


@given(seed=SEEDS)
def test_masked_psnr_matches_numpy(seed):
    a, b = pair(seed)
    mask = np.random.default_rng(seed).uniform(size=(*SHAPE[:-1], 1)) < 0.3
    squared = (np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2
    expected = [-10 * np.log10(squared[k][mask[k, ..., 0]].mean()) for k in range(2)]
    np.testing.assert_allclose(psnr(a, b, mask=jnp.asarray(mask, jnp.float32)), expected, rtol=1e-5)


def test_psnr_by_hand_and_at_its_ends():
    target = jnp.full((4, 5, 3), 0.5)
    assert float(psnr(target + 0.1, target)) == pytest.approx(20.0, abs=1e-4)  # 0.1^2 = 1e-2
    assert float(psnr(target, target)) == MAX_PSNR
    assert np.isnan(psnr(target, target, mask=jnp.zeros((4, 5, 1))))


@given(seed=SEEDS)
def test_ssim_matches_skimage(seed):
    a, b = pair(seed)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
    expected = [structural_similarity(np.asarray(a[k]), np.asarray(b[k]), channel_axis=-1, **options) for k in range(2)]
    np.testing.assert_allclose(jax.jit(ssim)(a, b), expected, atol=2e-5)
    dlctus = structural_similarity(np.asarray(a[0]), np.asarray(b[0]), channel_axis=-1, K2=0.02, **options)
    assert float(ssim(a, b, c2=0.02**2)[0]) == pytest.approx(dlctus, abs=2e-5)


def test_ssim_mask_counts_window_centres():
    a, b = pair(3)
    values = np.asarray(ssim_map(a, b))
    assert values.shape == (2, 7, 13, 3)
    mask = np.zeros((*SHAPE[:-1], 1), np.float32)
    mask[:, 6, 9] = 1.0  # the pixel whose window starts at row 1, column 4
    mask[:, 0, 0] = 1.0  # too close to the border: has no window
    np.testing.assert_allclose(ssim(a, b, mask=jnp.asarray(mask)), values[:, 1, 4].mean(-1), rtol=1e-5)
    assert float(ssim(b, b)[0]) == pytest.approx(1.0, abs=1e-6)
    assert np.isnan(ssim(a, b, mask=jnp.zeros_like(mask))).all()


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_sixteen_bit_images_score_as_the_same_numbers_in_float32(dtype):
    short = [image.astype(dtype) for image in pair(1)]
    wide = [image.astype(jnp.float32) for image in short]
    for metric in (psnr, ssim):
        assert metric(*short).dtype == jnp.float32
        np.testing.assert_allclose(metric(*short), metric(*wide), rtol=1e-6)
    assert float(psnr(short[0], short[0])[0]) == MAX_PSNR


def test_a_mask_of_many_pixels_does_not_overflow_in_float16():
    """Half the range off on 260 x 260 > 65504 pixels: -10 log10(0.25)."""
    image, mask = jnp.full((260, 260, 1), 0.5, jnp.float16), jnp.ones((260, 260, 1), jnp.float16)
    assert float(psnr(image, 0 * image, mask=mask)) == pytest.approx(6.0206, abs=1e-4)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_integers_are_refused(metric):
    image = np.zeros((20, 18, 3), np.uint8)
    message = r"prediction: expected floating-point values, got uint8. Divide by the largest integer \(255\) first"
    with pytest.raises(ValueError, match=message):
        metric(image, image)
    with pytest.raises(ValueError, match="target: expected floating-point values, got int32"):
        metric(jnp.zeros((20, 18, 3)), jnp.zeros((20, 18, 3), jnp.int32))


def test_messages():
    image = jnp.zeros((20, 8, 3))
    with pytest.raises(ValueError, match="expected the same shape"):
        psnr(image, image[..., :1])
    with pytest.raises(ValueError, match="odd window no larger than the image, got window 11 for 8x20 pixels"):
        ssim(image, image)
