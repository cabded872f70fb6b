"""The Triton convolution against XLA's, in Triton's interpreter; and when networks use it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import kernels
from essjax.deploy import multiply_adds
from essjax.networks import compute_dtype, extrassnet
from essjax.networks._extrassnet import CONDITIONS
from essjax.networks.blocks import conv
from essjax.networks.precision import LIKED, pad_channels
from tests.triton_on_cpu import is_called, load

NAME = "essjax.networks.convolution_triton"
NONE = np.zeros((1, CONDITIONS), np.float32)


def inputs(channels, outputs, size=(2, 11, 37), seed=0):
    rng = np.random.default_rng(seed)
    x, kernel = rng.normal(size=(*size, channels)), 0.1 * rng.normal(size=(3, 3, channels, outputs))
    return x.astype(np.float16), kernel.astype(np.float16), rng.normal(size=outputs).astype(np.float32)


@pytest.mark.parametrize(("channels", "outputs", "slope"), [(8, 5, 1.0), (16, 16, 0.1), (24, 20, 0.1), (40, 24, 0.0)])
def test_equals_the_ordinary_convolution(monkeypatch, channels, outputs, slope):
    module = load(NAME, monkeypatch)
    arguments = inputs(channels, outputs)
    ours, xla = (f(*(jnp.asarray(a) for a in arguments), slope) for f in (module.convolve, module.reference))
    np.testing.assert_allclose(ours.astype(np.float32), xla.astype(np.float32), rtol=2e-3, atol=5e-3)  # one half ulp


def test_under_vmap(monkeypatch):
    """Over images with one kernel for all, and over kernels and biases."""
    module = load(NAME, monkeypatch)
    x, kernel, bias = inputs(8, 5, (3, 2, 7, 9))
    kernels_, biases = np.stack([kernel, -kernel, 2 * kernel]), np.stack([bias, bias + 1, bias - 1])
    for axes, arguments in (((0, None, None), (x, kernel, bias)), ((None, 0, 0), (x[0], kernels_, biases))):
        ours, xla = (
            jax.vmap(lambda *a, f=f: f(*a, 0.1), axes)(*(jnp.asarray(a) for a in arguments))
            for f in (module.convolve, module.reference)
        )
        assert ours.shape == (3, 2, 7, 9, 5)
        np.testing.assert_allclose(ours.astype(np.float32), xla.astype(np.float32), rtol=2e-3, atol=5e-3)


@pytest.mark.parametrize(
    "options", [{"feature_group_count": 8}, {"use_bias": False}, {"kernel_dilation": 2}, {"padding": "VALID"}]
)
def test_other_convolutions_are_left_to_xla(monkeypatch, options):
    load(NAME, monkeypatch)
    x = jnp.ones((1, 9, 10, 8))

    def uses_it(module):
        def apply(variables, x):
            with compute_dtype("float16"):
                return module.apply(variables, x)

        return is_called(apply, module.init(jax.random.key(0), x), x)

    assert uses_it(conv(8)) and not uses_it(conv(8, **options))


def test_its_derivative_is_the_ordinary_ones(monkeypatch):
    module = load(NAME, monkeypatch)
    arguments = [jnp.asarray(a) for a in inputs(8, 8, (1, 5, 6))]
    ours, xla = (
        jax.grad(lambda *a, f=f: jnp.sum(f(*a, 0.1).astype(jnp.float32) ** 2), argnums=(0, 1, 2))(*arguments)
        for f in (module.convolve, module.reference)
    )
    for a, b in zip(ours, xla, strict=True):
        np.testing.assert_allclose(a.astype(np.float32), b.astype(np.float32), rtol=1e-2, atol=1e-2)


def test_a_network_is_the_same_by_it(monkeypatch):
    """ExtraSSNet in float16: 31 input channels, odd sizes; in float32 the kernel is not used."""
    network, x = extrassnet(width=16), np.random.default_rng(1).normal(size=(1, 13, 18, 31)).astype(np.float32)
    variables = network.init(jax.random.key(0), x, np.zeros((1, 13, 18, 37), np.float32), NONE)
    noise = np.random.default_rng(2)
    variables = jax.tree.map(lambda v: v + 0.05 * noise.standard_normal(v.shape, np.float32), variables)

    def run(dtype):
        def apply(x):
            with compute_dtype(dtype):
                return network.apply(variables, x, NONE, method="render")[0][0]

        return np.asarray(apply(x)), is_called(apply, x)

    with kernels.plain():
        ordinary, called = run("float16")
    assert not called
    load(NAME, monkeypatch)
    ours, called = run("float16")
    assert called and not run("float32")[1]
    np.testing.assert_allclose(ours, ordinary, atol=0.02 * np.abs(ordinary).max())


def test_its_products_are_counted_as_ever(monkeypatch):
    """On a GPU too: neither hidden in the kernel nor with the channels that are padded."""
    network, x = extrassnet(width=16), jax.ShapeDtypeStruct((1, 16, 24, 31), jnp.float32)
    shapes = jnp.zeros(x.shape), jnp.zeros((1, 16, 24, 37)), NONE
    variables = jax.eval_shape(lambda: network.init(jax.random.key(0), *shapes))

    def apply(variables, x):
        with compute_dtype("float16"):
            return network.apply(variables, x, NONE, method="render")[0][0]

    expected = multiply_adds(apply, variables, x)
    monkeypatch.setattr(kernels, "_installed", lambda: True)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert kernels.available() and multiply_adds(apply, variables, x) == expected > 0


def test_only_16_bit_channels_are_padded():
    x = np.ones((1, 2, 3, 5), np.float16)
    padded = pad_channels(jnp.asarray(x))
    assert padded.shape[-1] == LIKED and (padded[..., 5:] == 0).all() and (padded[..., :5] == 1).all()
    assert pad_channels(jnp.ones((1, 2, 3, 5))).shape[-1] == 5 and pad_channels(jnp.ones((1, 2, 3, 16))).shape[-1] == 16
