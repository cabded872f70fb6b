"""Two methods in a row: the second sees every image of the first as a rendered frame, with that frame's buffers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import log1p
from essjax.frames import Prediction, select_time
from essjax.interfaces import Method, MethodInfo, no_variables
from essjax.methods import composed, extranet, ifrnet, jau, settled, taa, warp, with_taa
from essjax.rollout import alternate, every, unroll
from tests.helpers import make_frames

T, B, H, W = 4, 2, 9, 14


def test_taa_of_warped_frames_equals_one_after_the_other():
    frames = make_frames(0, T=T, B=B, H=H, W=W)
    method = composed("warp+taa", warp(), settled(taa(alpha=0.3, sigma=0.6)), native=True)
    assert method.init(jax.random.key(0), select_time(frames, 0)) == {}
    both = jax.jit(lambda frames: unroll(method, {}, frames, alternate(0)).image)(frames)

    @jax.jit
    def in_turn(frames):
        colors = unroll(warp(), {}, frames, alternate(0)).image
        settings = {"alpha": jnp.float32(0.3), "sigma": jnp.float32(0.6)}
        return unroll(taa(), settings, dataclasses.replace(frames, color=colors), every()).image

    np.testing.assert_allclose(log1p(both), log1p(in_turn(frames)), rtol=1e-4, atol=1e-5)


def lagging(latency):
    """Returns the colour of ``latency`` frames ago; its history are those colours."""

    def start(example):
        return jnp.zeros((latency, *example.motion.shape[:-1], 3))

    def step(variables, history, frame, *, train=False):
        seen = jnp.concatenate([history, frame.color[None]])
        return seen[1:], Prediction(image=seen[0] * variables["gain"], state={"late": latency} if train else {})

    info = MethodInfo("lagging", 1, latency=latency, requires=frozenset({"normal"}), predicts=frozenset({"ess"}))
    return Method(lambda key, example: {"gain": 2.0}, start, step, step, info)


def watching():
    """Its image is twice the size: colour and the frame's motion; it counts its frames."""

    def start(example):
        return jnp.zeros(())

    def step(variables, history, frame, *, train=False):
        image = frame.color.at[..., :2].add(frame.motion) + variables["bias"]
        image = jnp.repeat(jnp.repeat(image, 2, axis=-3), 2, axis=-2)
        return history + 1, Prediction(image=image, aux={"count": history}, state={"watch": 0} if train else {})

    return Method(lambda key, example: {"bias": 0.5}, start, step, step, MethodInfo("watching", 2))


@pytest.mark.parametrize("late", [0, 1])
def test_the_second_sees_the_frame_that_the_image_belongs_to(late):
    frames = make_frames(1, T=3, B=B, H=4, W=5)
    method = composed("late", lagging(late), watching())
    assert method.info == MethodInfo("late", 2, latency=late, requires=frozenset({"normal"}))
    variables = method.init(jax.random.key(0), select_time(frames, 0))
    assert variables == {"gain": 2.0, "bias": 0.5}
    history = method.start(select_time(frames, 0))
    for n in range(3):
        history, prediction = method.render_step(variables, history, select_time(frames, n), train=n == 2)
        assert float(prediction.aux["count"]) == n
        if n >= late:
            expected = 2.0 * frames.color[n - late] + 0.5
            expected = expected.at[..., :2].add(frames.motion[n - late])
            np.testing.assert_allclose(prediction.image[:, ::2, 1::2], expected, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(prediction.aux["first"].image, 2.0 * frames.color[n - late])
    assert prediction.state == {"late": late, "watch": 0}
    with pytest.raises(ValueError, match="late: expected a first method that lags by at most 1 frame, got 2"):
        composed("late", lagging(2), watching())


@pytest.mark.parametrize("first", [extranet(), ifrnet(width=8)], ids=lambda method: method.info.name)
def test_with_taa_it_has_the_variables_of_the_first(first):
    frames = make_frames(2, T=1, B=B, H=H, W=W)
    method, frame = with_taa(first), select_time(frames, 0)
    assert method.info.name == f"{first.info.name}+taa" and method.info.latency == first.info.latency
    assert method.info.native and method.info.scale == 1 and method.info.predicts == {"ss", "ess"}
    assert method.info.requires == first.info.requires
    shapes = [jax.eval_shape(m.init, jax.random.key(0), frame) for m in (method, first)]
    assert jax.tree.structure(shapes[0]) == jax.tree.structure(shapes[1])
    bare = dataclasses.replace(frame, color=None)
    history = jax.eval_shape(method.start, bare)
    later, prediction = jax.eval_shape(method.extrapolate_step, shapes[0], history, bare)
    alone = jax.eval_shape(first.extrapolate_step, shapes[1], first.start(bare), bare)[1]
    assert prediction.image.shape == (B, H, W, 3) and set(prediction.aux["first"].aux) == set(alone.aux)
    assert jax.tree.map(jnp.shape, later) == jax.tree.map(jnp.shape, history)


def test_taa_needs_frames_of_one_size():
    with pytest.raises(ValueError, match="with_taa: expected a method of scale 1, got jau of x2"):
        with_taa(jau(scale=2))


def test_settled_needs_no_variables():
    assert settled(taa()).init is no_variables
