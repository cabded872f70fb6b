"""Methods at odd sizes and ratios that are not whole: streams, rollouts, constants, weights that serve all."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import log1p
from essjax.frames import GBuffers, select_time
from essjax.methods import load, save
from essjax.rollout import alternate, every, unroll
from tests.helpers import make_frames, streamed

B, H, W = 1, 17, 30
SIZE = (45, 25)
"""959x541 by 1.5, a 32nd: 25 / 17 high, 45 / 30 wide."""
METHODS = {
    "bilinear": methods.bilinear,
    "bicubic": methods.bicubic,
    "jau": methods.jau,
    "taau": methods.taau,
    "taau-half": methods.taau_half,
    "nsrr": functools.partial(methods.nsrr, width=4),
    "fasset": functools.partial(methods.fasset, width=4, hidden=5),
    "extrass": functools.partial(methods.extrass, width=4, frnet_width=4),
}


def frames_of(seed, T):
    return make_frames(seed, T=T, B=B, H=H, W=W)


def busy(method, frames, seed=0):
    """Variables none of which is zero: every layer has its say."""
    shapes, rng = jax.eval_shape(method.init, jax.random.key(0), select_time(frames, 0)), np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(0.1 * rng.normal(size=leaf.shape), jnp.float32), shapes)


@pytest.mark.parametrize("name", METHODS)
def test_a_grey_world_stays_grey(name):
    """Untrained, in every frame, whatever the motion: nothing is darkened or brightened by a resampling."""
    frames = frames_of(0, 4)
    depth = jnp.minimum(frames.gbuffers.depth, 20.0)  # no sky: it is not demodulated
    texture = jnp.full_like(frames.gbuffers.base_color, 0.5)
    gbuffers = GBuffers(depth=depth, base_color=texture, normal=frames.gbuffers.normal)
    frames = dataclasses.replace(frames, color=jnp.full_like(frames.color, 0.4), gbuffers=gbuffers)
    method = METHODS[name](scale=SIZE)
    variables = method.init(jax.random.key(0), select_time(frames, 0))
    schedule = every() if method.info.renders_all else alternate(0)
    images = streamed(method, variables, frames, schedule.kinds(4))
    assert images.shape == (4, B, 25, 45, 3)
    np.testing.assert_allclose(images, 0.4, rtol=2e-3)


@pytest.mark.parametrize("name", ["taau-half", "extrass"])
def test_streaming_equals_the_rollout(name):
    frames = frames_of(1, 4)
    method = METHODS[name](scale=SIZE)
    variables = busy(method, frames) if name == "extrass" else method.init(jax.random.key(0), select_time(frames, 0))
    images = streamed(method, variables, frames, alternate(0).kinds(4))
    image = jax.jit(lambda v, f: unroll(method, v, f, alternate(0)).image)(variables, frames)
    np.testing.assert_allclose(log1p(image), log1p(images), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["nsrr", "fasset", "extrass"])
def test_one_set_of_variables_serves_every_ratio(name, tmp_path):
    frames = select_time(frames_of(2, 1), 0)
    shapes = [
        jax.tree.map(lambda leaf: leaf.shape, jax.eval_shape(METHODS[name](scale=s).init, jax.random.key(0), frames))
        for s in (2, 1.5, 4, SIZE)
    ]
    assert shapes[1:] == shapes[:-1]
    method = METHODS[name]()
    variables = busy(method, frames_of(2, 1))
    save(tmp_path / "weights.safetensors", method, variables)
    other, same = load(tmp_path / "weights.safetensors", scale=1.5)
    assert other.info.scale == 1.5 and other.info.name == method.info.name
    jax.tree.map(np.testing.assert_array_equal, same, variables)
