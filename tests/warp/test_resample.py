"""Low-resolution samples on the output grid, against sums over samples pixel by pixel."""

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from essjax.warp import gaussian_resample, tent_resample
from tests.helpers import random_image

H, W = 3, 4


@functools.partial(jax.jit, static_argnums=3)
def gaussian(color, jitter, sigma, scale):
    return gaussian_resample(color, color, jitter, sigma, (H * scale, W * scale))


@functools.partial(jax.jit, static_argnums=2)
def tent(color, jitter, scale):
    return tent_resample(color, color, jitter, (H * scale, W * scale))


def nine(row, column):
    return [(v, u) for v in range(row - 1, row + 2) for u in range(column - 1, column + 2)]


@pytest.mark.parametrize("scale", [1, 2, 4])
@settings(max_examples=5)
@given(seed=st.integers(0, 2**16))
def test_gaussian_against_brute_force(scale, seed):
    H, W, sigma = 3, 4, 0.7
    color, jitter = random_image(seed, H, W, 2), random_image(seed, 2, low=-0.5, high=0.5)
    got = gaussian(color, jitter, jnp.float32(sigma), scale)
    j = np.asarray(jitter)
    for y in range(H * scale):
        for x in range(W * scale):
            px, py = (x + 0.5) / scale, (y + 0.5) / scale
            cx, cy = (int(np.clip(np.floor(p - o), 0, n - 1)) for p, o, n in ((px, j[0], W), (py, j[1], H)))
            near = [(v, u) for v in range(cy - 1, cy + 2) for u in range(cx - 1, cx + 2) if 0 <= v < H and 0 <= u < W]
            bordered = [(np.clip(v, 0, H - 1), np.clip(u, 0, W - 1)) for v, u in nine(cy, cx)]
            weights, samples = [], []
            for v, u in near:
                distance = scale * np.hypot(u + 0.5 + j[0] - px, v + 0.5 + j[1] - py)
                weights.append(np.exp(-(distance**2) / (2 * sigma**2)))
                samples.append(np.asarray(color)[v, u])
            mean = np.average(samples, axis=0, weights=weights)
            np.testing.assert_allclose(got.color[y, x], mean, rtol=1e-4)
            np.testing.assert_allclose(got.weight[y, x, 0], max(weights), rtol=1e-4)
            np.testing.assert_allclose(got.low[y, x], np.min(samples, axis=0))
            np.testing.assert_allclose(got.high[y, x], np.max(samples, axis=0))
            average = np.mean([np.asarray(color)[at] for at in bordered], axis=0)
            np.testing.assert_allclose(got.average[y, x], average, rtol=1e-4)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_tent_against_brute_force(scale):
    color, jitter = random_image(scale, H, W, 2), np.array([0.13, -0.42], np.float32)
    got = tent(color, jnp.asarray(jitter), scale)
    hits = 0
    for y in range(H * scale):
        for x in range(W * scale):
            weights, samples, inside = [], [], 0.0
            for v in range(H):
                for u in range(W):
                    dx, dy = (scale * (c + 0.5 + j) - p - 0.5 for c, j, p in ((u, jitter[0], x), (v, jitter[1], y)))
                    weights.append(np.clip(1 - abs(dx), 0, 1) * np.clip(1 - abs(dy), 0, 1))  # eq 40
                    samples.append(np.asarray(color)[v, u])
                    inside = max(inside, float(-0.5 <= dx < 0.5 and -0.5 <= dy < 0.5))
            mean = np.average(samples, axis=0, weights=weights) if np.sum(weights) > 0 else 0.0
            np.testing.assert_allclose(got.color[y, x], mean, rtol=1e-4, atol=1e-6)
            assert float(got.weight[y, x, 0]) == inside
            hits += inside
    assert hits == H * W  # each sample is in one pixel


def test_leading_axes_broadcast():
    color, jitter = random_image(0, H, W, 2), random_image(1, 5, 2, low=-0.5, high=0.5)
    got = gaussian(color, jitter, jnp.float32(0.6), 2)
    assert got.color.shape == (5, 2 * H, 2 * W, 2) and got.weight.shape == (5, 2 * H, 2 * W, 1)
    np.testing.assert_allclose(got.color[3], gaussian(color, jitter[3], jnp.float32(0.6), 2).color, rtol=1e-6)


def test_float32_under_x64():
    color, jitter = np.ones((H, W, 2), np.float32), np.zeros(2, np.float32)
    with jax.enable_x64(True):
        got = gaussian_resample(
            jnp.asarray(color), jnp.asarray(color), jnp.asarray(jitter), jnp.float32(0.6), (2 * H, 2 * W)
        )
        assert {leaf.dtype for leaf in got} == {jnp.dtype("float32")}


@pytest.mark.parametrize("resample", [lambda *a: gaussian_resample(*a[:3], jnp.float32(0.5), a[3]), tent_resample])
def test_errors_name_the_argument(resample):
    image, jitter = jnp.zeros((H, W, 3)), jnp.zeros(2)
    with pytest.raises(ValueError, match=r"bounded: expected \[..., 3, 4, C\], got \(6, 6, 3\)"):
        resample(image, jnp.zeros((6, 6, 3)), jitter, (6, 8))
    with pytest.raises(ValueError, match=r"size: expected .height, width., two whole numbers >= 1, got 2"):
        resample(image, image, jitter, 2)
    with pytest.raises(ValueError, match=r"color: expected \[..., H, W, C\], got \(3, 4\)"):
        resample(image[..., 0], image, jitter, (6, 8))
