"""The seam to flax: a linen module becomes a ``Network`` of pure functions over plain dicts."""

import flax.linen as nn
import jax

from essjax.interfaces import Network


def from_linen(module: nn.Module) -> Network:
    """Wrap a linen module whose ``__call__`` takes ``(*inputs, train)``.

    Returns:
      ``Network(init, apply)``: ``init(key, *inputs) -> variables``; ``apply(variables, *inputs, train=False, method=None)
      -> (output, state)``, where ``state`` holds new BatchNorm statistics when ``train`` and is {} otherwise.
    """

    @jax.jit  # the forward pass is dead code there: nothing of it is compiled
    def init(key, *inputs):
        return module.init(key, *inputs, train=False)

    def apply(variables, *inputs, train: bool = False, method=None):
        if train and "batch_stats" in variables:
            return module.apply(variables, *inputs, train=True, method=method, mutable=["batch_stats"])
        return module.apply(variables, *inputs, train=train, method=method), {}

    return Network(init, apply)
