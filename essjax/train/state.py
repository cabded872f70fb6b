"""What a training stage carries from step to step."""

import math

import jax
import jax.numpy as jnp
import optax

from essjax.typing import Array, Callable, PyTree, pytree

STATISTICS = "batch_stats"
"""Linen's collection of BatchNorm statistics."""


@pytree
class TrainState:
    """Everything that changes: a checkpoint of it (and of the data iterator) continues a run exactly.

    Attributes:
      variables: all of the method's variables; a stage trains one entry, the others are frozen.
      optimizer: optax state of the trained entry, its arrays behind each other as one vector.
      step: steps taken, int32.
      history: what the next clip goes on from where clips follow each other (``Recurrent``), else None.
    """

    variables: PyTree
    optimizer: PyTree
    step: Array
    history: PyTree = None


def optimizer(*, clip_norm: float = 1.0) -> optax.GradientTransformation:
    """Adam (0.9, 0.999) behind a clip of the global gradient norm; the step multiplies with the learning rate.

    Gradients and both moments are one vector each: array by array, half of the time of compiling it was for loops over
    a few numbers.
    """
    return optax.flatten(optax.chain(optax.clip_by_global_norm(clip_norm), optax.scale_by_adam()))


def create_state(
    variables: PyTree, trained: str, transform: optax.GradientTransformation, *, history: PyTree = None
) -> TrainState:
    """A state at step 0 that trains ``variables[trained]``; with ``history`` (``Recurrent.start``) on successive clips.

    Raises:
      ValueError: there is no such entry.
    """
    if trained not in variables:
        raise ValueError(f"trained: expected one of {', '.join(sorted(variables))}, got {trained!r}.")
    variables, history = jax.tree.map(jnp.array, (variables, history))  # copies: the train step donates its state
    weights, _ = split_statistics(variables[trained])
    step = jnp.zeros((), jnp.int32)
    return TrainState(variables=variables, optimizer=transform.init(weights), step=step, history=history)


def split_statistics(entry: PyTree) -> tuple[PyTree, PyTree]:
    """An entry of the variables as what gradients change and its BatchNorm statistics ({} if it has none)."""
    weights = {name: part for name, part in entry.items() if name != STATISTICS}
    return weights, {name: part for name, part in entry.items() if name == STATISTICS}


def cosine(progress: float, *, start: float = 0.0, floor: float = 0.02) -> float:
    """Decay of the learning rate: 1 up to progress ``start``, then half a cosine to ``floor``.

    Args:
      progress: fraction of the budget that is used up, in [0, 1].
      start: where the decay starts, in [0, 1).
      floor: the last factor.
    """
    part = min(max(progress - start, 0.0) / (1.0 - start), 1.0)
    return floor + (1.0 - floor) * 0.5 * (1.0 + math.cos(math.pi * part))


def halving(progress: float, *, times: int) -> float:
    """Decay of the learning rate: halved after each of ``times`` equal parts of the budget but the last."""
    return 0.5 ** min(math.floor(progress * times), times - 1)


def constant(progress: float) -> float:
    """No decay."""
    return 1.0


def learning_rate(
    step: int, progress: float, *, peak: float, decay: Callable[[float], float] = cosine, warmup_steps: int = 20
) -> float:
    """Learning rate: linear warm-up over the first steps, times ``peak``, times the decay at this progress.

    The warm-up counts steps: Adam's averages need so many, whatever the machine.

    Args:
      step: steps taken.
      progress: fraction of the budget that is used up, in [0, 1].
      peak: largest rate.
      decay: ``progress -> factor``.
      warmup_steps: length of the warm-up.
    """
    return min((step + 1) / warmup_steps, 1.0) * peak * decay(progress)
