"""Forward warps: the adjoint of gathering, and nearest depth wins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.warp import backward_warp, splat, splat_nearest

H, W = 8, 11
FEW = settings(max_examples=12, deadline=None)
seeds = st.integers(0, 2**31 - 1)
gather = jax.jit(lambda image, motion: backward_warp(image, motion, outside="zeros"))
scatter = jax.jit(splat)
nearest = jax.jit(splat_nearest)


@FEW
@given(seed=seeds, size=st.floats(0, 8))
def test_splat_is_the_transpose_of_gather(seed, size):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, H, W, 3)).astype(np.float32)
    motion = rng.normal(0, size, (H, W, 2)).astype(np.float32)
    left, right = np.vdot(gather(a, motion), b), np.vdot(a, scatter(b, motion))
    assert left == pytest.approx(right, rel=1e-4, abs=1e-3)


def test_splat_by_hand():
    image = np.zeros((H, W, 1), np.float32)
    image[3, 2] = 8.0
    motion = np.full((H, W, 2), (2.25, -1.5), np.float32)  # to column 4.25, rows 1.5: a quarter right, half up
    got = np.asarray(scatter(image, motion))[..., 0]
    expected = np.zeros((H, W))
    expected[1:3, 4:6] = [[3, 1], [3, 1]]
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_splat_loses_what_leaves_the_image_and_adds_what_meets():
    image = np.ones((H, W, 2), np.float32)
    assert (np.asarray(scatter(image, np.full((H, W, 2), 1e9, np.float32))) == 0).all()
    to_one = np.stack(np.meshgrid(4 - np.arange(W), 6 - np.arange(H)), -1).astype(np.float32)
    got = np.asarray(scatter(image, to_one))
    assert got[6, 4].tolist() == [H * W, H * W] and got.sum() == 2 * H * W


def test_splat_keeps_the_batch_apart():
    rng = np.random.default_rng(0)
    image, motion = (
        rng.normal(size=(2, 3, H, W, 1)).astype(np.float32),
        rng.normal(size=(3, H, W, 2)).astype(np.float32),
    )
    np.testing.assert_allclose(scatter(image, motion)[1, 2], scatter(image[1, 2], motion[2]), atol=1e-6)


def test_splat_gradients_are_finite_and_those_of_a_gather():
    rng = np.random.default_rng(1)
    image, weight = rng.normal(size=(2, H, W, 1)).astype(np.float32)
    motion = rng.normal(size=(H, W, 2)).astype(np.float32)
    to_image, to_motion = jax.jit(jax.grad(lambda i, m: jnp.sum(splat(i, m) * weight), (0, 1)))(image, motion)
    np.testing.assert_allclose(to_image, gather(weight, motion), atol=1e-5)
    assert np.isfinite(to_motion).all()


def brute_nearest(image, depth, motion):
    result, best = np.zeros_like(image), {}
    for r in range(H):
        for c in range(W):
            x, y = np.float32(c + 0.5) + motion[r, c, 0], np.float32(r + 0.5) + motion[r, c, 1]
            if 0 <= x < W and 0 <= y < H:
                key, cell = (depth[r, c, 0], r, c), (int(y), int(x))
                if cell not in best or key < best[cell]:
                    best[cell], result[cell] = key, image[r, c]
    covered = np.zeros((H, W, 1))
    for cell in best:
        covered[cell] = 1
    return result, covered


@FEW
@given(seed=seeds, size=st.floats(0, 5))
def test_nearest_depth_wins_against_brute_force(seed, size):
    rng = np.random.default_rng(seed)
    image = rng.normal(size=(H, W, 2)).astype(np.float32)
    depth = rng.choice(np.float32([1, 2, np.inf]), (H, W, 1))
    motion = rng.normal(0, size, (H, W, 2)).astype(np.float32)
    expected, expected_mask = brute_nearest(image, depth, motion)
    got, mask = nearest(image, depth, motion)
    np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(mask, expected_mask)


def test_a_motion_that_is_nan_loses_its_pixel_only():
    image = np.ones((2, H, W, 1), np.float32)
    motion = np.zeros((2, H, W, 2), np.float32)
    motion[1, 3, 4, 0] = np.nan
    expected = image.copy()
    expected[1, 3, 4] = 0
    np.testing.assert_array_equal(scatter(image, motion), expected)
    np.testing.assert_array_equal(nearest(image, image, motion)[1], expected)
    to_image, to_motion = jax.grad(lambda i, m: jnp.sum(splat(i, m) ** 2), (0, 1))(image, motion)
    assert np.isfinite(to_image).all() and np.isfinite(to_motion).all()


def test_a_depth_that_is_nan_loses_its_pixel_only():
    """Two valid pixels and one without a depth land on column 1: the nearer valid one is seen."""
    image = np.float32([[[5.0], [6.0], [7.0]]])
    depth = np.float32([[[3.0], [np.nan], [2.0]]])
    motion = np.float32([[[1, 0], [0, 0], [-1, 0]]])
    got, covered = nearest(image, depth, motion)
    np.testing.assert_array_equal(got[0, :, 0], [0, 7, 0])
    np.testing.assert_array_equal(covered[0, :, 0], [0, 1, 0])


def test_splat_of_integers_is_float32():
    got = splat(np.full((H, W, 1), 2, np.int32), np.full((H, W, 2), 0.25, np.float32))
    assert got.dtype == jnp.float32 and float(got[0, 0, 0]) == 2 * 0.75**2


@pytest.mark.parametrize(("leading", "channels"), [((0,), 3), ((2, 0), 3), ((), 0)])
def test_nothing_splats_and_warps_to_nothing(leading, channels):
    image, motion = jnp.zeros((*leading, H, W, channels)), jnp.zeros((H, W, 2))
    for result in (splat(image, motion), backward_warp(image, motion), backward_warp(image, motion, mode="bicubic")):
        assert result.shape == image.shape and result.dtype == jnp.float32
    whole = image.astype(jnp.int32)
    assert backward_warp(whole, motion).dtype == splat(whole, motion).dtype == jnp.float32
    assert backward_warp(whole, motion, mode="nearest").dtype == jnp.int32


def test_float64_motion():
    image, motion = np.ones((H, W, 1), np.float32), np.full((H, W, 2), 0.25)
    expected = splat(image, motion.astype(np.float32))
    with jax.enable_x64(True):
        assert jnp.asarray(motion).dtype == jnp.float64
        np.testing.assert_array_equal(splat(image, jnp.asarray(motion)), expected)
        assert splat_nearest(image, image, jnp.asarray(motion))[0].dtype == jnp.float32


def test_nearest_splat_errors():
    with pytest.raises(ValueError, match=r"depth: expected \[..., 8, 11, 1\], got \(7, 11, 1\)"):
        splat_nearest(jnp.zeros((H, W, 2)), jnp.zeros((H - 1, W, 1)), jnp.zeros((H, W, 2)))
