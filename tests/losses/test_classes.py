"""Cross-entropy and class weights against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.losses import class_weights, cross_entropy, masked_mean
from tests.helpers import random_image


def test_cross_entropy_equals_numpy_and_stays_finite():
    logits = random_image(0, 2, 3, 5, 4, low=-3.0, high=3.0).at[0, 0, 0].set(jnp.array([0.0, 200.0, -200.0, 0.0]))
    classes = jnp.asarray(np.random.default_rng(1).integers(0, 4, (2, 3, 5, 1)))
    got = jax.jit(cross_entropy)(logits, classes)
    x = np.asarray(logits, np.float64)
    chosen = np.take_along_axis(x, np.asarray(classes), axis=-1)
    np.testing.assert_allclose(got, np.logaddexp.reduce(x, axis=-1, keepdims=True) - chosen, rtol=1e-5, atol=1e-5)
    gradient = jax.jit(jax.grad(lambda x: cross_entropy(x, classes).sum()))(logits)
    softmax = np.exp(x - np.logaddexp.reduce(x, axis=-1, keepdims=True))
    np.testing.assert_allclose(gradient, softmax - np.eye(4)[np.asarray(classes)[..., 0]], atol=1e-5)


def test_a_class_out_of_range_costs_nan_unless_it_is_masked():
    logits, classes = jnp.zeros((1, 3, 4)), jnp.array([[[9], [-1], [3]]])
    np.testing.assert_allclose(cross_entropy(logits, classes)[0, :, 0], [np.nan, np.nan, np.log(4)], rtol=1e-6)
    mask = jnp.array([[[0.0], [0.0], [1.0]]])
    assert float(masked_mean(cross_entropy(logits, classes), mask)) == pytest.approx(np.log(4), rel=1e-6)
    gradient = jax.grad(lambda x: masked_mean(cross_entropy(x, classes), mask))(logits)
    np.testing.assert_allclose(gradient[0], [[0] * 4, [0] * 4, [0.25, 0.25, 0.25, -0.75]], atol=1e-6)


def test_weights_by_hand():
    """Six of eight pixels count: four of class 0, two of class 1, none of class 2."""
    classes = jnp.array([[0, 0, 1, 2], [0, 1, 0, 2]])[..., None]
    mask = jnp.array([[1, 1, 1, 0], [1, 1, 1, 0.0]])[..., None]
    weigh = jax.jit(class_weights, static_argnums=1, static_argnames="balance")
    full = weigh(classes, 3, mask, balance=1.0)[..., 0]
    np.testing.assert_allclose(full, [[0.75, 0.75, 1.5, 0], [0.75, 1.5, 0.75, 0]], rtol=1e-5)  # 3 for each class
    none = weigh(classes, 3, mask, balance=0.0)
    np.testing.assert_allclose(none, mask, rtol=1e-5)
    half = weigh(classes, 3, mask, balance=0.5)[..., 0]
    np.testing.assert_allclose(half[0, 2] / half[0, 0], np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(half.sum(), 6.0, rtol=1e-5)
    assert not weigh(classes, 3, jnp.zeros_like(mask), balance=1.0).any()


def test_errors():
    with pytest.raises(ValueError, match=r"cross_entropy: expected classes \(4, 5, 1\) for logits \(4, 5, 3\), got"):
        cross_entropy(jnp.zeros((4, 5, 3)), jnp.zeros((4, 5), int))
