"""The Triton kernel of the guided warp against the network that XLA runs, in Triton's interpreter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.warp import gbuffer_guided_warp
from tests.triton_on_cpu import is_called, load

H, W = 13, 37


@pytest.fixture(autouse=True)
def interpreter(monkeypatch):
    load("essjax.warp.gbuffer_guided_triton", monkeypatch)


def arrays(leading=(), channels=6, seed=0):
    rng = np.random.default_rng(seed)
    radiance, previous, guide = (
        rng.uniform(0, 1, (*leading, H, W, c)).astype(np.float32) for c in (3, channels, channels)
    )
    return radiance, previous, guide, rng.normal(0, 5, (*leading, H, W, 2)).astype(np.float32)


def both(arguments, **options):
    options = {"sigma_guide": 0.1, **options}
    return [gbuffer_guided_warp(*arguments, implementation=name, **options) for name in ("triton", "network")]


@pytest.mark.parametrize("channels", [6, 7, 1])
def test_equals_the_network(channels):
    """With motion out of the image, to nowhere, and guides that are not finite."""
    radiance, previous, guide, motion = arrays(channels=channels)
    motion[0], motion[1, 3], previous[4, 5], guide[7, 2] = 1e9, -np.inf, np.inf, np.nan
    kernel, network = both((radiance, previous, guide, motion))
    np.testing.assert_allclose(kernel, network, atol=2e-5)


def test_ties_and_motion_by_whole_pixels():
    radiance, previous, guide, motion = arrays(seed=1)
    previous, guide, motion = np.round(2 * previous) / 2, np.round(2 * guide) / 2, np.round(motion)
    kernel, network = both((radiance, previous, guide, motion))
    np.testing.assert_allclose(kernel, network, atol=2e-5)


def test_a_batch_with_arrays_for_all_of_it():
    """Two frames with one guide: the guide is not copied, and every element is as if alone."""
    radiance, previous, _, motion = arrays((2, 1))
    guide = arrays((1,), seed=5)[2]
    kernel, network = both((radiance, previous, guide, motion))
    assert kernel.shape == (2, 1, H, W, 3)
    np.testing.assert_allclose(kernel, network, atol=2e-5)
    batch = arrays((3,), seed=6)
    np.testing.assert_allclose(*both((*batch[:2], batch[2][1], batch[3])), atol=2e-5)
    sigmas = jnp.array([0.1, 0.3])
    mapped = [
        jax.vmap(lambda s, name=name: gbuffer_guided_warp(*arrays(), sigma_distance=s, implementation=name))(sigmas)
        for name in ("triton", "network")
    ]
    np.testing.assert_allclose(*mapped, atol=2e-5)


def test_derivatives_are_the_networks():
    arguments = arrays(seed=2)

    def loss(name):
        return lambda *a: jnp.sum(gbuffer_guided_warp(*a, implementation=name) ** 2)

    gradients = [jax.grad(loss(name), argnums=(0, 1, 2, 3))(*arguments) for name in ("triton", "network")]
    for kernel, network in zip(*gradients, strict=True):
        np.testing.assert_allclose(kernel, network, rtol=1e-3, atol=1e-3)
    tangents = [jax.jvp(loss(name), arguments, arguments)[1] for name in ("triton", "network")]
    np.testing.assert_allclose(*tangents, rtol=1e-4)


def test_second_derivatives_are_the_networks():
    """The kernel is called where derivatives are differentiated, too: it has none of its own."""
    radiance, previous, guide, motion = arrays(seed=5)

    def of_sigma(sigma, implementation):
        warped = gbuffer_guided_warp(
            radiance, previous, guide, motion, sigma_guide=sigma, implementation=implementation
        )
        return jnp.sum(warped**2)

    kernel, network = (jax.grad(jax.grad(of_sigma))(0.3, name) for name in ("triton", "network"))
    assert abs(network) > 1
    np.testing.assert_allclose(kernel, network, rtol=1e-3)


def test_auto_takes_the_kernel():
    arguments = arrays(seed=3)
    automatic = gbuffer_guided_warp(*arguments)
    np.testing.assert_array_equal(automatic, gbuffer_guided_warp(*arguments, implementation="triton"))
    assert is_called(gbuffer_guided_warp, *arguments)
    assert not is_called(lambda *a: gbuffer_guided_warp(*a, implementation="network"), *arguments)
