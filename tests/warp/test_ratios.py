"""Outputs of any size: samples and motion are where they are on both axes, each with its own ratio."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.cameras import pixel_positions
from essjax.warp import (
    backward_warp,
    gaussian_resample,
    half_grid_offset,
    half_size,
    jitter_aligned_upsample,
    nearest_upsample,
    sample,
    sample_zero_upsampled,
    tent_resample,
    to_half_grid,
    upsample_motion,
    zero_upsample,
)
from tests.helpers import random_image

SIZES = [
    ((24, 43), (34, 60)),  # 1366x768 to 1920x1080, a 32nd
    ((17, 30), (25, 45)),  # 959x541 by 1.5
    ((11, 16), (14, 21)),  # by 1.3
    ((9, 12), (29, 31)),  # 3.2 high, 2.6 wide
]
every_size = pytest.mark.parametrize(("low", "size"), SIZES, ids=lambda pair: f"{pair[1]}x{pair[0]}")
JITTERS = np.float32([[0.0, 0.0], [0.37, -0.48], [-0.5, 0.49]])
jau = jax.jit(jitter_aligned_upsample, static_argnames=("size", "mode"))
move = jax.jit(upsample_motion, static_argnames="size")


def ratio(low, size):
    return np.float32([size[1] / low[1], size[0] / low[0]])


@every_size
def test_a_ramp_comes_back_where_it_is(low, size):
    """Sampled at pixel centres + jitter, linear in position: exact between samples, per axis, for every jitter."""
    world = lambda p: (p @ np.float32([[1.0, 0.2], [-3.0, 0.5]])).astype(np.float32)
    seen = np.stack([world(np.asarray(pixel_positions(*low)) + jitter) for jitter in JITTERS])
    expected = world(np.asarray(pixel_positions(*size)) / ratio(low, size))
    inside = np.s_[:, 6:-6, 6:-6]
    np.testing.assert_allclose(
        jau(seen, size, JITTERS)[inside], np.broadcast_to(expected, (3, *expected.shape))[inside], atol=2e-4
    )


@every_size
def test_motion_scales_per_axis(low, size):
    """A world that moved by one LR motion, seen at the output's size: the same image, read there, is the image."""
    motion = np.broadcast_to(np.float32([2.0, -1.0]), (*low, 2))
    large = move(motion, size, jitter=JITTERS[1])
    np.testing.assert_allclose(large, np.broadcast_to(ratio(low, size) * [2.0, -1.0], (*size, 2)), rtol=1e-6)
    shift = ratio(low, size) * np.float32([2.0, -1.0])
    picture = lambda p: np.asarray(p @ np.float32([[0.5], [0.25]]))
    before = picture(np.asarray(pixel_positions(*size)) - shift)  # it stood at x + motion
    now = picture(np.asarray(pixel_positions(*size)))
    np.testing.assert_allclose(backward_warp(before, large)[4:-4, 6:-6], now[4:-4, 6:-6], atol=1e-4)


@every_size
def test_every_sample_stands_in_the_pixel_that_it_fell_into(low, size):
    image, jitters = random_image(0, 3, *low, 2, low=1.0), JITTERS + np.float32(0.003)  # on no border of a pixel
    got = np.asarray(jax.jit(zero_upsample, static_argnums=1)(image, size, jitters))
    for k, jitter in enumerate(jitters):
        expected = np.zeros((*size, 2), np.float32)
        place = ((np.asarray(pixel_positions(*low)).astype(np.float64) + jitter) * ratio(low, size)).astype(int)
        expected[np.minimum(place[..., 1], size[0] - 1), np.minimum(place[..., 0], size[1] - 1)] = image[k]
        np.testing.assert_array_equal(got[k], expected)
    weight = jax.jit(tent_resample, static_argnums=3)(image, image, JITTERS, size).weight
    np.testing.assert_array_equal(weight.sum(axis=(1, 2, 3)), low[0] * low[1])  # none is lost on a border either


@every_size
def test_reading_the_zero_upsampled_image_without_making_it(low, size):
    image = random_image(1, 3, *low, 2, low=1.0)
    places = np.random.default_rng(2).uniform(-2, np.float32(size[::-1]) + 2, (3, 9, 20, 2)).astype(np.float32)
    got = jax.jit(lambda i: sample_zero_upsampled(i, places, size, JITTERS))(image)
    expected = jax.jit(lambda i: sample(zero_upsample(i, size, JITTERS), places, outside="zeros"))(image)
    np.testing.assert_allclose(got, expected, atol=1e-5)


@every_size
def test_gaussian_of_the_nine_nearest(low, size):
    sigma, (along_x, along_y) = 0.7, ratio(low, size)
    image = random_image(3, *low, 2)
    got = jax.jit(gaussian_resample, static_argnums=4)(image, image, JITTERS[1], jnp.float32(sigma), size)
    rng, jitter = np.random.default_rng(4), JITTERS[1].astype(np.float64)
    for y, x in zip(rng.integers(0, size[0], 25), rng.integers(0, size[1], 25), strict=True):
        v, u = np.mgrid[: low[0], : low[1]]
        dx, dy = (u + 0.5 + jitter[0]) * along_x - x - 0.5, (v + 0.5 + jitter[1]) * along_y - y - 0.5
        row, column = np.abs(dy[:, 0]).argmin(), np.abs(dx[0]).argmin()
        near = (np.abs(v - row) <= 1) & (np.abs(u - column) <= 1)
        weight = np.where(near, np.exp(-(dx**2 + dy**2) / (2 * sigma**2)), 0.0)
        mean = (np.asarray(image, np.float64) * weight[..., None]).sum((0, 1)) / weight.sum()
        np.testing.assert_allclose(got.color[y, x], mean, rtol=1e-3)
        np.testing.assert_allclose(got.weight[y, x, 0], weight.max(), rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(got.low[y, x], np.asarray(image)[near].min(axis=0))


@every_size
def test_constants_stay(low, size):
    image = jnp.full((*low, 3), 0.3)
    current = jax.jit(gaussian_resample, static_argnums=4)(image, image, JITTERS[1], jnp.float32(0.65), size)
    for each in (
        jau(image, size, JITTERS[1], mode="bicubic"),
        current.color,
        current.low,
        nearest_upsample(image, size),
    ):
        assert each.shape == (*size, 3)
        np.testing.assert_allclose(each, 0.3, rtol=1e-5)


@every_size
def test_the_half_grid_shows_the_nearest_sample(low, size):
    image = random_image(5, 3, *low, 2)
    got = np.asarray(jax.jit(to_half_grid, static_argnums=1)(image, size, JITTERS))
    offset = np.asarray(half_grid_offset(low, size, JITTERS))
    height, width = half_size(size)
    assert got.shape == (3, height, width, 2) and (height, width) == ((size[0] + 1) // 2, (size[1] + 1) // 2)
    for k, jitter in enumerate(JITTERS.astype(np.float64)):
        samples = (
            (np.asarray(pixel_positions(*low)).astype(np.float64) + jitter) * ratio(low, size) / 2
        )  # half-grid pixels
        away = samples[:, :, None, None] - np.asarray(pixel_positions(height, width)).astype(np.float64)
        distance = (away**2).sum(-1).reshape(-1, height, width)
        found = np.abs(image[k].reshape(-1, 1, 1, 2) - got[k]).sum(-1).argmin(axis=0)
        chosen = np.take_along_axis(distance, found[None], axis=0)[0]
        np.testing.assert_allclose(chosen, distance.min(axis=0), atol=1e-3)
        theirs = np.take_along_axis(away.reshape(-1, height, width, 2), found[None, ..., None], axis=0)[0]
        np.testing.assert_allclose(offset[k], theirs, atol=1e-4)


def test_twice_the_size_is_the_half_grid():
    image = random_image(6, 5, 8, 2)
    assert to_half_grid(image, (10, 16), JITTERS[2]) is image
    np.testing.assert_array_equal(
        half_grid_offset((5, 8), (10, 16), JITTERS), np.tile(JITTERS[:, None, None], (5, 8, 1))
    )


def test_nearest_upsampling_ignores_the_jitter():
    image = np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    blocks, odd = (np.asarray(nearest_upsample(image, size))[..., 0] for size in ((4, 6), (3, 5)))
    np.testing.assert_array_equal(blocks, np.repeat(np.repeat(image[..., 0], 2, 0), 2, 1))
    np.testing.assert_array_equal(odd, image[[0, 1, 1]][:, [0, 0, 1, 2, 2], 0])
