"""What a training stage carries from step to step."""

import math

import jax
import jax.numpy as jnp
import optax

from essjax.typing import Array, PyTree, pytree


@pytree
class TrainState:
    """Everything that changes: a checkpoint of it (and of the data iterator) continues a run exactly.

    Attributes:
      variables: all of the method's variables; a stage trains one entry, the others are frozen.
      optimizer: optax state of the trained entry.
      step: steps taken, int32.
    """

    variables: PyTree
    optimizer: PyTree
    step: Array


def optimizer(*, clip_norm: float = 1.0) -> optax.GradientTransformation:
    """Adam (0.9, 0.999) behind a clip of the global gradient norm; the step multiplies with the learning rate."""
    return optax.chain(optax.clip_by_global_norm(clip_norm), optax.scale_by_adam())


def create_state(variables: PyTree, trained: str, transform: optax.GradientTransformation) -> TrainState:
    """A state at step 0 that trains ``variables[trained]``.

    Raises:
      ValueError: there is no such entry.
    """
    if trained not in variables:
        raise ValueError(f"trained: expected one of {', '.join(sorted(variables))}, got {trained!r}.")
    variables = jax.tree.map(jnp.array, variables)  # copies: the train step donates its state
    return TrainState(variables=variables, optimizer=transform.init(variables[trained]), step=jnp.zeros((), jnp.int32))


def cosine(step: int, progress: float, *, peak: float, warmup_steps: int = 20, floor: float = 0.02) -> float:
    """Learning rate: linear warm-up over the first steps, cosine decay from ``peak`` to ``floor * peak`` over progress.

    The warm-up counts steps because on a clock the first step is mostly compilation.

    Args:
      step: steps taken.
      progress: fraction of the budget that is used up, in [0, 1].
      peak: largest rate.
      warmup_steps: length of the warm-up.
      floor: last rate over ``peak``.
    """
    warmup = min((step + 1) / warmup_steps, 1.0)
    return warmup * peak * (floor + (1.0 - floor) * 0.5 * (1.0 + math.cos(math.pi * min(progress, 1.0))))
