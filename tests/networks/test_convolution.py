"""The convolution that is fast in a scan is the ordinary convolution: values, gradients, and what it hands on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from essjax.networks import convolution
from essjax.networks.convolution import scan_friendly_convolution
from tests.helpers import random_image

NHWC = ("NHWC", "HWIO", "NHWC")


def plain(x, kernel):
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=NHWC)


def friendly(x, kernel):
    return scan_friendly_convolution(x, kernel, (1, 1), "SAME", dimension_numbers=NHWC)


@pytest.mark.parametrize("size", [(3, 3), (1, 5)], ids=["3x3", "1x5"])
def test_value_and_gradients_equal_the_plain_convolution(size):
    x, kernel = random_image(0, 2, 5, 8, 3, low=-1.0), random_image(1, *size, 3, 4, low=-1.0)
    target = random_image(2, 2, 5, 8, 4)  # asymmetric: a flipped kernel or swapped axes cannot cancel

    @jax.jit
    def evaluate(x, kernel):
        def loss(function):
            return lambda x, kernel: jnp.sum(function(x, kernel) * target)

        values = friendly(x, kernel), plain(x, kernel)
        return values, [jax.grad(loss(function), argnums=(0, 1))(x, kernel) for function in (friendly, plain)]

    (ours, theirs), (our_gradients, their_gradients) = evaluate(x, kernel)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(our_gradients, their_gradients, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("shape", "strides", "padding", "options"),
    [
        ((3, 3, 3, 2), (2, 2), "SAME", {}),
        ((3, 3, 3, 2), (1, 1), "VALID", {}),
        ((2, 2, 3, 2), (1, 1), "SAME", {}),
        ((3, 3, 3, 2), (1, 1), "SAME", {"rhs_dilation": (2, 2)}),
        ((3, 3, 1, 3), (1, 1), "SAME", {"feature_group_count": 3}),
    ],
    ids=["stride", "valid", "even", "dilated", "grouped"],
)
def test_everything_else_falls_through(monkeypatch, shape, strides, padding, options):
    def refuse(x, kernel):
        raise AssertionError("the special case must not take this convolution")

    monkeypatch.setattr(convolution, "_convolve", refuse)
    x, kernel = random_image(0, 1, 5, 8, 3), random_image(1, *shape)
    arguments = (x, kernel, strides, padding)
    result = scan_friendly_convolution(*arguments, dimension_numbers=NHWC, **options)
    np.testing.assert_array_equal(result, lax.conv_general_dilated(*arguments, dimension_numbers=NHWC, **options))
    with pytest.raises(AssertionError, match="must not take"):
        friendly(x, random_image(1, 3, 3, 3, 2))
