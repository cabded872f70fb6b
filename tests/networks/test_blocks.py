"""Upsampling blocks against independent implementations."""

import jax
import numpy as np
from scipy import ndimage

from essjax.networks.blocks import bilinear_upsample, bilinear_upsample_corners
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
