import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.networks import compute_dtype, extranet, fasset
from essjax.networks._extranet import input_shapes
from essjax.networks._fasset import LOCAL, PAST
from essjax.networks.blocks import conv


def _random(shapes, seed=0):
    keys = jax.random.split(jax.random.key(seed), len(shapes))
    return [jax.random.normal(key, shape.shape) for key, shape in zip(keys, shapes, strict=True)]


def test_products_are_rounded_and_nothing_else():
    """The bias is large and halfway between two numbers of bfloat16: rounding it or the sum misses by about 0.25."""
    layer = conv(3)
    x = jax.random.normal(jax.random.key(0), (1, 5, 7, 2))
    variables = layer.init(jax.random.key(1), x)
    variables["params"]["bias"] = jnp.array([100.25, 70.25, 90.25])

    def apply(x):
        with compute_dtype("bfloat16"):
            return layer.apply(variables, x)

    kernel = variables["params"]["kernel"].astype(jnp.bfloat16)
    product = jax.lax.conv_general_dilated(
        x.astype(jnp.bfloat16), kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    expected = product.astype(jnp.float32) + variables["params"]["bias"]
    found = jax.jit(apply)(x)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.03)  # products of about 3 may or may not be rounded
    for wrong in (product + variables["params"]["bias"].astype(jnp.bfloat16), expected.astype(jnp.bfloat16)):
        assert float(jnp.abs(wrong.astype(jnp.float32) - expected).max()) > 0.1  # what this test would see
    assert float(jnp.abs(found - layer.apply(variables, x)).max()) > 1e-3  # it did something


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_a_network_stays_close_to_float32(dtype):
    network, inputs = extranet(), _random(input_shapes(1, height=16, width=24))
    variables = network.init(jax.random.key(2), *inputs)
    noise = np.random.default_rng(0)  # the head starts at zero
    variables = jax.tree.map(lambda leaf: leaf + 0.02 * noise.standard_normal(leaf.shape), variables)

    def apply(variables, *inputs):
        with compute_dtype(dtype):
            return network.apply(variables, *inputs)[0]

    exact = jax.jit(lambda v, *i: network.apply(v, *i)[0])(variables, *inputs)
    rounded = jax.jit(apply)(variables, *inputs)
    assert rounded.dtype == jnp.float32
    scale = float(jnp.std(exact - inputs[0][..., :3]))
    error = float(jnp.sqrt(jnp.mean((rounded - exact) ** 2)))
    assert 0 < error < 0.1 * scale


def test_pixelwise_layers_follow():
    network = fasset(width=8, hidden=8)
    shapes = [*((1, 8, 12, n) for n in (3, 1, 7, PAST, 8)), (1, 12, 18, LOCAL), (1, 2)]
    inputs = _random([jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes])
    variables = network.init(jax.random.key(3), *inputs)

    def products(dtype):
        def apply(*inputs):
            with compute_dtype(dtype):
                return network.apply(variables, *inputs, method="render")[0][0]

        text = str(jax.make_jaxpr(apply)(*inputs))
        lines = [line for line in text.splitlines() if "dot_general" in line and "bf16" in line]
        return len(lines)

    assert products("float32") == 0
    assert products("bfloat16") >= 4


def test_unknown_name():
    expected = "expected one of float32, bfloat16, float16, got 'fp8'"
    with pytest.raises(ValueError, match=expected), compute_dtype("fp8"):
        pass


def test_the_type_ends_with_its_block():
    with pytest.raises(RuntimeError), compute_dtype("bfloat16"):
        raise RuntimeError
    layer, x = conv(3), jnp.ones((1, 4, 4, 2))
    variables = layer.init(jax.random.key(1), x)
    assert "bf16" not in str(jax.make_jaxpr(lambda x: layer.apply(variables, x))(x))
