"""The Triton kernel of bicubic reads against XLA's program, in Triton's interpreter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import kernels
from essjax.warp import sample
from tests.triton_on_cpu import is_called, load


def inputs(image=(9, 14, 3), positions=(7, 11), seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-6, 20, (*positions, 2)).astype(np.float32)
    return rng.normal(size=image).astype(np.float32), places


def both(monkeypatch, function, *arguments):
    """Of a function, what it returns without and with the kernel."""
    with kernels.plain():
        ordinary = np.asarray(function(*arguments))
    with monkeypatch.context() as patch:
        load("essjax.warp.sampling_triton", patch)
        assert is_called(function, *arguments)
        return ordinary, np.asarray(function(*arguments))


@pytest.mark.parametrize("mode", ["bicubic", "bicubic-0.75"])
@pytest.mark.parametrize("outside", ["border", "zeros"])
def test_equals_the_taps(monkeypatch, mode, outside):
    image, positions = inputs()
    positions[0, 0], positions[0, 1], positions[0, 2] = (1e9, -1e9), (0.5, 0.5), (14.0, 9.0)
    taps, kernel = both(monkeypatch, lambda i, p: sample(i, p, mode=mode, outside=outside), image, positions)
    np.testing.assert_allclose(kernel, taps, atol=2e-6)


@pytest.mark.parametrize(
    ("image", "positions"), [((2, 9, 14, 1), (2, 5, 6)), ((9, 14, 5), (3, 5, 6)), ((1, 9, 14, 3), (2, 3, 5, 6))]
)
def test_batches(monkeypatch, image, positions):
    taps, kernel = both(monkeypatch, lambda i, p: sample(i, p, mode="bicubic"), *inputs(image, positions))
    assert kernel.shape == (*positions, image[-1])
    np.testing.assert_allclose(kernel, taps, atol=2e-6)


def test_under_vmap(monkeypatch):
    """Both mapped, only the image, and a map in a map."""
    image, positions = inputs((4, 9, 14, 3), (4, 5, 6))
    read = lambda i, p: sample(i, p, mode="bicubic")
    for function, arguments in (
        (jax.vmap(read), (image, positions)),
        (jax.vmap(read, (0, None)), (image, positions[0])),
        (jax.vmap(jax.vmap(read), (None, 0)), (image, np.stack([positions, positions + 1]))),
    ):
        taps, kernel = both(monkeypatch, function, *arguments)
        np.testing.assert_allclose(kernel, taps, atol=2e-6)


def test_gradients_are_those_of_the_taps(monkeypatch):
    image, positions = inputs()
    gradient = lambda i, p: jnp.concatenate(
        [g.ravel() for g in jax.grad(lambda i, p: jnp.sum(sample(i, p, mode="bicubic") ** 2), (0, 1))(i, p)]
    )
    taps, kernel = both(monkeypatch, gradient, image, positions)
    np.testing.assert_allclose(kernel, taps, rtol=1e-4, atol=1e-4)


def test_half_precision(monkeypatch):
    image, positions = inputs()
    read = lambda i, p: sample(i, p, mode="bicubic").astype(jnp.float32)
    taps, kernel = both(monkeypatch, read, jnp.asarray(image, jnp.float16), positions)
    np.testing.assert_allclose(kernel, taps, atol=4e-3)


def test_a_batch_of_one_is_shared():
    seen = []

    @kernels.over_batches
    def function(a, b):
        seen.append((a.shape, b.shape))
        return [jnp.broadcast_to(a + b, (max(len(a), len(b)), 2))]

    one, several = jnp.ones((1, 2)), jnp.arange(6.0).reshape(3, 1, 2)
    result = jax.vmap(function, (None, 0))(one, several)[0]
    assert seen[-1] == ((1, 2), (3, 2))
    np.testing.assert_array_equal(result, several + 1)
    assert jax.vmap(function, (None, 0))(jnp.ones((4, 2)), several)[0].shape == (3, 4, 2)
    assert seen[-1] == ((12, 2), (12, 2))


@pytest.mark.parametrize("outside", ["border", "zeros"])
def test_positions_that_are_not_numbers(monkeypatch, outside):
    """Read what is no number, as XLA's program does: bad motion must show on every backend."""
    image, positions = inputs()
    positions[2, 3], positions[4, 5, 1], positions[1, 1] = np.nan, np.nan, np.inf
    taps, kernel = both(monkeypatch, lambda *arrays: sample(*arrays, mode="bicubic", outside=outside), image, positions)
    assert np.isnan(taps).any(axis=-1).sum() == 2
    np.testing.assert_allclose(kernel, taps, atol=1e-5)
