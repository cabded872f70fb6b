"""The train step: one jitted function, state donated."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from essjax.frames import Sequence
from essjax.train.objectives import Objective, Recurrent
from essjax.train.state import TrainState, split_statistics, update_average
from essjax.typing import Array, Callable, PyTree


def make_train_step(
    objective: Objective | Recurrent,
    transform: optax.GradientTransformation,
    trained: str,
    *,
    task: str = "",
    average: float = 0.99,
    compiler_options: dict[str, Any] | None = None,
) -> Callable[[TrainState, Sequence, float], tuple[TrainState, dict[str, Array]]]:
    """``step(state, clip, learning_rate) -> (state, terms)``, jitted, the state donated.

    ``terms`` holds the weighted terms, ``loss`` (their sum) and ``gradient_norm``. A step whose loss or gradient is not
    finite changes nothing but the step count; the loop raises ``NonFiniteLoss``. Where the state holds a history of the
    task, its clips follow each other and ``objective`` is a ``Recurrent``.

    Args:
      objective: ``(variables, clip) -> (terms, state)``; the statistics that it returns for ``trained`` are folded
        into the variables, those of frozen entries are not.
      transform: the optimiser, without its learning rate.
      trained: the entry of ``variables`` that is differentiated; the others are frozen.
      task: whose clips the step is for, of several that take turns.
      average: decay of the moving average of the weights, where the state holds one.
      compiler_options: for ``jax.jit``.
    """

    @partial(jax.jit, donate_argnums=0, compiler_options=compiler_options)
    def step(state: TrainState, clip: Sequence, learning_rate: float):
        weights, statistics = split_statistics(state.variables[trained])

        def loss(weights):
            variables = {**state.variables, trained: {**weights, **statistics}}
            if task in state.history:
                terms, new, history = objective.follow(variables, clip, state.history[task])
                return sum(terms.values()), (terms, new.get(trained, {}), {**state.history, task: history})
            terms, new = objective(variables, clip)
            return sum(terms.values()), (terms, new.get(trained, {}), state.history)

        (total, (terms, new_statistics, history)), gradient = jax.value_and_grad(loss, has_aux=True)(weights)
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(total) & jnp.isfinite(norm)
        updates, new_optimizer = transform.update(gradient, state.optimizer, weights)
        updates = jax.tree.map(lambda update: -learning_rate * update, updates)
        new_weights: PyTree = optax.apply_updates(weights, updates)
        new_entry = {**statistics, **new_statistics, **new_weights}
        new = (new_entry, new_optimizer, history)
        old = (state.variables[trained], state.optimizer, state.history)
        entry, new_optimizer, history = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)
        variables = {**state.variables, trained: entry}
        mean = state.average
        if mean is not None:
            mean = update_average(mean, split_statistics(entry)[0], state.step, average)
        state = TrainState(
            variables=variables, optimizer=new_optimizer, step=state.step + 1, history=history, average=mean
        )
        return state, {**terms, "loss": total, "gradient_norm": norm}

    return step
