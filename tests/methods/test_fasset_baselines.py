"""FASSET's baselines: buffers at output size, NSRR on half of the frames, what ExtraNet+ sees."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import demodulate, log1p
from essjax.frames import select_time, without_color
from essjax.methods import extranet_nsrr, extranet_plus, nsrr, nsrr_extranet
from essjax.methods.fasset_baselines import enlarge
from essjax.methods.rendered import albedo
from essjax.rollout import ESS, SS
from essjax.warp import zero_upsample
from tests.helpers import make_frames, random_image

T, B, H, W = 3, 2, 9, 14
LARGE = 2 * H, 2 * W
FAST = {"xla_backend_optimization_level": 0}


def test_enlarged_frames_read_buffers_where_their_samples_lie():
    frame = select_time(make_frames(0, T=1, B=B, H=H, W=W), 0)
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    jitter = np.asarray(frame.jitter)
    ramps = np.stack([0.02 * (x + jx) + 0.03 * (y + jy) for jx, jy in jitter])[..., None]
    gbuffers = dataclasses.replace(frame.gbuffers, roughness=jnp.asarray(ramps, jnp.float32))
    motion = jnp.asarray(np.concatenate([ramps, -2 * ramps], axis=-1), jnp.float32)
    frame = dataclasses.replace(frame, gbuffers=gbuffers, motion=motion)
    color = random_image(1, B, 2 * H, 2 * W, 3)
    large = jax.jit(lambda f, c: enlarge(f, LARGE, c))(frame, color)
    wide, high = np.meshgrid((np.arange(2 * W) + 0.5) / 2, (np.arange(2 * H) + 0.5) / 2)
    inside = slice(3, -3)
    expected = np.broadcast_to((0.02 * wide + 0.03 * high)[inside, inside, None], (B, 2 * H - 6, 2 * W - 6, 1))
    np.testing.assert_allclose(large.gbuffers.roughness[:, inside, inside], expected, atol=1e-5)
    doubled = np.concatenate([2 * expected, -4 * expected], axis=-1)
    np.testing.assert_allclose(large.motion[:, inside, inside], doubled, atol=1e-5)
    for b in range(B):  # the LR pixel whose cell, moved by the jitter, holds the output pixel's centre
        column = np.clip(np.floor((np.arange(2 * W) + 0.5) / 2 - jitter[b, 0]), 0, W - 1).astype(int)
        row = np.clip(np.floor((np.arange(2 * H) + 0.5) / 2 - jitter[b, 1]), 0, H - 1).astype(int)
        for name in ("depth", "normal", "stencil"):  # +inf and integers stay what they are
            low, up = (np.asarray(getattr(g, name))[b] for g in (frame.gbuffers, large.gbuffers))
            np.testing.assert_array_equal(up, low[row][:, column])
    np.testing.assert_array_equal(large.color, color)
    assert float(jnp.abs(large.jitter).max()) == 0 and large.gbuffers.world_position is None and large.camera is None
    assert enlarge(frame, LARGE, None).color is None


@pytest.fixture(scope="module")
def halved():
    """NSRR on half of the frames: its steps on each kind of frame (an extrapolated one bare, or with a made colour)."""
    method = nsrr(scale=2, width=4, half=True)
    frames = make_frames(2, T=T, B=B, H=H, W=W)
    shapes = jax.eval_shape(method.init, jax.random.key(0), select_time(frames, 0))
    rng = np.random.default_rng(0)
    variables = jax.tree.map(lambda s: jnp.asarray(0.1 * rng.normal(size=s.shape), jnp.float32), shapes)
    jitted = lambda step: jax.jit(step, compiler_options=FAST)  # noqa: E731
    steps = {kind: jitted(step) for kind, step in ((SS, method.render_step), (ESS, method.extrapolate_step))}
    return method, variables, frames, steps


def test_nsrr_looks_back_at_rendered_frames_only(halved):
    method, variables, frames, steps = halved
    first, second, third = (select_time(frames, n) for n in range(T))
    history = steps[SS](variables, method.start(first), first)[0]
    passed, black = steps[ESS](variables, history, without_color(second))
    np.testing.assert_array_equal(black.image, 0.0)
    made, shown = steps[ESS](variables, history, second)
    for a, b in zip(jax.tree.leaves(passed), jax.tree.leaves(made), strict=True):
        np.testing.assert_array_equal(a, b)
    # The same frame, rendered: the same image, but it is remembered.
    remembered, rendered = steps[SS](variables, history, second)
    np.testing.assert_allclose(shown.image, rendered.image, rtol=1e-5, atol=1e-6)
    after = [steps[SS](variables, past, third)[1].image for past in (passed, remembered)]
    assert float(jnp.abs(after[0] - after[1]).max()) > 1e-3
    with pytest.raises(ValueError, match="nsrr: a rendered step needs the frame's colour, got None"):
        method.render_step(variables, history, without_color(second))


@pytest.mark.parametrize("method", [extranet_nsrr(width=4), nsrr_extranet(width=4), extranet_plus()],
                         ids=lambda method: method.info.name)  # fmt: skip
def test_frame_without_colour(method):
    bare = without_color(select_time(make_frames(3, T=1, B=B, H=H, W=W), 0))
    variables = jax.eval_shape(method.init, jax.random.key(0), bare)
    assert set(variables) == ({"extranet_plus"} if method.info.name == "extranet-plus" else {"extranet", "nsrr"})
    start = jax.eval_shape(method.start, bare)
    history, prediction = jax.eval_shape(method.extrapolate_step, variables, start, bare)
    assert prediction.image.shape == (B, 2 * H, 2 * W, 3) and method.info.scale == 2
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, history, start)))


def test_extranet_warps_what_nsrr_made(halved):
    """Nothing moves: the warped frame is NSRR's image, divided by upsampled base colour."""
    _, variables, frames, _ = halved
    frame = dataclasses.replace(select_time(frames, 0), motion=jnp.zeros_like(frames.motion[0]))
    method = nsrr_extranet(width=4)
    shapes = jax.eval_shape(method.init, jax.random.key(0), frame)["extranet"]
    everything = {**variables, "extranet": jax.tree.map(lambda s: jnp.zeros(s.shape), shapes)}

    def run(variables, frame):
        history, rendered = method.render_step(variables, method.start(frame), frame)
        after = dataclasses.replace(without_color(frame), cut=jnp.zeros_like(frame.cut))
        extrapolated = method.extrapolate_step(variables, history, after)[1]
        return rendered.image, extrapolated.aux["inputs"].warped  # without the image ExtraNet is not compiled

    image, warped = jax.jit(run, compiler_options=FAST)(everything, frame)
    assert image.shape == (B, 2 * H, 2 * W, 3) and float(image.std()) > 0.1
    expected = log1p(demodulate(image, albedo(enlarge(frame, LARGE, None).gbuffers)))
    np.testing.assert_allclose(warped[..., :3], expected, rtol=1e-4, atol=1e-4)


def test_extranet_plus_sees_samples_and_holes_between_them():
    frames = make_frames(4, T=2, B=B, H=H, W=W)
    first, second = (select_time(frames, n) for n in range(2))
    # Two walls; the near one on the right was before the far one.
    depth = jnp.broadcast_to(jnp.where(jnp.arange(W) < 9, 9.0, 5.0)[:, None], first.gbuffers.depth.shape)
    nothing = dict.fromkeys(("stencil", "world_position", "n_dot_v"))
    flat = jnp.zeros_like(first.color).at[..., 2].set(1.0)
    gbuffers = dataclasses.replace(first.gbuffers, depth=depth, normal=flat, **nothing)
    first = dataclasses.replace(first, gbuffers=gbuffers)
    steps = jnp.broadcast_to(jnp.array([1.0, -2.0]), second.motion.shape)  # LR pixels: 2 and -4 at output size
    second = dataclasses.replace(second, gbuffers=gbuffers, motion=steps)
    method = extranet_plus()

    @jax.jit
    def inputs(first, second):
        history = method.render_step({}, method.start(first), first)[0]
        variables = {"extranet_plus": jax.tree.map(lambda s: jnp.zeros(s.shape), shapes)}
        return method.extrapolate_step(variables, history, without_color(second))[1].aux["inputs"]

    shapes = jax.eval_shape(method.init, jax.random.key(0), first)["extranet_plus"]
    seen = inputs(first, second)
    shading = demodulate(first.color, albedo(gbuffers))
    sparse, known = (np.asarray(zero_upsample(x, LARGE, first.jitter)) for x in (shading, jnp.ones((B, H, W, 1))))
    assert known.mean() == 0.25
    y, x = np.mgrid[4 : 2 * H - 4, 4 : 2 * W - 4]
    at = (slice(None), y - 4, x + 2)
    here = (slice(None), y, x)
    np.testing.assert_allclose(np.asarray(seen.warped)[here][..., :3], np.log1p(sparse[at]), rtol=1e-5, atol=1e-6)
    there = np.asarray(enlarge(first, LARGE, None).gbuffers.depth)
    second_there = np.asarray(enlarge(second, LARGE, None).gbuffers.depth)
    same = there[:, y - 4, x + 2] == second_there[:, y, x]
    np.testing.assert_array_equal(np.asarray(seen.mask)[here], known[at] * same)
    assert 0.02 < np.mean(~same) < 0.5
    np.testing.assert_array_equal(np.asarray(seen.history)[0][here][..., 3:], np.asarray(seen.mask)[here])
    np.testing.assert_array_equal(seen.history[0][..., :3], seen.warped[..., :3])
    assert seen.warped.shape[-1] == 6 and seen.history.shape[-1] == 4
