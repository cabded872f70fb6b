"""ExtraNet's objective: which frames the prediction comes from, every term by NumPy, and that training learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import log1p
from essjax.exposure import exposed
from essjax.frames import Prediction, select_time
from essjax.interfaces import Method, MethodInfo
from essjax.methods import extranet
from essjax.methods._extranet import Inputs
from essjax.methods.rendered import albedo
from essjax.train import extranet_objective, predict_last
from tests.helpers import make_sequence, random_image
from tests.methods.scene import wall

B, H, W = 2, 14, 18
LOG = 8


def fake(shading, mask):
    """History: the last ``LOG`` steps as (frame's first motion, kind), newest last. Only the last step trains."""

    def step(kind):
        def run(variables, history, frame, *, train=False):
            assert (frame.color is not None) == (kind == 0) and not (train and kind == 0)
            new = jnp.stack([frame.motion[0, 0, 0, 0], jnp.float32(kind)])
            history = jnp.concatenate([history[1:], new[None]])
            unused = jnp.zeros(())
            inputs = Inputs(warped=unused, mask=mask, features=unused, history=unused)
            aux = {"log_shading": variables["extranet"] * shading, "inputs": inputs, "log": history}
            return history, Prediction(image=shading, aux=aux, state={"extranet": {"batch_stats": train}})

        return run

    start = lambda example: jnp.full((LOG, 2), -1.0)
    return exposed(Method(lambda key, example: {}, start, step(0), step(1), MethodInfo("fake", 1)))


def numbered(length):
    """A clip whose motion holds the frame's number."""
    clip = make_sequence(0, T=length, B=B, H=H, W=W)
    numbers = jnp.arange(length, dtype=jnp.float32)[:, None, None, None, None]
    motion = jnp.broadcast_to(numbers, clip.frames.motion.shape)
    return dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, motion=motion))


SHADING, MASK = random_image(1, B, H, W, 3), jnp.round(random_image(2, B, H, W, 1, high=1.0))


@pytest.mark.parametrize(("length", "kinds"), [(2, [0, 1]), (3, [0, 0, 1]), (6, [0, 1, 0, 1, 0, 1])])
def test_the_last_frame_is_predicted_from_the_alternation(length, kinds):
    prediction = predict_last(fake(SHADING, MASK), {"extranet": 1.0}, numbered(length).frames)
    log = np.asarray(prediction.aux["log"])
    np.testing.assert_array_equal(log[-length:], np.stack([np.arange(length), kinds], axis=-1))
    assert (log[:-length] == -1).all() and prediction.state["extranet"]["batch_stats"] is True
    with pytest.raises(
        ValueError, match="clip: expected at least 2 frames, the last to predict and one before it, got 1"
    ):
        predict_last(fake(SHADING, MASK), {"extranet": 1.0}, numbered(1).frames)


def test_terms_equal_numpy():
    """A clip of seven frames: the last six are used, and frame 6 is the target, demodulated, log(1 + x)."""
    clip = numbered(7)
    objective = extranet_objective(fake(SHADING, MASK), hole_weight=2.0, shade_weight=3.0, share=0.2)
    terms, state = jax.jit(objective)({"extranet": jnp.float32(0.5)}, clip)
    last = select_time(clip.frames, 6)
    target = np.log1p(np.asarray(last.color, np.float64) / np.asarray(albedo(last.gbuffers)))
    error = np.abs(0.5 * np.asarray(SHADING, np.float64) - target)
    hole = np.broadcast_to(1.0 - np.asarray(MASK), error.shape)
    worst = np.sort(error.mean(axis=-1).reshape(B, -1), axis=-1)[:, -round(0.2 * H * W) :]
    np.testing.assert_allclose(terms["l1"], error.mean(), rtol=1e-4)
    np.testing.assert_allclose(terms["hole"], 2.0 * (error * hole).sum() / hole.sum(), rtol=1e-4)
    np.testing.assert_allclose(terms["shade"], 3.0 * worst.mean(), rtol=1e-4)
    assert set(terms) == {"l1", "hole", "shade"} and set(state) == {"extranet"}
    without = extranet_objective(fake(SHADING, MASK), shade_weight=0.0)
    assert set(jax.eval_shape(without, {"extranet": jnp.float32(0.5)}, clip)[0]) == {"l1", "hole"}
    history = predict_last(fake(SHADING, MASK), {"extranet": 1.0}, select_time(clip.frames, slice(1, 7))).aux["log"]
    np.testing.assert_array_equal(history[-6:, 0], np.arange(1, 7))


def test_at_one_in_three_both_distances_count():
    """The mean over the frame as it is extrapolated one and two frames after the last rendered one."""
    seen = []

    def listen(step, kind):
        def run(variables, history, frame, *, train=False):
            seen.append((kind, frame.color is None))
            return step(variables, history, frame, train=train)

        return run

    method = fake(SHADING, MASK)
    steps = {name: listen(getattr(method, name), name[0]) for name in ("render_step", "extrapolate_step")}
    terms, _ = extranet_objective(method._replace(**steps), period=3)({"extranet": jnp.float32(0.5)}, numbered(9))
    once, _ = extranet_objective(method)({"extranet": jnp.float32(0.5)}, numbered(9))
    np.testing.assert_allclose(terms["l1"], once["l1"], rtol=1e-5)  # the fake shows the same at every distance
    kinds = "".join(kind for kind, _ in seen)
    assert kinds.endswith("ree")


def test_training_learns_how_the_light_moves():
    """A resting wall under moving light: the warp alone shows the light of a frame ago. Steps by sign, as Adam's first.

    Without history encoder: it compiles in two thirds of the time.
    """
    clip = wall(6, 4, 16, 16, light_speed=1.0)
    rough = jnp.ones_like(clip.frames.gbuffers.depth)
    gbuffers = dataclasses.replace(clip.frames.gbuffers, roughness=rough, metallic=0.0 * rough)
    clip = dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, gbuffers=gbuffers))
    method = extranet(history=False)
    entry = jax.tree.map(np.asarray, method.init(jax.random.key(0), select_time(clip.frames, 0))["extranet"])
    objective = extranet_objective(method)

    @jax.jit
    def evaluate(weights, statistics):
        def loss(weights):
            terms, state = objective({"extranet": {"params": weights, "batch_stats": statistics}}, clip)
            return sum(terms.values()), state["extranet"]["batch_stats"]

        return jax.value_and_grad(loss, has_aux=True)(weights)

    weights, statistics, losses = entry["params"], entry["batch_stats"], []
    for _ in range(12):
        (loss, statistics), gradient = evaluate(weights, statistics)
        assert jax.tree.structure(statistics) == jax.tree.structure(entry["batch_stats"])
        weights = jax.tree.map(lambda weight, slope: weight - 3e-3 * np.sign(slope), weights, gradient)
        losses.append(float(loss))
    last, previous = select_time(clip.frames, 5), select_time(clip.frames, 4)
    assert float(jnp.abs(log1p(last.color) - log1p(previous.color)).mean()) > 0.04  # there is something to learn
    assert losses[-1] < 0.6 * losses[0], losses
    for before, after in zip(*map(jax.tree.leaves, (entry["batch_stats"], statistics)), strict=True):
        assert float(np.abs(before - np.asarray(after)).max()) > 1e-3
