"""The train step: one jitted function, state donated."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from essjax.frames import Sequence
from essjax.train.objective import Objective
from essjax.train.state import TrainState
from essjax.typing import Array, Callable


def make_train_step(
    objective: Objective,
    transform: optax.GradientTransformation,
    trained: str,
    *,
    compiler_options: dict[str, Any] | None = None,
) -> Callable[[TrainState, Sequence, float], tuple[TrainState, dict[str, Array]]]:
    """``step(state, clip, learning_rate) -> (state, terms)``, jitted, the state donated.

    ``terms`` holds the weighted terms, ``loss`` (their sum) and ``gradient_norm``. A step whose loss or gradient is not
    finite changes nothing but the step count; the loop raises ``NonFiniteLoss``.

    Args:
      objective: ``(variables, clip) -> terms``.
      transform: the optimiser, without its learning rate.
      trained: the entry of ``variables`` that is differentiated; the others are frozen.
      compiler_options: for ``jax.jit``.
    """

    @partial(jax.jit, donate_argnums=0, compiler_options=compiler_options)
    def step(state: TrainState, clip: Sequence, learning_rate: float):
        def loss(part):
            terms = objective({**state.variables, trained: part}, clip)
            return sum(terms.values()), terms

        (total, terms), gradient = jax.value_and_grad(loss, has_aux=True)(state.variables[trained])
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(total) & jnp.isfinite(norm)
        updates, new_optimizer = transform.update(gradient, state.optimizer, state.variables[trained])
        updates = jax.tree.map(lambda update: -learning_rate * update, updates)
        new_part = optax.apply_updates(state.variables[trained], updates)
        new = ({**state.variables, trained: new_part}, new_optimizer)
        old = (state.variables, state.optimizer)
        variables, new_optimizer = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)
        state = dataclasses.replace(state, variables=variables, optimizer=new_optimizer, step=state.step + 1)
        return state, {**terms, "loss": total, "gradient_norm": norm}

    return step
