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


def plain(x, kernel, strides=(1, 1), padding="SAME"):
    return lax.conv_general_dilated(x, kernel, strides, padding, dimension_numbers=NHWC)


def friendly(x, kernel, strides=(1, 1), padding="SAME"):
    return scan_friendly_convolution(x, kernel, strides, padding, dimension_numbers=NHWC)


@pytest.mark.parametrize(
    ("size", "stride", "padding"),
    [
        ((3, 3), 1, "SAME"),
        ((1, 5), 1, "SAME"),
        ((2, 4), 1, "SAME"),
        ((3, 3), 2, [(1, 1), (1, 1)]),
        ((3, 3), 2, "SAME"),
        ((4, 4), 4, "VALID"),
        ((5, 4), 2, [(3, 1), (0, 2)]),
    ],
    ids=["3x3", "1x5", "even", "stride-2", "stride-2-same", "blocks", "lopsided"],
)
def test_value_and_gradients_equal_the_plain_convolution(monkeypatch, size, stride, padding):
    x, kernel = random_image(0, 2, 4, 8, 3, low=-1.0), random_image(1, *size, 3, 4, low=-1.0)
    target = random_image(2, 2, 4 // stride, 8 // stride, 4)  # asymmetric: no flip and no swap of axes can cancel

    @jax.jit
    def evaluate(x, kernel):
        def loss(function):
            return lambda x, kernel: jnp.sum(function(x, kernel, (stride, stride), padding) * target)

        values = [function(x, kernel, (stride, stride), padding) for function in (friendly, plain)]
        return values, [jax.grad(loss(function), argnums=(0, 1))(x, kernel) for function in (friendly, plain)]

    (ours, theirs), (our_gradients, their_gradients) = evaluate(x, kernel)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(our_gradients, their_gradients, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(convolution, "_convolve", _refuse)
    with pytest.raises(AssertionError, match="must not take"):  # it was the special case
        jax.grad(lambda x: jnp.sum(friendly(x, kernel, (stride, stride), padding)))(x)


@pytest.mark.parametrize(("size", "padding"), [((3, 3), "SAME"), ((2, 3), [(1, 0), (0, 2)])], ids=["3x3", "lopsided"])
def test_depthwise_equals_the_grouped_convolution(monkeypatch, size, padding):
    x, kernel = random_image(0, 2, 5, 8, 3, low=-1.0), random_image(1, *size, 1, 3, low=-1.0)
    target = random_image(2, 2, 5, 8, 3)
    options = {"dimension_numbers": NHWC, "feature_group_count": 3}

    @jax.jit
    def evaluate(x, kernel):
        results = []
        for function in (scan_friendly_convolution, lax.conv_general_dilated):
            value, pull = jax.vjp(lambda x, k, f=function: f(x, k, (1, 1), padding, **options), x, kernel)
            results.append((value, *pull(target)))
        return results

    for ours, theirs in zip(*evaluate(x, kernel), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
    monkeypatch.setattr(convolution, "_depthwise", _refuse)
    with pytest.raises(AssertionError, match="must not take"):
        scan_friendly_convolution(x, kernel, (1, 1), padding, **options)


def _refuse(x, kernel, padding):
    raise AssertionError("the special case must not take this convolution")


@pytest.mark.parametrize(
    ("shape", "strides", "padding", "options"),
    [
        ((3, 3, 3, 2), (2, 2), "SAME", {}),
        ((3, 3, 3, 2), (1, 1), "VALID", {}),
        ((3, 3, 3, 2), (2, 1), "SAME", {}),
        ((3, 3, 3, 2), (1, 1), "SAME", {"rhs_dilation": (2, 2)}),
        ((3, 3, 1, 6), (1, 1), "SAME", {"feature_group_count": 3}),
        ((3, 3, 1, 3), (2, 2), "SAME", {"feature_group_count": 3}),
    ],
    ids=["odd-size", "valid", "two-strides", "dilated", "grouped", "strided-depthwise"],
)
def test_everything_else_falls_through(monkeypatch, shape, strides, padding, options):
    monkeypatch.setattr(convolution, "_convolve", _refuse)
    monkeypatch.setattr(convolution, "_depthwise", _refuse)
    x, kernel = random_image(0, 1, 5, 8, 3), random_image(1, *shape)
    arguments = (x, kernel, strides, padding)
    result = scan_friendly_convolution(*arguments, dimension_numbers=NHWC, **options)
    np.testing.assert_array_equal(result, lax.conv_general_dilated(*arguments, dimension_numbers=NHWC, **options))
