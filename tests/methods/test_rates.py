"""One rendered frame in k: streaming is unrolling, ages are counted, and the network is told how far away it is."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import log1p
from essjax.data import without_buffers
from essjax.frames import select_time, without_color
from essjax.methods._extrass import conditions_of
from essjax.methods.rendered import advance, push, start_memory
from essjax.rollout import SS, alternate, unroll
from tests.helpers import make_frames, random_image, streamed

H, W = 9, 14
LENGTH = 6


@functools.cache
def frames():
    return make_frames(3, T=LENGTH, B=1, H=H, W=W)


def busy(method):
    """Variables in which nothing is zero."""
    leaves, tree = jax.tree.flatten(method.init(jax.random.key(0), select_time(frames(), 0)))
    noise = [0.05 * random_image(n, *leaf.shape, low=-1.0, high=1.0) for n, leaf in enumerate(leaves)]
    return jax.tree.unflatten(tree, jax.tree.map(jnp.add, leaves, noise)) if len(leaves) > 2 else tree.unflatten(leaves)


@pytest.mark.parametrize("name", ["extrass", "taau_half"])
def test_streaming_equals_the_rollout_at_every_rate(name):
    method = {"extrass": methods.extrass(width=4, frnet_width=4), "taau_half": methods.taau_half()}[name]
    variables, images = busy(method), {}
    for period, phase in ((3, 1), (4, 0)):
        schedule = alternate(phase, period=period)
        unrolled = jax.jit(lambda v, f, schedule=schedule: unroll(method, v, f, schedule).image)(variables, frames())
        images[period] = streamed(method, variables, frames(), schedule.kinds(LENGTH))
        np.testing.assert_allclose(log1p(unrolled), log1p(images[period]), rtol=1e-3, atol=1e-3)
    assert np.abs(images[3][-1] - images[4][-1]).max() > 0.01  # the rate matters


def test_ages_count_from_each_rendered_frame():
    memory = start_memory(select_time(frames(), 0), jnp.zeros((1, H, W, 1)), 2)
    found = []
    for n, kind in enumerate(alternate(period=4).kinds(LENGTH)):
        memory = advance(memory, select_time(frames(), n))
        found.append(memory.frames.age[:, 0].tolist())
        if kind == SS:
            memory = push(memory, select_time(frames(), n), jnp.zeros((1, H, W, 1)))
    # At frame 1 ... 3 and 5: since frame 0 (or 4) and the one rendered before it, of which at first there is none.
    assert found[1:4] == [[1, 1], [2, 2], [3, 3]] and found[5] == [1, 5]


def test_what_the_network_is_told_is_zero_in_the_papers_setting():
    frame = select_time(frames(), 0)
    np.testing.assert_array_equal(conditions_of(frame, None, (2 * H, 2 * W)), [[0, 0, 0, 0]])
    np.testing.assert_array_equal(conditions_of(frame, jnp.array([1.0]), (2 * H, 2 * W)), [[0, 0, 0, 0]])
    poor = without_buffers(frame, ["base_color"])
    np.testing.assert_allclose(conditions_of(poor, jnp.array([3.0]), (4 * H, 4 * W)), [[1, 0, 1, 1]])
    np.testing.assert_allclose(conditions_of(without_buffers(frame, ["normal"]), None, (2 * H, 2 * W)), [[0, 1, 0, 0]])


@pytest.mark.parametrize("make", [methods.extrass, methods.extrass_e, methods.extrass_w])
def test_colour_depth_and_motion_are_enough(make):
    """Steps of the same variables keep their shapes; nothing else of a frame is needed."""
    poor = without_buffers(frames(), ["base_color", "normal", "roughness", "metallic", "specular", "world_position",
                                      "stencil", "n_dot_v"])  # fmt: skip
    method, frame = make(), select_time(poor, 0)
    assert method.info.requires == frozenset()
    rich = jax.eval_shape(method.init, jax.random.key(0), select_time(frames(), 0))
    variables = jax.eval_shape(method.init, jax.random.key(0), frame)
    assert jax.tree.map(lambda leaf: leaf.shape, rich) == jax.tree.map(lambda leaf: leaf.shape, variables)
    history = method.start(frame)
    for step, given in ((method.render_step, frame), (method.extrapolate_step, without_color(frame))):
        after, prediction = jax.eval_shape(step, variables, history, given)
        assert jax.tree.structure(after) == jax.tree.structure(history)
        assert prediction.image.shape == (1, H * int(method.info.scale), W * int(method.info.scale), 3)


def test_without_base_colour_colour_itself_is_warped():
    """A grey base colour that is the same everywhere changes neither shading nor guide."""
    still = dataclasses.replace(frames(), motion=jnp.zeros_like(frames().motion), jitter=jnp.zeros((LENGTH, 1, 2)))
    poor, method = without_buffers(still, ["base_color", "normal"]), methods.extrass_w()
    same = lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape)
    poor = dataclasses.replace(poor, gbuffers=jax.tree.map(same, poor.gbuffers), reactive=None)
    images = streamed(method, {}, poor, alternate(period=3).kinds(3))
    inside = np.isfinite(np.asarray(poor.gbuffers.depth[0, ..., 0]))
    # Nothing moves, so the best candidate is the pixel itself; the other three blend in by their distance in depth.
    np.testing.assert_array_equal(images[1], images[2])
    error = np.abs(images[1] - images[0]).mean(axis=-1)[inside]
    assert np.median(error) < 0.05


def test_unknown_buffers_are_refused():
    with pytest.raises(ValueError, match="without_buffers: expected some of base_color, .*, reactive, got depth"):
        without_buffers(frames(), ["depth"])
