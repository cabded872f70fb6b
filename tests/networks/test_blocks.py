"""Building blocks against NumPy and other independent implementations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from essjax.networks.blocks import (
    ConvNorm,
    GatedConv,
    bilinear_upsample,
    bilinear_upsample_corners,
    crop,
    max_pool,
    pad_to_multiple,
)
from essjax.networks.linen import from_linen
from tests.helpers import random_image


def convolve(image, kernel, bias, stride):
    """3x3 with zero padding, one output pixel at a time; ``[B, H, W, C]``, HWIO."""
    padded = np.pad(np.asarray(image, np.float64), [(0, 0), (1, 1), (1, 1), (0, 0)])
    rows, columns = range(0, image.shape[1], stride), range(0, image.shape[2], stride)
    kernel = np.asarray(kernel, np.float64)
    pixel = lambda y, x: np.einsum("bijc,ijco->bo", padded[:, y : y + 3, x : x + 3], kernel) + np.asarray(bias)
    return np.stack([np.stack([pixel(y, x) for x in columns], axis=1) for y in rows], axis=1)


def busy(variables):
    """Variables none of which is zero, variances positive."""
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda leaf: leaf + jnp.asarray(rng.uniform(0.1, 0.4, leaf.shape), jnp.float32), variables)


@pytest.mark.parametrize("stride", [1, 2])
def test_gated_convolution_is_equations_1_to_3(stride):
    network, x = from_linen(GatedConv(4, stride=stride, norm=False)), random_image(0, 2, 4, 6, 3, low=-1.0)
    variables = busy(network.init(jax.random.key(0), x))
    layer = variables["params"]["Conv_0"]
    assert layer["kernel"].shape == (3, 3, 3, 5) and set(variables) == {"params"}
    both = convolve(x, layer["kernel"], layer["bias"], stride)
    expected = both[..., :4] / (1.0 + np.exp(-both[..., 4:]))
    output, state = network.apply(variables, x)
    np.testing.assert_allclose(output, expected, rtol=1e-4, atol=1e-5)
    assert state == {}


def test_batch_norm_has_pytorchs_defaults():
    """eps 1e-5; running statistics move a tenth of the way; the batch's own normalise in training."""
    network, x = from_linen(ConvNorm(2)), random_image(0, 2, 4, 6, 3, low=-1.0)
    variables = busy(network.init(jax.random.key(0), x))
    layer, norm = variables["params"]["Conv_0"], variables["params"]["BatchNorm_0"]
    running = variables["batch_stats"]["BatchNorm_0"]
    before = convolve(x, layer["kernel"], layer["bias"], 1)

    def normalise(mean, variance):
        return np.maximum((before - mean) / np.sqrt(variance + 1e-5) * norm["scale"] + norm["bias"], 0.0)

    output, state = network.apply(variables, x)
    np.testing.assert_allclose(output, normalise(running["mean"], running["var"]), rtol=1e-4, atol=1e-5)
    assert state == {}
    output, state = network.apply(variables, x, train=True)
    mean, variance = before.mean(axis=(0, 1, 2)), before.var(axis=(0, 1, 2))
    np.testing.assert_allclose(output, normalise(mean, variance), rtol=1e-3, atol=1e-4)
    new = state["batch_stats"]["BatchNorm_0"]
    np.testing.assert_allclose(new["mean"], 0.9 * running["mean"] + 0.1 * mean, rtol=1e-4)
    np.testing.assert_allclose(new["var"], 0.9 * running["var"] + 0.1 * variance, rtol=1e-4)


def test_bilinear_upsampling_equals_a_resize():
    image = random_image(0, 2, 5, 8, 3)
    expected = jax.image.resize(image, (2, 10, 16, 3), "linear")
    np.testing.assert_allclose(jax.jit(bilinear_upsample)(image), expected, rtol=1e-5, atol=1e-6)


def test_upsampling_corners_on_corners_reads_where_pytorch_does():
    image = np.asarray(random_image(1, 2, 5, 8, 3))
    rows, columns = np.linspace(0, 4, 10), np.linspace(0, 7, 16)
    grid = np.meshgrid(rows, columns, indexing="ij")
    got = np.asarray(jax.jit(bilinear_upsample_corners)(image))
    for b in range(2):
        for c in range(3):
            expected = ndimage.map_coordinates(image[b, ..., c], grid, order=1)
            np.testing.assert_allclose(got[b, ..., c], expected, rtol=1e-5, atol=1e-6)


def test_max_pool_and_its_gradient():
    image = random_image(2, 2, 4, 6, 3)
    weights = random_image(3, 2, 2, 3, 3)

    def total(image):
        return (max_pool(jax.nn.relu(image - 1.0)) * weights).sum()

    gradient = jax.jit(jax.grad(total), compiler_options={"xla_backend_optimization_level": 0})(image)
    blocks = np.asarray(image).reshape(2, 2, 2, 3, 2, 3).transpose(0, 1, 3, 5, 2, 4).reshape(2, 2, 3, 3, 4)
    np.testing.assert_allclose(max_pool(image), blocks.max(axis=-1))
    largest = (blocks == blocks.max(axis=-1, keepdims=True)) & (blocks > 1.0)
    expected = (largest * np.asarray(weights)[..., None]).reshape(2, 2, 3, 3, 2, 2).transpose(0, 1, 4, 2, 5, 3)
    np.testing.assert_allclose(gradient, expected.reshape(image.shape), rtol=1e-6)


def test_padding_to_a_multiple_repeats_the_last_row_and_column():
    image = random_image(0, 2, 5, 6, 3)
    expected = np.pad(image, [(0, 0), (0, 3), (0, 2), (0, 0)], mode="edge")
    np.testing.assert_array_equal(pad_to_multiple(image, 4), expected)
    np.testing.assert_array_equal(crop(expected, 5, 6), image)
    # Nothing to add, nothing to do: a pad by zero pixels is a copy to XLA.
    assert not jax.make_jaxpr(lambda image: pad_to_multiple(image, 2))(image[:, :4]).eqns
