"""Interpolation: which frame is shown when, and the classical methods on worlds whose middle frame is known."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.cameras import pixel_positions
from essjax.frames import select_time, without_color
from essjax.methods import bsr, warp_3d
from essjax.methods.interpolation import Pair, Seen, forward_motion, interpolator
from essjax.rollout import ESS, SS, alternate, every, unroll
from essjax.warp import compose_motion
from tests.helpers import make_frames, random_image, streamed

T, B, H, W = 7, 2, 11, 16


def _mean(variables, pair, train):
    """A mean that knows which frame is which, and shows jitter and motion of what it was given."""
    image = 0.25 * pair.earlier.color + 0.75 * pair.later.color
    return image, {"jitter": jnp.stack([pair.jitter_earlier, pair.jitter, pair.jitter_later]), "motion": pair.motion}


TOY = interpolator("toy", _mean)


@functools.cache
def rollout(schedule):
    return jax.jit(lambda frames: unroll(TOY, {}, frames, schedule, keep=lambda aux: aux))


EVEN, ODD, EVERY = alternate(0), alternate(1), every()


@pytest.mark.parametrize("schedule", [EVEN, ODD], ids=["even", "odd"])
def test_rendered_frames_are_shown_and_the_others_interpolated(schedule):
    frames = make_frames(1, T=T, B=B, H=H, W=W)
    kinds = schedule.kinds(T)
    hidden = jnp.array([n for n in range(T) if kinds[n] == ESS])
    result = rollout(schedule)(dataclasses.replace(frames, color=frames.color.at[hidden].set(jnp.nan)))
    color = np.asarray(frames.color)
    for n in range(T - 1):  # the last step shows frame T - 2
        expected = color[n] if kinds[n] == SS else 0.25 * color[n - 1] + 0.75 * color[n + 1]
        np.testing.assert_allclose(result.image[n], expected, rtol=1e-6)
    rendered = [n for n in range(T) if kinds[n] == SS]
    for k, n in enumerate(rendered[1:], start=1):
        if kinds[n - 1] == ESS:
            np.testing.assert_array_equal(result.aux[SS]["jitter"][k], frames.jitter[n - 2 : n + 1])
            path = compose_motion(
                frames.motion[n], frames.motion[n - 1], jitter=frames.jitter[n], jitter_previous=frames.jitter[n - 1]
            )[0]
            np.testing.assert_allclose(result.aux[SS]["motion"][k], path, atol=1e-5)


def test_streams_and_frames_that_have_no_neighbour():
    """SS SS ESS ESS SS | ESS SS ESS | SS: rendered in a row, extrapolated in a row, and two cuts in element 0."""
    frames = make_frames(2, T=9, B=B, H=H, W=W)
    frames = dataclasses.replace(frames, cut=frames.cut.at[jnp.array([5, 8]), 0].set(True))
    kinds = (SS, SS, ESS, ESS, SS, ESS, SS, ESS, SS)
    images, color = np.asarray(streamed(TOY, {}, frames, kinds)), np.asarray(frames.color)
    halfway = lambda a, b: 0.25 * color[a] + 0.75 * color[b]
    # Step n shows frame n - 1. Of frames 2 and 3 the first repeats frame 1.
    for step, expected in (
        (1, color[0]),
        (2, color[1]),
        (3, color[1]),
        (4, halfway(1, 4)),
        (5, color[4]),
        (7, color[6]),
    ):
        np.testing.assert_allclose(images[step], expected, rtol=1e-6)
    np.testing.assert_allclose(images[6, 1], halfway(4, 6)[1], rtol=1e-6)
    np.testing.assert_allclose(images[6, 0], color[6, 0])  # frame 5 follows a cut: nothing before it
    np.testing.assert_allclose(images[8, 1], halfway(6, 8)[1], rtol=1e-6)
    np.testing.assert_allclose(images[8, 0], color[6, 0])  # frame 7 ends a shot: nothing after it
    np.testing.assert_allclose(rollout(EVERY)(frames).image[:-1], color[:-1])


# --- Worlds with known answers ---------------------------------------------------------------------------------------

METHODS = {"3d-warp": warp_3d(), "bsr": bsr()}
both = pytest.mark.parametrize("name", METHODS)


@functools.cache
def middle(name):
    """The second of three frames, by the three steps of an alternation."""
    method = METHODS[name]

    @jax.jit
    def run(frames):
        first, second, third = (select_time(frames, n) for n in range(3))
        history, _ = method.render_step({}, method.start(first), first)
        history, _ = method.extrapolate_step({}, history, without_color(second))
        return method.render_step({}, history, third)[1].image

    return run


def plain_frames(color, motion, depth, jitter):
    """Three frames of everything; other buffers are absent."""
    frames = make_frames(0, T=3, B=B, H=H, W=W)
    buffers = dataclasses.replace(
        frames.gbuffers, **dict.fromkeys(("base_color", "normal", "world_position", "stencil", "n_dot_v")), depth=depth
    )
    return dataclasses.replace(frames, color=color, motion=motion, gbuffers=buffers, jitter=jitter)


@both
def test_a_ramp_that_moves_evenly(name):
    """Bilinear reads of a ramp are exact, so that half a motion and every jitter must be right; elements differ."""
    velocity = np.array([[0.7, -0.4], [-0.6, 0.8]])  # per frame, what motion vectors point back along
    jitter = np.array([[[0.1, -0.3], [0.4, 0.2]], [[-0.2, 0.3], [0.1, 0.4]], [[0.3, 0.2], [-0.4, -0.1]]])
    slope = np.array([[0.05, 0.02], [0.03, -0.04], [0.01, 0.06]])
    at = np.asarray(pixel_positions(H, W))[None, None] + jitter[:, :, None, None]
    at = at - velocity[:, None, None] * np.arange(3).reshape(3, 1, 1, 1, 1)
    color = jnp.asarray(1.0 + at @ slope.T, jnp.float32)
    motion = jnp.broadcast_to(jnp.asarray(-velocity[:, None, None], jnp.float32), (3, B, H, W, 2))
    frames = plain_frames(color, motion, jnp.full((3, B, H, W, 1), 4.0), jnp.asarray(jitter, jnp.float32))
    image = middle(name)(frames)
    inside = (slice(None), slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(image[inside], color[1][inside], atol=1e-4)


def layers(n, motion_of_the_object=2):
    """A textured square at depth 2 that moves right by 2 pixels per frame, before a resting wall at depth 5."""
    wall, paint = (np.asarray(random_image(seed, B, H, W, 3)) for seed in (7, 8))
    left = 3 + motion_of_the_object * n
    mask = np.zeros((B, H, W, 1), bool)
    mask[:, 3:8, left : left + 4] = True
    color = np.where(mask, np.roll(paint, left, axis=2), wall)
    motion = np.where(mask, [-float(motion_of_the_object), 0.0], 0.0)
    return color, motion, np.where(mask, 2.0, 5.0), mask


def moving_object():
    color, motion, depth, mask = (np.stack(parts) for parts in zip(*(layers(n) for n in range(3)), strict=True))
    arrays = (jnp.asarray(array, jnp.float32) for array in (color, motion, depth))
    return plain_frames(*arrays, jnp.zeros((3, B, 2))), mask


@both
def test_a_moving_object_hides_and_uncovers_the_wall(name):
    frames, mask = moving_object()
    image = middle(name)(frames)
    right = np.abs(np.asarray(image - frames.color[1])).max(axis=-1) < 1e-4
    right = right[:, 1:-1, 1:-1]
    if name == "3d-warp":  # every surface is visible in one of the frames
        assert right.all()
    else:  # the search misses some pixels at the object's border, and nothing else
        assert right.mean() > 0.93 and right[mask[1, :, 1:-1, 1:-1, 0]].mean() > 0.8


def test_forward_motion():
    frames, mask = moving_object()
    first, last = (select_time(frames, n) for n in (0, 2))
    keep = lambda frame: Seen(color=frame.color, depth=frame.gbuffers.depth, motion=frame.motion)
    path, _ = compose_motion(frames.motion[2], frames.motion[1])
    still = jnp.zeros((B, 2))
    pair = Pair(
        earlier=keep(first), later=keep(last), jitter_earlier=still, jitter=still, jitter_later=still, motion=path
    )
    motion = jax.jit(forward_motion)(pair)
    hidden = mask[2] & ~mask[0]  # wall that the object covers later: it continues to rest
    assert hidden.any()
    np.testing.assert_allclose(motion, np.where(mask[0], [4.0, 0.0], 0.0), atol=1e-5)


@both
def test_sky_and_noise_stay_finite_and_elements_apart(name):
    frames, others = (make_frames(seed, T=3, B=B, H=H, W=W, sky=sky) for seed, sky in ((3, 0.5), (4, 0.1)))
    frames, others = (plain_frames(f.color, f.motion, f.gbuffers.depth, f.jitter) for f in (frames, others))
    image = middle(name)(frames)
    assert bool(jnp.isfinite(image).all()) and float(image.min()) >= 0.0
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    np.testing.assert_allclose(middle(name)(mixed)[0], image[0], rtol=1e-5, atol=1e-6)


def test_bsr_needs_an_iteration():
    with pytest.raises(ValueError, match="iterations: expected at least 1, got 0"):
        bsr(iterations=0)
