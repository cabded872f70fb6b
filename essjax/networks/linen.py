"""The seam to flax: a linen module becomes a ``Network`` of pure functions over plain dicts."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from essjax.interfaces import Network
from essjax.typing import Array, Key, PyTree


def kernel_bound(key: Key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    """Return our ``kernel_init``: the bound of He's uniform distribution; ``from_linen`` multiplies by noise.

    Source: He et al. 2015, eq 10, for ReLU: variance 2 / fan-in.
    """
    del key
    return jnp.full(shape, math.sqrt(6.0 / math.prod(shape[:-1])), dtype)


def _multiply_kernels_by_noise(key: Key, variables: PyTree) -> PyTree:
    """Uniform noise in [-1, 1) for all kernels."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(variables)
    sizes = [leaf.size if path[-1].key == "kernel" else 0 for path, leaf in leaves]
    # One draw along one axis: XLA:CPU compiles seconds for each draw of an array with several axes.
    noise = jax.random.uniform(key, (sum(sizes),), jnp.float32, minval=-1.0)
    drawn, start = [], 0
    for (_, leaf), size in zip(leaves, sizes, strict=True):
        drawn.append(leaf * noise[start : start + size].reshape(leaf.shape) if size else leaf)
        start += size
    return jax.tree.unflatten(tree, drawn)


def from_linen(module: nn.Module) -> Network:
    """Wrap a linen module whose ``__call__`` takes ``(*inputs, train)`` and whose kernels start as ``kernel_bound``.

    Returns:
      ``Network(init, apply)``: ``init(key, *inputs) -> variables`` (inputs may be ``jax.ShapeDtypeStruct``);
      ``apply(variables, *inputs, train=False, method=None) -> (output, state)``, where ``state`` holds new BatchNorm
      statistics when ``train`` and is {} otherwise.
    """

    def init(key, *inputs):
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), inputs)  # no forward pass

        @jax.jit
        def make(key):
            return _multiply_kernels_by_noise(key, module.lazy_init(key, *shapes, train=False))

        return make(key)

    def apply(variables, *inputs, train: bool = False, method=None):
        if train and "batch_stats" in variables:
            return module.apply(variables, *inputs, train=True, method=method, mutable=["batch_stats"])
        return module.apply(variables, *inputs, train=train, method=method), {}

    return Network(init, apply)
