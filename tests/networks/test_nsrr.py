"""NSRR's network: the published layers, odd sizes, what it returns before training."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.networks import nsrr
from essjax.networks._nsrr import FEATURES, PREVIOUS, RGBD
from tests.helpers import random_image

LAYERS = [
    *2 * [(4, 32), (32, 32), (32, 8)],  # features of the current and of previous frames
    (20, 32), (32, 32), (32, 4),  # reweighting
    (60, 64), (64, 32), (32, 64), (64, 64), (64, 128), (128, 128), (192, 64), (64, 64), (96, 32), (32, 3),  # U-Net
]  # fmt: skip


def shapes(width, *lead, height, wide):
    low, high = (*lead, height, wide, RGBD), (*lead, 2 * height, 2 * wide, FEATURES)
    return [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in (low, high, (PREVIOUS, *high))]


def test_layers_are_the_published_ones():
    variables = jax.eval_shape(nsrr().init, jax.random.key(0), *shapes(32, 1, height=8, wide=8))
    count = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(variables))
    assert count == sum(9 * inputs * outputs + outputs for inputs, outputs in LAYERS)


@pytest.fixture(scope="module")
def small():
    network = nsrr(width=4)
    return network, network.init(jax.random.key(0), *shapes(4, 2, height=5, wide=7))


def test_odd_sizes_and_range_of_the_weights(small):
    network, variables = small
    current, previous = random_image(0, 2, 10, 14, FEATURES), random_image(1, PREVIOUS, 2, 10, 14, FEATURES, high=9.0)
    run = jax.jit(lambda *inputs: network.apply(*inputs, method="reconstruct")[0])
    image, weights = run(variables, current, previous)
    assert image.shape == (2, 10, 14, 3) and weights.shape == (2, 10, 14, PREVIOUS)
    np.testing.assert_array_equal(image, 0.0)  # until it is trained
    assert 0 <= float(weights.min()) < 4 and 6 < float(weights.max()) <= 10


def test_features_begin_with_colour_and_depth(small):
    network, variables = small
    rgbd = random_image(2, 2, 5, 7, RGBD)
    current, previous = (network.apply(variables, rgbd, method=name)[0] for name in ("current", "previous"))
    for features in (current, previous):
        np.testing.assert_array_equal(features[..., :RGBD], rgbd)
        assert features.shape[-1] == FEATURES and float(features.min()) >= 0
    assert float(jnp.abs(current - previous).max()) > 0.01  # two networks
