"""The seam to flax: a linen module becomes a ``Network`` of pure functions over plain dicts."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.typing import Array, Key, PyTree


def kernel_deviation(key: Key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    """The ``kernel_init`` of all our layers: LeCun's standard deviation, constant; ``from_linen`` adds the noise."""
    fan_in = math.prod(shape[:-1])
    return jnp.full(shape, fan_in**-0.5, dtype)


def _multiply_kernels_by_noise(key: Key, variables: PyTree) -> PyTree:
    """Truncated normal noise for all kernels in one draw: each draw with several axes takes XLA seconds to compile."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(variables)
    sizes = [leaf.size if path[-1].key == "kernel" else 0 for path, leaf in leaves]
    noise = jax.random.truncated_normal(key, -2.0, 2.0, (sum(sizes),)) / 0.8796  # standard deviation 1
    drawn, start = [], 0
    for (_, leaf), size in zip(leaves, sizes, strict=True):
        drawn.append(leaf * noise[start : start + size].reshape(leaf.shape) if size else leaf)
        start += size
    return jax.tree.unflatten(tree, drawn)


def from_linen(module: nn.Module) -> Network:
    """Wrap a linen module whose ``__call__`` takes ``(*inputs, train)`` and whose kernels start as ``kernel_deviation``.

    Returns:
      ``Network(init, apply)``: ``init(key, *inputs) -> variables`` (inputs may be ``jax.ShapeDtypeStruct``); ``apply(variables, *inputs, train=False, method=None)
      method=None) -> (output, state)``, where ``state`` holds new BatchNorm statistics when ``train`` and is {} otherwise.
    """

    def init(key, *inputs):
        # Only shapes are looked at and only parameters computed: a plain init would compile and run a forward pass,
        # and a jitted one spends most of a minute on XLA:CPU's code for the random numbers of all layers together.
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), inputs)
        return module.lazy_init(key, *shapes, train=False)

    def apply(variables, *inputs, train: bool = False, method=None):
        if train and "batch_stats" in variables:
            return module.apply(variables, *inputs, train=True, method=method, mutable=["batch_stats"])
        return module.apply(variables, *inputs, train=train, method=method), {}

    return Network(init, apply)
