"""Both stages on one tiny clip: the loss falls, only the trained part moves, and NaN changes nothing."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.frames import select_time
from essjax.methods import extrass, extrass_e, warp
from essjax.train import adam, create_state, extrass_objective, frnet_objective, make_train_step
from tests.methods.scene import wall

STEPS = 15


@pytest.fixture(scope="module")
def clip():
    """Light moves over resting paint: what FRNet is for."""
    return wall(5, 1, 24, 32, light_speed=2.0)


@pytest.fixture(scope="module")
def variables(clip):
    return extrass(width=4, frnet_width=4).init(jax.random.key(0), select_time(clip.frames, 0))


@pytest.fixture(scope="module", params=["frnet", "extrassnet"])
def stage(request, clip, variables):
    """Name, jitted step and initial variables of a stage."""
    if request.param == "frnet":
        objective, variables = frnet_objective(extrass_e(width=4)), {"frnet": variables["frnet"]}
    else:
        objective = extrass_objective(extrass(width=4, frnet_width=4))
    return request.param, make_train_step(objective, adam(), request.param), variables


def test_loss_falls_and_only_the_trained_part_moves(stage, clip):
    name, step, variables = stage
    state, losses = create_state(variables, name, adam()), []
    for _ in range(STEPS):
        state, terms = step(state, clip, 3e-3)
        losses.append(float(terms["loss"]))
        values = {key: float(value) for key, value in terms.items()}
        assert all(np.isfinite(value) for value in values.values())
        parts = sum(value for key, value in values.items() if key not in ("loss", "gradient_norm"))
        np.testing.assert_allclose(parts, values["loss"], rtol=1e-5)
    assert np.mean(losses[-3:]) < 0.93 * losses[0], losses
    assert int(state.step) == STEPS

    for entry in variables:
        differ = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), variables[entry], state.variables[entry])
        # The clip is in the paper's setting: what multiplies conditions, which are 0, stays.
        moved = [
            each for path, each in jax.tree.leaves_with_path(differ) if "conditions" not in jax.tree_util.keystr(path)
        ]
        assert all(moved) if entry == name else not any(moved), entry


def test_nan_keeps_the_old_variables(stage, clip):
    name, step, variables = stage
    spoilt = dataclasses.replace(
        clip,
        reference=clip.reference.at[2, 0, 3, 4].set(jnp.nan),
        frames=dataclasses.replace(clip.frames, color=clip.frames.color.at[2, 0, 3, 4].set(jnp.nan)),
    )
    state, terms = step(create_state(variables, name, adam()), spoilt, 1e-3)
    assert not np.isfinite(float(terms["loss"]))
    jax.tree.map(np.testing.assert_array_equal, state.variables, variables)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.optimizer))


def test_an_objective_says_which_network_its_method_lacks():
    message = "warp: expected a method with a network 'frnet'; its networks: none."
    with pytest.raises(ValueError, match=re.escape(message)):
        frnet_objective(warp())
