"""The state that a training stage carries from step to step."""

import dataclasses
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.flatten_util import ravel_pytree

from essjax.typing import Array, Callable, PyTree, pytree

STATISTICS = "batch_stats"
"""Linen's collection of BatchNorm statistics."""


@pytree
class TrainState:
    """Everything that changes: a checkpoint of it (and of the data iterator) continues a run exactly.

    Attributes:
      variables: all of the method's variables; a stage trains one entry, the others are frozen.
      optimizer: optax state of the trained entry.
      step: steps taken, int32.
      history: task -> what its next clip goes on from, where clips follow each other (``Recurrent``).
      average: moving average of the trained weights, as one vector; or None.
    """

    variables: PyTree
    optimizer: PyTree
    step: Array
    history: dict[str, PyTree] = dataclasses.field(default_factory=dict)
    average: Array | None = None


def adam(*, clip_norm: float = 1.0) -> optax.GradientTransformation:
    """Adam (0.9, 0.999) after a clip of the global gradient norm; the step multiplies with the learning rate.

    Gradients and both moments are one vector each: array by array, half of the time of compiling it was for loops over
    a few numbers.
    """
    return optax.chain(optax.clip_by_global_norm(clip_norm), optax.flatten(optax.scale_by_adam()))


def muon(*, clip_norm: float = 1.0) -> optax.GradientTransformation:
    """Muon for kernels, Adam for all else, after a clip of the global gradient norm; learning rates as for ``adam``.

    A kernel's momentum, as a matrix of inputs by output channels, is brought near the closest orthogonal matrix (Jordan
    et al. 2024), and its update to Adam's usual size (Liu et al. 2025): a few hundred steps go further than Adam's.
    """
    matrices = optax.contrib.muon(
        learning_rate=-1.0,  # not here: the step multiplies with minus the rate
        consistent_rms=0.2,
        muon_weight_dimension_numbers=lambda kernels: jax.tree.map(_as_matrix, kernels),
    )
    parts = {"kernel": matrices, "other": optax.flatten(optax.scale_by_adam())}

    def labels(weights: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: "kernel" if leaf.ndim > 1 else "other", weights)

    return optax.chain(optax.clip_by_global_norm(clip_norm), optax.partition(parts, labels))


def _as_matrix(kernel: Array) -> optax.contrib.MuonDimensionNumbers:
    last = kernel.ndim - 1
    return optax.contrib.MuonDimensionNumbers(reduction_axis=tuple(range(last)), output_axis=(last,))


OPTIMIZERS = {"adam": adam, "muon": muon}


def create_state(
    variables: PyTree,
    trained: str,
    transform: optax.GradientTransformation,
    *,
    history: Mapping[str, PyTree] | None = None,
    average: bool = False,
) -> TrainState:
    """Make a state at step 0 that trains ``variables[trained]``.

    ``history``: task -> ``Recurrent.start`` of its first clip, where clips follow each other.

    With ``average`` the weights are averaged over the steps, see ``averaged``.

    Raises:
      ValueError: there is no such entry.
    """
    if trained not in variables:
        raise ValueError(f"trained: expected one of {', '.join(sorted(variables))}, got {trained!r}.")
    variables, history = jax.tree.map(
        jnp.array, (variables, dict(history or {}))
    )  # copies: the train step donates its state
    weights, _ = split_statistics(variables[trained])
    step = jnp.zeros((), jnp.int32)
    mean = jnp.array(ravel_pytree(weights)[0]) if average else None
    return TrainState(variables=variables, optimizer=transform.init(weights), step=step, history=history, average=mean)


def averaged(state: TrainState, trained: str) -> PyTree:
    """Put the moving average of the trained weights, if there is one, in place of the last ones."""
    if state.average is None:
        return state.variables
    weights, statistics = split_statistics(state.variables[trained])
    return {**state.variables, trained: {**ravel_pytree(weights)[1](state.average), **statistics}}


def update_average(average: Array, weights: PyTree, step: Array, decay: float) -> Array:
    """Move the average by one more step: over about 1 / (1 - decay) steps, over a tenth of them at first.

    Args:
      average: before the step, one vector.
      weights: after it.
      step: steps taken before it.
      decay: in [0, 1).
    """
    decay = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return average + (1.0 - decay) * (ravel_pytree(weights)[0] - average)


def split_statistics(entry: PyTree) -> tuple[PyTree, PyTree]:
    """Split an entry of the variables into what gradients change and its BatchNorm statistics ({} if it has none)."""
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
