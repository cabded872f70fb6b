"""NSRR: where previous frames are read, how far it looks back, and the baseline that it starts from."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import display
from essjax.frames import select_time
from essjax.methods import jau, nsrr
from essjax.methods._nsrr import warp_previous
from essjax.methods.rendered import advance
from essjax.rollout import alternate, every, unroll
from tests.helpers import make_frames, random_image, streamed

T, B, H, W = 7, 2, 9, 13
METHOD = nsrr(scale=2, width=4)


def frames_of(seed, length=T):
    return make_frames(seed, T=length, B=B, H=H, W=W)


@pytest.fixture(scope="module")
def untrained():
    return METHOD.init(jax.random.key(0), select_time(frames_of(0), 0))


@pytest.fixture(scope="module")
def busy(untrained):
    """Variables none of which is zero."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: leaf + jnp.asarray(0.1 * rng.normal(size=leaf.shape), jnp.float32), untrained)


@functools.cache
def rollout():
    return jax.jit(lambda variables, frames: unroll(METHOD, variables, frames, every()))


def test_untrained_it_is_the_upsampled_frame(untrained):
    frames = frames_of(1)
    expected = unroll(jau(scale=2), {}, frames, every()).image
    np.testing.assert_allclose(rollout()(untrained, frames).image, expected, rtol=2e-3, atol=1e-4)


def test_streaming_equals_the_rollout(busy):
    frames = frames_of(2)
    image = rollout()(busy, frames).image
    assert image.shape == (T, B, 2 * H, 2 * W, 3) and float(image.min()) >= 0
    np.testing.assert_allclose(display(image), display(streamed(METHOD, busy, frames, every().kinds(T))), atol=1e-4)


def test_previous_frames_are_read_along_their_paths(busy):
    """The picture moves by half LR pixels, another step each frame: whole HR pixels, so that reads are exact."""
    steps = np.array([(0, 0), (3, 2), (2, -1), (0.5, 1.5), (-1, 0.5), (1.5, 1), (-0.5, -1.5), (1, 1)])
    frames = frames_of(3, T + 1)
    motion = jnp.broadcast_to(jnp.asarray(steps[:, None, None, None], jnp.float32), frames.motion.shape)
    frames = dataclasses.replace(frames, motion=motion)
    history, last = rollout()(busy, select_time(frames, slice(0, T))).history, select_time(frames, T)
    look_back = jax.jit(lambda memory, frame: warp_previous(advance(memory, frame), frame, (2 * H, 2 * W)))
    got = np.asarray(look_back(history.rendered, last))
    color, jitter = np.asarray(display(frames.color)), np.asarray(frames.jitter)
    y, x = np.mgrid[: 2 * H, : 2 * W]
    for k in range(4):
        n = T - 1 - k
        dx, dy = (2 * steps[n + 1 :].sum(axis=0)).astype(int)
        inside = (y + dy >= 0) & (y + dy < 2 * H) & (x + dx >= 0) & (x + dx < 2 * W)
        for b in range(B):
            large = np.zeros((2 * H, 2 * W, 3))
            offset = np.floor((jitter[n, b] + 0.5) * 2).astype(int)
            large[offset[1] :: 2, offset[0] :: 2] = color[n, b]
            there = large[np.clip(y + dy, 0, 2 * H - 1), np.clip(x + dx, 0, 2 * W - 1)]
            np.testing.assert_allclose(got[k, b, ..., :3], there * inside[..., None], atol=1e-4)
            assert 0.05 < inside.mean() < 1


def test_it_looks_back_four_frames(busy):
    frames = dataclasses.replace(frames_of(4), motion=jnp.zeros((T, B, H, W, 2)))
    image = rollout()(busy, frames).image
    other = dataclasses.replace(frames, color=frames.color.at[1].add(1.0))
    change = jnp.abs(display(rollout()(busy, other).image) - display(image)).max(axis=(1, 2, 3, 4))
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(change) > 0), [1, 2, 3, 4, 5])


def test_history_ends_at_a_cut_and_elements_are_independent(busy):
    frames = frames_of(5)
    frames = dataclasses.replace(frames, cut=frames.cut.at[3, 0].set(True))
    depth = frames.gbuffers.depth.at[:3].multiply(1.7)
    changed = dataclasses.replace(
        frames, color=frames.color.at[:3].multiply(1.5), gbuffers=dataclasses.replace(frames.gbuffers, depth=depth)
    )
    image, other = (display(rollout()(busy, f).image) for f in (frames, changed))
    np.testing.assert_array_equal(other[3:, 0], image[3:, 0])
    assert float(jnp.abs(other[3:, 1] - image[3:, 1]).max(axis=(1, 2, 3)).min()) > 1e-3
    neighbour = dataclasses.replace(frames, color=frames.color.at[:, 1].set(random_image(6, T, H, W, 3)))
    apart = display(rollout()(busy, neighbour).image)
    np.testing.assert_allclose(apart[:, 0], image[:, 0], atol=1e-5)


def test_it_cannot_extrapolate(untrained):
    with pytest.raises(ValueError, match=re.escape("nsrr cannot extrapolate: it needs the colour of every frame")):
        unroll(METHOD, untrained, frames_of(0), alternate(0))
