"""Zero upsampling, jitter-aligned upsampling, sample distances, blocks to channels."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.cameras import pixel_positions
from essjax.warp import (
    depth_to_space,
    gaussian_resample,
    jitter_aligned_upsample,
    jittered_motion,
    sample,
    sample_zero_upsampled,
    space_to_depth,
    zero_upsample,
)

H, W = 5, 8
LARGE = 2 * H, 2 * W
FEW = settings(max_examples=15, deadline=None)
in_pixel = st.floats(-0.5, 0.49)
fold = jax.jit(space_to_depth, static_argnums=1)
unfold = jax.jit(depth_to_space, static_argnums=1)


def times(scale, image):
    """(height, width) of an output ``scale`` times as large."""
    return scale * np.shape(image)[-3], scale * np.shape(image)[-2]


@functools.partial(jax.jit, static_argnums=1)
def zeros(image, scale, jitter):
    return zero_upsample(image, times(scale, image), jitter)


@functools.partial(jax.jit, static_argnums=1, static_argnames="mode")
def jau(image, scale, jitter, mode="bilinear"):
    return jitter_aligned_upsample(image, times(scale, image), jitter, mode=mode)


def image_of(seed, *leading):
    return np.random.default_rng(seed).uniform(1, 2, (*leading, H, W, 3)).astype(np.float32)


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
@FEW
@given(x=in_pixel, y=in_pixel)
def test_zero_upsampling_puts_each_sample_where_it_fell(scale, x, y):
    image = image_of(0)
    got = zeros(image, scale, np.float32([x, y]))
    expected = np.zeros((H * scale, W * scale, 3), np.float32)
    column, row = (int(np.floor((np.float32(v) + np.float32(0.5)) * scale)) for v in (x, y))
    expected[row::scale, column::scale] = image
    np.testing.assert_array_equal(got, expected)


def test_zero_upsampling_with_a_jitter_per_batch_element():
    image = image_of(1, 2, 2)
    jitter = np.float32([[[-0.4, 0.3], [0.1, 0.1]], [[0.49, -0.5], [-0.1, 0.2]]])
    got = np.asarray(zeros(image, 2, jitter))
    for i in range(2):
        for j in range(2):
            np.testing.assert_array_equal(got[i, j], zeros(image[i, j], 2, jitter[i, j]))
    np.testing.assert_array_equal(got[1, 0, 0::2, 1::2], image[1, 0])  # right column, upper row


def test_zero_jitter_at_even_scale_lands_right_and_below_the_centre():
    got = np.asarray(zeros(image_of(2), 2, jnp.zeros(2)))
    assert (got[1::2, 1::2] > 0).all() and (got[0::2] == 0).all()


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_reading_a_zero_upsampled_image_without_making_it(scale):
    """Positions inside, on pixel centres, half outside and far outside; the gradient to the image too."""
    image, rng = image_of(3, 2), np.random.default_rng(4)
    jitter = np.float32([[-0.4, 0.3], [0.1, -0.2]])
    size = np.float32([W * scale, H * scale])
    positions = rng.uniform(-2.5, size + 2.5, (2, 9, 30, 2)).astype(np.float32)
    positions[:, :3] = np.floor(positions[:, :3]) + 0.5

    def direct(image):
        return sample_zero_upsampled(image, positions, times(scale, image), jitter)

    def through_the_large_image(image):
        return sample(zero_upsample(image, times(scale, image), jitter), positions, outside="zeros")

    weights = rng.normal(size=(2, 9, 30, 3)).astype(np.float32)
    results = []
    for read in (direct, through_the_large_image):
        value, pullback = jax.jit(lambda image, read=read: jax.vjp(read, image))(image)
        results.append((value, pullback(weights)[0]))
    for got, expected in zip(*results, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert 0.05 < np.mean(np.asarray(results[0][0]) != 0) < 1


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@FEW
@given(x=in_pixel, y=in_pixel)
def test_jau_shows_a_ramp_where_it_is_whatever_the_jitter(mode, x, y):
    """A linear world sampled at pixel centres + jitter comes back at the unjittered HR centres."""
    jitter = np.float32([x, y])
    world = lambda p: p @ np.float32([[1.0], [-3.0]])
    low = world(np.asarray(pixel_positions(H + 4, W + 4)) + jitter)
    high = jau(low, 2, jitter, mode=mode)
    expected = world(np.asarray(pixel_positions(2 * H + 8, 2 * W + 8)) / 2)
    np.testing.assert_allclose(high[6:-6, 6:-6], expected[6:-6, 6:-6], atol=1e-4)


def test_jau_of_a_sample_on_an_hr_centre_is_that_sample():
    image = image_of(3)
    jitter = np.float32([0.25, -0.25])  # the centre of the right upper HR pixel
    np.testing.assert_allclose(jau(image, 2, jitter)[0::2, 1::2], image, atol=1e-6)


def test_jau_keeps_constants_and_type():
    image = jnp.full((H, W, 1), 0.3, jnp.bfloat16)
    high = jau(image, 4, jnp.array([0.2, 0.4]), mode="bicubic-0.75")
    assert high.dtype == jnp.bfloat16 and high.shape == (4 * H, 4 * W, 1)
    np.testing.assert_array_equal(high, jnp.full(high.shape, 0.3, jnp.bfloat16))


def test_space_to_depth_channel_order_by_hand():
    x = np.arange(2 * 4 * 2).reshape(2, 4, 2)  # values: 8 y + 2 x + c
    got = np.asarray(space_to_depth(x, 2))
    assert got.shape == (1, 2, 8)
    assert got[0, 1].tolist() == [4, 5, 6, 7, 12, 13, 14, 15]  # (dy, dx, c)


@pytest.mark.parametrize("block", [1, 2, 3])
@pytest.mark.parametrize("leading", [(), (2,), (3, 2)])
def test_space_to_depth_and_back(block, leading):
    x = np.random.default_rng(block).normal(size=(*leading, 2 * block, 5 * block, 3)).astype(np.float32)
    folded = fold(x, block)
    assert folded.shape == (*leading, 2, 5, 3 * block**2)
    np.testing.assert_array_equal(unfold(folded, block), x)
    np.testing.assert_array_equal(fold(unfold(folded, block), block), folded)


def test_gradients_are_finite_and_complete():
    loss = lambda i, j: jnp.sum(jitter_aligned_upsample(i, times(2, i), j, mode="bicubic"))
    to_image, to_jitter = jax.jit(jax.grad(loss, (0, 1)))(image_of(4), jnp.zeros(2))
    assert np.isfinite(to_image).all() and np.isfinite(to_jitter).all()
    assert float(to_image.sum()) == pytest.approx(4 * H * W * 3, rel=1e-5)


def test_nearest_keeps_integers_and_interpolated_integers_are_float32():
    """16777217 = 2^24 + 1 is the first integer that float32 lacks."""
    ids = np.full((H, W, 1), 2**24 + 1, np.int32)
    got = jitter_aligned_upsample(ids, times(2, ids), (0.1, -0.2), mode="nearest")
    assert got.dtype == jnp.int32 and (np.asarray(got) == 2**24 + 1).all()
    mixed = jitter_aligned_upsample(np.arange(W, dtype=np.uint8)[None, :, None].repeat(H, 0), LARGE, (0.0, 0.0))
    assert mixed.dtype == jnp.float32
    np.testing.assert_allclose(mixed[0, 1:5, 0], [0.25, 0.75, 1.25, 1.75])


TAKE_JITTER = {
    "zero_upsample": lambda jitter: zero_upsample(image_of(0), LARGE, jitter),
    "sample_zero_upsampled": lambda jitter: sample_zero_upsampled(image_of(0), jnp.ones((2, 2, 2)), LARGE, jitter),
    "jitter_aligned_upsample": lambda jitter: jitter_aligned_upsample(image_of(0), LARGE, jitter),
    "gaussian_resample": lambda jitter: (
        gaussian_resample(image_of(0), image_of(0), jitter, jnp.float32(0.5), LARGE).color
    ),
    "jittered_motion": lambda jitter: jittered_motion(jnp.zeros((H, W, 2)), jitter, jitter),
}


@pytest.mark.parametrize("name", TAKE_JITTER)
def test_jitter_is_two_numbers_in_any_container(name):
    function = TAKE_JITTER[name]
    np.testing.assert_array_equal(jax.jit(function)((0.1, -0.2)), jax.jit(function)(jnp.array([0.1, -0.2])))
    jax.eval_shape(lambda: function((0.1, -0.2)))  # also where they are numbers of Python
    for length in (1, 3):
        with pytest.raises(ValueError, match=rf"jitter: expected \[..., 2\] .x, y. in LR pixels, got \({length},\)"):
            function(jnp.zeros(length))


def test_errors_name_the_argument():
    image = image_of(0)
    with pytest.raises(ValueError, match="space_to_depth: expected height and width to be multiples of 2, got 5x8"):
        space_to_depth(image, 2)
    with pytest.raises(ValueError, match="depth_to_space: expected a multiple of 4 channels, got 3"):
        depth_to_space(image, 2)
    with pytest.raises(ValueError, match="size: expected at least the image's 8x5, got 8x4"):
        zero_upsample(image, (4, 8), jnp.zeros(2))
    with pytest.raises(ValueError, match=r"size: expected .height, width., two whole numbers >= 1, got .0, 8."):
        jitter_aligned_upsample(image, (0, 8), jnp.zeros(2))
    with pytest.raises(ValueError, match="mode: expected one of nearest"):
        jitter_aligned_upsample(image, LARGE, jnp.zeros(2), mode="lanczos")
