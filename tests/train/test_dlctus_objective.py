"""DLCTUS' objective: both losses by NumPy on a fake method, and gradients through the real one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.exposure import exposed
from essjax.frames import Prediction, select_time
from essjax.interfaces import Method, MethodInfo
from essjax.methods import dlctus
from essjax.train import dlctus_objective
from tests.helpers import make_sequence, random_image

T, B, H, W = 7, 2, 6, 8
ENCODED = random_image(3, T, B, 2 * H, 2 * W, 3, high=1.0)


def fake():
    """A method whose frame n shows ``ENCODED[n]``."""

    def render_step(variables, history, frame, *, train=False):
        assert train
        encoded = jnp.asarray(ENCODED)[history]
        return history + 1, Prediction(image=encoded, aux={"encoded": encoded})

    info = MethodInfo("fake", 2, renders_all=True)
    return exposed(
        Method(lambda key, example: {}, lambda example: jnp.zeros((), jnp.int32), render_step, render_step, info)
    )


def clip_with(motion=(0.0, 0.0)):
    clip = make_sequence(0, T=T, B=B, H=H, W=W)
    frames = dataclasses.replace(
        clip.frames,
        motion=jnp.broadcast_to(jnp.array(motion, jnp.float32), (T, B, H, W, 2)),
        jitter=jnp.zeros_like(clip.frames.jitter),
    )
    return dataclasses.replace(clip, frames=frames)


def errors(clip):
    reference = np.asarray(clip.reference, np.float64)
    return np.asarray(ENCODED, np.float64) - reference / (1 + reference)


@pytest.mark.parametrize("targets", [5, 2, 30])
def test_l1_of_the_last_frames(targets):
    clip = clip_with()
    terms, state = jax.jit(dlctus_objective(fake(), targets=targets))({}, clip)
    assert set(terms) == {"l1"} and state == {}
    expected = np.abs(errors(clip)[max(T - targets, 1) :]).mean()  # the first frame is not the network's
    np.testing.assert_allclose(terms["l1"], expected, rtol=1e-5)


@pytest.mark.parametrize("theta", [0.0, 0.5])
def test_spatio_temporal_loss_follows_the_motion(theta):
    clip = clip_with(motion=(0.5, -1.0))  # one output pixel from the right, two from above
    terms, _ = jax.jit(dlctus_objective(fake(), targets=4, theta=theta))({}, clip)
    error = errors(clip)
    x, y = error[-4:], error[-5:-1]
    columns, rows = np.minimum(np.arange(2 * W) + 1, 2 * W - 1), np.maximum(np.arange(2 * H) - 2, 0)
    y = y[:, :, rows][:, :, :, columns]
    expected = np.abs(x) + np.abs(y) + theta * (np.abs(x - y) - np.abs(x) - np.abs(y))  # eq 54
    np.testing.assert_allclose(terms["spatio_temporal"], expected.mean(), rtol=1e-5)


def test_gradients_reach_every_layer_through_the_history():
    method, clip = dlctus(scale=2), make_sequence(1, T=4, B=1, H=8, W=12)
    variables = method.init(jax.random.key(0), select_time(clip.frames, 0))
    objective = dlctus_objective(method, targets=1)
    value = lambda variables: sum(objective(variables, clip)[0].values())
    gradient = jax.jit(jax.grad(value))(variables)
    for leaf in jax.tree.leaves(gradient):
        assert bool(jnp.all(jnp.isfinite(leaf))) and float(jnp.abs(leaf).max()) > 0


def test_one_frame_is_refused():
    with pytest.raises(ValueError, match="clip: expected at least 2 frames, got 1"):
        dlctus_objective(fake())({}, select_time(clip_with(), slice(0, 1)))
