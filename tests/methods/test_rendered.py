"""The memory of rendered frames: which frames it holds and where their paths lead, against brute force."""

import dataclasses

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

from essjax.color import demodulate
from essjax.frames import select_time, without_color
from essjax.methods.rendered import advance, albedo, push, push_pair, reset_memory, start_memory, start_pair
from tests.helpers import make_frames, random_image

T, B, H, W = 4, 2, 7, 10


def random_frames(seed):
    frames = make_frames(seed, T=T, B=B, H=H, W=W)
    return dataclasses.replace(frames, jitter=random_image(seed, T, B, 2, low=-0.5, high=0.5))  # another every frame


@jax.jit
def walk(frames):
    """Memories after each of four frames: rendered, extrapolated, rendered, extrapolated."""
    pair, memories = start_pair(select_time(frames, 0)), []
    for n in range(T):
        frame = select_time(frames, n)
        pair = advance(pair, frame)
        pair = push_pair(pair, frame) if n % 2 == 0 else pair
        memories.append(pair)
    return memories


def test_what_is_remembered():
    frames = random_frames(0)
    first, second, third, fourth = walk(frames)
    shading = demodulate(frames.color, albedo(frames.gbuffers))
    for memory in (first, second):  # one frame so far: the older one is the newest
        jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf[0], leaf[1]), memory.frames)
        np.testing.assert_allclose(memory.frames.content.shading[0], shading[0], rtol=1e-6)
        np.testing.assert_array_equal(memory.count, [1, 1])
    for memory in (third, fourth):
        np.testing.assert_allclose(memory.frames.content.shading, shading[jnp.array([2, 0])], rtol=1e-6)
        np.testing.assert_array_equal(
            memory.frames.content.guide[..., :3], frames.gbuffers.base_color[jnp.array([2, 0])]
        )
        np.testing.assert_array_equal(memory.frames.jitter, frames.jitter[jnp.array([2, 0])])
        np.testing.assert_array_equal(memory.count, [2, 2])
    np.testing.assert_array_equal(third.frames.motion[0], 0.0)
    np.testing.assert_array_equal(third.frames.valid[0], 1.0)
    for n, memory in enumerate((first, second, third, fourth)):
        np.testing.assert_array_equal(memory.jitter, frames.jitter[n])


def test_more_frames_and_other_contents():
    """Three places: rendered frames 0, 1, 3; a place that is still empty holds the oldest."""
    frames = random_frames(4)

    @jax.jit
    def run(frames):
        memory = start_memory(select_time(frames, 0), {"depth": jnp.zeros_like(frames.gbuffers.depth[0])}, 3)
        seen = []
        for n in range(T):
            frame = select_time(frames, n)
            memory = advance(memory, frame)
            memory = memory if n == 2 else push(memory, frame, {"depth": frame.gbuffers.depth})
            seen.append(memory)
        return seen

    for memory, held in zip(run(frames), ([0, 0, 0], [1, 0, 0], [1, 0, 0], [3, 1, 0]), strict=True):
        np.testing.assert_array_equal(memory.frames.content["depth"], frames.gbuffers.depth[jnp.array(held)])
        np.testing.assert_array_equal(memory.frames.jitter, frames.jitter[jnp.array(held)])
        assert memory.frames.motion.shape == (3, B, H, W, 2)
    np.testing.assert_array_equal(memory.frames.motion[0], 0.0)


def follow(motions, first, last):
    """Integer path from every pixel of frame ``last`` back to ``first``: total motion, and whether it stays inside."""
    total, inside = np.zeros((H, W, 2), int), np.ones((H, W), bool)
    for y in range(H):
        for x in range(W):
            column, row = x, y
            for n in range(last, first, -1):
                dx, dy = motions[n, row, column]
                column, row = column + dx, row + dy
                if not (0 <= column < W and 0 <= row < H):
                    inside[y, x] = False
                    break
            total[y, x] = column - x, row - y
    return total, inside


@settings(max_examples=8)
@given(seed=st.integers(0, 2**16))
def test_paths_equal_brute_force(seed):
    motions = np.random.default_rng(seed).integers(-2, 3, (T, B, H, W, 2))
    frames = random_frames(1)
    frames = dataclasses.replace(frames, motion=jnp.asarray(motions, jnp.float32), jitter=jnp.zeros_like(frames.jitter))
    memories = walk(frames)
    # last frame, slot -> the rendered frame that slot leads to
    for last, slot, first in [(1, 0, 0), (2, 1, 0), (3, 0, 2), (3, 1, 0)]:
        for b in range(B):
            total, inside = follow(motions[:, b], first, last)
            memory = memories[last].frames
            np.testing.assert_array_equal(memory.valid[slot, b, ..., 0], inside)
            np.testing.assert_allclose(np.asarray(memory.motion[slot, b])[inside], total[inside], atol=1e-5)
            assert inside.any() and not inside.all()


def test_jitter_moves_the_lookup_and_not_the_motion():
    """Motion that grows linearly over the image, where interpolation is exact: where it was read shows in its value."""
    frames = random_frames(2)
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    steady = np.broadcast_to([0.75, -0.5], (H, W, 2))
    growing = np.stack([0.1 * x - 0.2, 0.07 * y + 0.05 * x], axis=-1)
    motion = np.broadcast_to(np.stack([steady, steady, growing, steady])[:, None], (T, B, H, W, 2))
    frames = dataclasses.replace(frames, motion=jnp.asarray(motion, jnp.float32))
    memory = walk(frames)[-1].frames
    np.testing.assert_allclose(memory.motion[0], np.broadcast_to(steady, (B, H, W, 2)), atol=1e-6)
    jitter = np.asarray(frames.jitter)
    for b in range(B):
        first = 0.75 + jitter[3, b, 0] - jitter[2, b, 0], -0.5 + jitter[3, b, 1] - jitter[2, b, 1]
        at_x, at_y = x + first[0], y + first[1]
        expected = 2 * steady + np.stack([0.1 * at_x - 0.2, 0.07 * at_y + 0.05 * at_x], axis=-1)
        inside = (slice(2, -2), slice(2, -2))
        np.testing.assert_allclose(memory.motion[1, b][inside], expected[inside], atol=1e-5)


def test_reset_only_where_cut():
    frames = random_frames(3)
    memory, fresh = walk(frames)[-1], start_pair(without_color(select_time(frames, 3)))
    mixed = reset_memory(jnp.array([False, True]), fresh, memory)
    jax.tree.map(lambda new, old: np.testing.assert_array_equal(new[:, 0], old[:, 0]), mixed.frames, memory.frames)
    jax.tree.map(lambda new, old: np.testing.assert_array_equal(new[:, 1], old[:, 1]), mixed.frames, fresh.frames)
    np.testing.assert_array_equal(mixed.count, [2, 0])
    np.testing.assert_array_equal(fresh.frames.content.shading, 0.0)
