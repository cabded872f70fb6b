"""Jitter difference, composition, upsampling and dilation of motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.cameras import pixel_positions
from essjax.warp import (
    backward_warp,
    compose_motion,
    dilate_motion,
    jittered_motion,
    sample,
    splat_motion,
    upsample_motion,
)

H, W = 9, 12
FEW = settings(max_examples=10, deadline=None)
seeds = st.integers(0, 2**31 - 1)
compose = jax.jit(compose_motion)
dilate = jax.jit(dilate_motion, static_argnames="radius")
read = jax.jit(sample, static_argnames="mode")


@functools.partial(jax.jit, static_argnums=1, static_argnames="mode")
def upsample(motion, scale, jitter=None, mode="bilinear"):
    return upsample_motion(
        motion, (round(scale * motion.shape[-3]), round(scale * motion.shape[-2])), jitter=jitter, mode=mode
    )


def affine(positions, a, b):
    """A smooth map of positions, so that bilinear interpolation of its motion is exact."""
    return positions @ a + b


def test_jitter_difference_by_a_world_that_is_a_plane():
    """Frames sample one linear image at pixel + jitter: the lookup reproduces frame t from frame t-1 exactly."""
    jitter, jitter_previous, motion = np.float32([0.3, -0.2]), np.float32([-0.4, 0.1]), np.float32([1.5, -0.75])
    world = lambda p: (2 * p[..., :1] - 5 * p[..., 1:]).astype(np.float32)
    previous = world(np.asarray(pixel_positions(H, W)) + jitter_previous)
    current = world(np.asarray(pixel_positions(H, W)) + jitter + motion)  # what moved here was at + motion
    field = jittered_motion(jnp.broadcast_to(motion, (H, W, 2)), jitter, jitter_previous)
    np.testing.assert_allclose(field[0, 0], [1.5 + 0.7, -0.75 - 0.3], atol=1e-6)
    got = jax.jit(backward_warp)(previous, field)
    np.testing.assert_allclose(got[3:-3, 3:-3], current[3:-3, 3:-3], atol=1e-4)


def test_jitter_broadcasts_over_the_batch():
    field = jittered_motion(jnp.zeros((3, H, W, 2)), jnp.array([[0.1, 0], [0.2, 0], [0.3, 0.5]]), jnp.zeros(2))
    np.testing.assert_allclose(field[:, 4, 4], [[0.1, 0], [0.2, 0], [0.3, 0.5]])


@FEW
@given(seed=seeds)
def test_composition_follows_the_path(seed):
    rng = np.random.default_rng(seed)
    a, b = (np.eye(2) + rng.normal(0, 0.03, (2, 2)) for _ in range(2))
    p, q = rng.normal(0, 0.5, (2, 2))
    grid = np.asarray(pixel_positions(H, W), np.float64)
    first, second = affine(grid, a, p) - grid, affine(grid, b, q) - grid
    total, valid = compose(first.astype(np.float32), second.astype(np.float32))
    expected = affine(affine(grid, a, p), b, q) - grid
    middle = affine(grid, a, p)
    interpolated = np.all((middle >= 0.5) & (middle <= [W - 0.5, H - 0.5]), -1)  # no border repeats there
    np.testing.assert_allclose(np.asarray(total)[interpolated], expected[interpolated], atol=1e-4)
    end = grid + expected
    inside = lambda p: np.all((p >= 0) & (p <= [W, H]), -1)
    np.testing.assert_array_equal(np.asarray(valid)[interpolated, 0], (inside(middle) & inside(end))[interpolated])


def test_composition_with_jitter_moves_the_lookup_only():
    grid = np.asarray(pixel_positions(H, W))
    jitter, jitter_previous = np.float32([0.25, -0.5]), np.float32([-0.25, 0.25])
    first = np.broadcast_to(np.float32([1, 0]), (H, W, 2))
    flow = lambda p: np.stack([0.5 * p[..., 1], 0.25 * p[..., 0]], -1)  # of the world point that is at p in t-1
    second = flow(grid + jitter_previous).astype(np.float32)  # stored at jittered sample positions
    total, _ = compose(first, second, jitter=jitter, jitter_previous=jitter_previous)
    expected = first + flow(grid + jitter + first)
    np.testing.assert_allclose(total[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-5)


def test_composition_carries_validity_along_the_path():
    motion = np.broadcast_to(np.float32([2, 0]), (H, W, 2))
    valid_previous = np.ones((H, W, 1), np.float32)
    valid_previous[4, 7] = 0
    _, valid = compose(motion, motion, valid_previous=valid_previous)
    expected = np.ones((H, W))
    expected[:, W - 4 :] = 0  # two steps of 2 leave the image (pixel centre + 4 > W)
    expected[4, 5] = 0  # read at + (2, 0)
    np.testing.assert_array_equal(valid[..., 0], expected)


def test_composition_needs_both_jitters():
    motion = jnp.zeros((H, W, 2))
    with pytest.raises(ValueError, match="expected both jitter and jitter_previous or neither"):
        compose_motion(motion, motion, jitter=jnp.zeros(2))


@pytest.mark.parametrize("scale", [2, 3, 1.5])
def test_upsampled_motion_is_the_same_world_motion(scale):
    """Motion linear in position, stored at jittered samples; HR pixels see it where they are, in their own pixels."""
    jitter = np.float32([0.4, -0.3])
    world = lambda p: np.stack([0.1 * p[..., 0] - 0.2 * p[..., 1] + 1, 0.3 * p[..., 1] + 0.05 * p[..., 0]], -1)
    low = world(np.asarray(pixel_positions(H, W)) + jitter).astype(np.float32)
    high = upsample(low, scale, jitter=jitter)
    height, width = round(H * scale), round(W * scale)
    ratio = np.float32([width / W, height / H])  # 14 / 9 high, 18 / 12 wide: each axis has its own
    expected = ratio * world(np.asarray(pixel_positions(height, width)) / ratio)
    assert high.shape == (height, width, 2)
    np.testing.assert_allclose(high[4:-4, 4:-4], expected[4:-4, 4:-4], atol=1e-4)


@pytest.mark.parametrize("mode", ["nearest", "bilinear", "bicubic"])
def test_upsampling_equals_sampling_at_the_positions(mode):
    """The separable path against the general one, borders included, one jitter per batch element."""
    motion = np.random.default_rng(0).normal(size=(2, H, W, 2)).astype(np.float32)
    jitter = np.float32([[0.31, -0.2], [-0.47, 0.13]])
    positions = pixel_positions(2 * H, 2 * W) / 2 - jitter[:, None, None]
    expected = 2 * read(motion, positions, mode=mode)
    np.testing.assert_allclose(upsample(motion, 2, jitter=jitter, mode=mode), expected, atol=1e-5)


def test_nearest_upsampling_repeats_motion():
    motion = np.random.default_rng(1).normal(size=(H, W, 2)).astype(np.float32)
    expected = 2 * np.repeat(np.repeat(motion, 2, 0), 2, 1)
    np.testing.assert_allclose(upsample(motion, 2, mode="nearest"), expected)


def brute_dilation(motion, depth, radius):
    result = motion.copy()
    for r in range(H):
        for c in range(W):
            best = (depth[r, c, 0], 0, r, c)  # the centre first, then rows
            for y in range(max(0, r - radius), min(H, r + radius + 1)):
                for x in range(max(0, c - radius), min(W, c + radius + 1)):
                    best = min(best, (depth[y, x, 0], 1, y, x))
            result[r, c] = motion[best[2], best[3]]
    return result


@pytest.mark.parametrize("radius", [0, 1, 2])
@FEW
@given(seed=seeds)
def test_dilation_matches_brute_force_with_ties_and_background(radius, seed):
    rng = np.random.default_rng(seed)
    motion = rng.normal(size=(H, W, 2)).astype(np.float32)
    depth = rng.choice(np.float32([1, 2, 3, np.inf]), (H, W, 1))
    got = dilate(motion, depth, radius=radius)
    np.testing.assert_array_equal(got, brute_dilation(motion, depth, radius))


def test_dilation_keeps_the_batch_apart():
    rng = np.random.default_rng(0)
    motion, depth = rng.normal(size=(2, 3, H, W, 2)), rng.uniform(1, 2, (2, 3, H, W, 1))
    got = dilate(motion, depth)
    np.testing.assert_array_equal(got[1, 2], dilate(motion[1, 2], depth[1, 2]))


def test_dilation_errors():
    with pytest.raises(ValueError, match="radius: expected >= 0 pixels, got -1"):
        dilate_motion(jnp.zeros((H, W, 2)), jnp.ones((H, W, 1)), radius=-1)
    with pytest.raises(ValueError, match=r"depth: expected \[..., 9, 12, 1\], got \(9, 12, 2\)"):
        dilate_motion(jnp.zeros((H, W, 2)), jnp.ones((H, W, 2)))


def test_splatted_motion_fills_cracks_by_the_nearest_surface_and_no_holes():
    """Columns spread to twice their number, which leaves every second one empty; rows from 6 on leave the image."""
    motion, depth = np.zeros((H, W, 2), np.float32), np.full((H, W, 1), np.inf, np.float32)
    motion[..., 0] = np.arange(W)
    motion[6:] = 100.0
    depth[:, :4, 0] = [3.0, 2.0, 3.0, 2.0]
    values = np.broadcast_to(np.arange(W, dtype=np.float32)[:, None], (H, W, 1))
    got, carried, known = (np.asarray(x[..., 0]) for x in jax.jit(splat_motion)(values, depth, motion))
    source = [0, 1, 1, 1, 2, 3, 3, 3, 4, 4, 5, 5]  # 4 and 5 are sky, which fills cracks in itself
    for row in range(7):
        if row < 6:
            np.testing.assert_array_equal(got[row, :9], source[:9])
        np.testing.assert_array_equal(carried[row, 1:8:2], depth[0, source[1:8:2], 0])
        np.testing.assert_array_equal(known[row], np.where(np.arange(W) % 2, 0.5, 1.0 if row < 6 else 0.5))
    np.testing.assert_array_equal(known[7:], 0.0)
    assert np.isinf(carried[2, 8:]).all()
