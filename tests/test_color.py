"""Colour transforms: hand-computed numbers, round trips, finite gradients."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from essjax import color
from tests.helpers import random_image

PAIRS = {
    "log1p": (color.log1p, color.expm1, 50.0),
    "reinhard": (color.reinhard, color.reinhard_inverse, 50.0),
    "srgb": (color.srgb_encode, color.srgb_decode, 1.0),
    "display": (color.display, color.display_inverse, 20.0),
    "ycocg": (color.rgb_to_ycocg, color.ycocg_to_rgb, 50.0),
}


@pytest.mark.parametrize("name", PAIRS)
@given(seed=st.integers(0, 2**16))
def test_round_trip(name, seed):
    encode, decode, high = PAIRS[name]
    image = random_image(seed, 5, 7, 3, high=high)
    np.testing.assert_allclose(decode(encode(image)), image, rtol=2e-4, atol=1e-5)


@given(seed=st.integers(0, 2**16))
def test_modulation_round_trip(seed):
    image, base = random_image(seed, 5, 7, 3), random_image(seed + 1, 5, 7, 3, high=1.0)
    albedo = color.demodulation_albedo(base, jnp.zeros((5, 7, 1), bool))
    np.testing.assert_allclose(color.modulate(color.demodulate(image, albedo), albedo), image, rtol=1e-5)


def test_demodulation_albedo_by_hand():
    base = jnp.array([[[0.5, 0.0, 0.2]], [[0.5, 0.0, 0.2]], [[0.5, 0.0, 0.0]]])
    sky = jnp.array([[[False]], [[False]], [[True]]])
    metallic = jnp.array([[[0.0]], [[1.0]], [[0.0]]])
    albedo = color.demodulation_albedo(base, sky, metallic)  # specular 0.5: + 0.04 where not metallic
    np.testing.assert_allclose(albedo[0, 0], [0.54, 0.04, 0.24], rtol=1e-6)
    np.testing.assert_allclose(albedo[1, 0], [0.5, color.ALBEDO_FLOOR, 0.2], rtol=1e-6)
    np.testing.assert_array_equal(albedo[2, 0], 1.0)
    shiny = color.demodulation_albedo(base, sky, metallic, jnp.ones((3, 1, 1)))  # + 0.08
    np.testing.assert_allclose(shiny[0, 0], [0.58, 0.08, 0.28], rtol=1e-6)


def test_display_of_log1p_leads_back_from_below_zero():
    encoded = jnp.array([-0.2, 0.0, 1e-4, 0.3, 2.0])
    shown = jax.jit(color.display_of_log1p)(encoded)
    np.testing.assert_allclose(shown[1:], color.display(jnp.expm1(encoded[1:])), rtol=1e-6)
    slopes = jax.vmap(jax.grad(color.display_of_log1p))(encoded)
    np.testing.assert_allclose(slopes[jnp.array([0, 2])], 12.92, rtol=1e-2)
    assert np.all(np.asarray(slopes) > 0)


def test_display_by_hand():
    # reinhard(1) = 0.5; the sRGB curve: 1.055 * 0.5 ** (1 / 2.4) - 0.055. reinhard(0.001) is on the linear part.
    np.testing.assert_allclose(color.display(jnp.array(1.0)), 0.7353570, rtol=1e-5)
    np.testing.assert_allclose(color.display(jnp.array(0.001)), 12.92 * 0.001 / 1.001, rtol=1e-5)
    np.testing.assert_allclose(color.srgb_decode(jnp.array(0.5)), 0.2140411, rtol=1e-5)
    assert float(color.display(jnp.array(-3.0))) == 0.0


def test_srgb_matches_skimage():
    skimage = pytest.importorskip("skimage.color")
    encoded = np.random.default_rng(3).uniform(0, 1, (4, 5, 3))
    xyz_based = skimage.rgb2xyz(encoded)  # linearises sRGB, then a matrix whose second row is luminance
    np.testing.assert_allclose(
        color.luminance(color.srgb_decode(jnp.asarray(encoded)))[..., 0], xyz_based[..., 1], atol=1e-4
    )


def test_ycocg_and_luminance_by_hand():
    pixel = jnp.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(color.rgb_to_ycocg(pixel), [2.25, -1.5, -0.25])
    np.testing.assert_allclose(color.luminance(pixel), [0.2126 + 2 * 0.7152 + 4 * 0.0722], rtol=1e-6)


def test_negative_input_counts_as_zero():
    for transform in (color.log1p, color.expm1, color.reinhard, color.reinhard_inverse, color.display_inverse):
        assert float(transform(jnp.array(-0.5))) == 0.0


def test_reinhard_inverse_stays_finite():
    assert np.isfinite(color.reinhard_inverse(jnp.array([1.0, 5.0]))).all()


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_inverses_stay_finite_in_sixteen_bits(dtype):
    """0.9999 is 1 in both types."""
    for inverse in (color.reinhard_inverse, color.display_inverse):
        result = inverse(jnp.array([1.0, 5.0], dtype))
        assert result.dtype == dtype
        np.testing.assert_allclose(result.astype(jnp.float32), 9999, rtol=1e-2)


def test_luminance_is_not_rounded_by_accelerators():
    assert "precision=(Precision.HIGHEST" in str(jax.make_jaxpr(color.luminance)(jnp.ones((2, 3)))).replace("\n", " ")


@pytest.mark.parametrize(
    "transform", [color.display, color.log1p, color.srgb_encode, color.srgb_decode, color.reinhard]
)
@pytest.mark.parametrize("value", [0.0, 0.0031308, 0.04045, 1.0])
def test_gradients_are_finite(transform, value):
    assert np.isfinite(jax.grad(transform)(value))


def test_the_gradient_of_log1p_needs_only_its_output():
    """1 / (1 + x) by hand, 0 where nothing was seen; what is kept for it is the output, which others keep as well."""
    radiance = jnp.array([[-0.5, 0.0, 1e-7, 0.25, 3.0, 65504.0]])
    encoded, backward = jax.vjp(color.log1p, radiance)
    np.testing.assert_allclose(backward(jnp.full((1, 6), 2.0))[0], [[0, 0, 2, 1.6, 0.5, 2 / 65505]], rtol=1e-5)
    np.testing.assert_array_equal(jax.tree.leaves(backward), [encoded])
    curvature = jax.grad(lambda x: jax.grad(color.log1p)(x))(3.0)
    np.testing.assert_allclose(curvature, -1 / 16, rtol=1e-5)


def test_the_gradient_of_log1p_of_reinhard_needs_only_its_output():
    """1 / (1 - e) by hand, 0 where clamped."""
    encoded = jnp.array([-0.5, 0.0, 0.2, 0.75, 0.99, 1.0, 2.0])
    result, backward = jax.vjp(color.log1p_of_reinhard, encoded)
    np.testing.assert_allclose(result[2:5], np.log1p(np.array([0.25, 3.0, 99.0])), rtol=1e-5)
    np.testing.assert_allclose(backward(jnp.full(7, 2.0))[0], [0, 0, 2.5, 8, 200, 0, 0], rtol=1e-4)
    np.testing.assert_array_equal(jax.tree.leaves(backward), [result])


def test_strict_numerics(strict_numerics):
    image = random_image(0, 2, 3, 3)
    for encode, decode, _ in PAIRS.values():
        assert decode(encode(image)).dtype == jnp.float32
    assert color.display(image).dtype == color.luminance(image).dtype == jnp.float32


def test_sum_channels_by_hand():
    image = np.array([[[1.0, 2.0, 4.0], [-1.0, 0.5, 0.25]]], np.float32)
    np.testing.assert_array_equal(color.sum_channels(image), [[[7.0], [-0.25]]])
    np.testing.assert_array_equal(color.sum_channels(image[..., :1]), image[..., :1])
