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


def test_nearest_splat_errors():
    with pytest.raises(ValueError, match=r"depth: expected \[..., 8, 11, 1\], got \(7, 11, 1\)"):
        splat_nearest(jnp.zeros((H, W, 2)), jnp.zeros((H - 1, W, 1)), jnp.zeros((H, W, 2)))
