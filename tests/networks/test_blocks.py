"""Upsampling blocks against independent implementations."""

import jax
import numpy as np
from scipy import ndimage

from essjax.networks.blocks import bilinear_upsample, bilinear_upsample_corners, max_pool
from tests.helpers import random_image


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
