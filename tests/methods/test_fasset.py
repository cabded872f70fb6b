"""FASSET: any output size without a shift, what a step may read, where the hidden state comes from."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import scenes
from essjax.color import log1p
from essjax.frames import GBuffers, select_time
from essjax.methods import fasset, gaussian_blur
from essjax.methods._fasset import sample_nearness
from essjax.methods.rendered import albedo
from essjax.networks._fasset import OUTPUT_GAIN
from essjax.rollout import ESS, SS, alternate, stream_step, unroll
from essjax.scenes.render import render_reference
from essjax.warp import hole_mask, jitter_aligned_upsample
from tests.helpers import indices_of, make_frames, random_image, streamed

T, B, H, W = 4, 2, 30, 40
TINY = {"width": 4, "hidden": 5}
FAST = {"xla_backend_optimization_level": 0}
"""Compiles in half the time."""
METHOD = fasset(scale=1.5, **TINY)


def random_frames(seed=0, T=T):
    """Random frames with surfaces close enough that some history is valid."""
    frames = make_frames(seed, T=T, B=B, H=H, W=W)
    sky = ~jnp.isfinite(frames.gbuffers.depth)
    depth = jnp.where(sky, jnp.inf, random_image(seed + 1, T, B, H, W, 1, low=5.0, high=5.3))
    gbuffers = GBuffers(
        base_color=frames.gbuffers.base_color, normal=jnp.zeros_like(frames.gbuffers.normal), depth=depth
    )
    return dataclasses.replace(frames, gbuffers=gbuffers, camera=None)


@pytest.fixture(scope="module")
def busy():
    """Variables none of which is zero: every layer has its say. Made without compiling ``init``."""
    shapes = jax.eval_shape(METHOD.init, jax.random.key(0), select_time(random_frames(), 0))
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        noise = jnp.asarray(0.3 * rng.normal(size=leaf.shape), jnp.float32)
        return 1.0 + jnp.abs(noise) if path[-1].key == "var" else noise

    variables = jax.tree_util.tree_map_with_path(draw, shapes)
    last = variables["fasset"]["params"]["inr"]["Dense_3"]
    gain = jnp.array([1.0] + [1.0 / OUTPUT_GAIN] * 3)
    last.update({name: value * gain for name, value in last.items()})
    return variables


@pytest.fixture(scope="module")
def untrained(busy):
    """As ``init`` leaves it: RenderINR's last layer is zero (tests/networks/test_fasset.py)."""
    variables = jax.tree.map(jnp.copy, busy)
    last = variables["fasset"]["params"]["inr"]["Dense_3"]
    last.update({name: 0.0 * value for name, value in last.items()})
    return variables


step = functools.partial(stream_step, METHOD, compiler_options=FAST)
images_of = functools.partial(streamed, METHOD, compiler_options=FAST)


# --- Any output size -------------------------------------------------------------------------------------------------


SCALES = (1.5, 2, 3.3)


@functools.cache
def upscalers():
    """``(variables, frame) -> images`` (log1p) of a rendered frame without history, one per scale."""
    methods = [fasset(scale=scale, **TINY) for scale in SCALES]

    def run(variables, frame):
        return [log1p(m.render_step(variables, m.start(frame), frame)[1].image) for m in methods]

    return jax.jit(run, compiler_options=FAST)


def ramp(positions_x, positions_y):
    """log1p of a colour that is linear in x and y, another slope in each channel."""
    slopes = np.array([[0.03, -0.02], [-0.01, 0.04], [0.05, 0.01]])
    return 1.0 + positions_x[..., None] * slopes[:, 0] + positions_y[..., None] * slopes[:, 1]


def test_untrained_network_reproduces_a_ramp_at_any_scale(untrained):
    """Samples of a ramp, interpolated where they were taken, are the ramp at the output's pixel centres."""
    frame = select_time(random_frames(), 0)
    jitter = np.array([[0.31, -0.44], [-0.27, 0.12]])
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    color = np.expm1(np.stack([ramp(x + jx, y + jy) for jx, jy in jitter]))
    frame = dataclasses.replace(frame, color=jnp.asarray(color, jnp.float32), jitter=jnp.asarray(jitter, jnp.float32))
    for scale, image in zip(SCALES, upscalers()(untrained, frame), strict=True):
        height, width = round(H * scale), round(W * scale)
        assert image.shape == (B, height, width, 3)
        expected = ramp(*np.meshgrid((np.arange(width) + 0.5) / scale, (np.arange(height) + 0.5) / scale))
        margin = round(scale) + 1  # the border repeats
        inside = (slice(None), slice(margin, -margin), slice(margin, -margin))
        np.testing.assert_allclose(image[inside], np.broadcast_to(expected, image.shape)[inside], atol=1e-4)


def shift_between(image, reference, scale):
    """Shift (x, y) in LR pixels for which ``image(p) = reference(p + shift)`` fits best (Lucas and Kanade 1981).

    Both are blurred by an LR pixel: the method is for images that are linear over the shift.
    """
    image, reference = (np.asarray(gaussian_blur(jnp.asarray(x), float(scale))) for x in (image, reference))
    gy, gx = np.gradient(reference, axis=(0, 1))
    margin = round(5 * scale)
    inside = slice(margin, -margin), slice(margin, -margin)
    gradients = np.stack([gx[inside].ravel(), gy[inside].ravel()], axis=-1)
    return np.linalg.lstsq(gradients, (image - reference)[inside].ravel(), rcond=None)[0] / scale


def test_no_shift_against_references_rendered_at_each_scale(untrained):
    world = scenes.make_scene("grille", 3, 2).at(1)
    rendered = lambda scale: render_reference(world, round(W * scale), round(H * scale), spp=16)  # noqa: E731
    frame = select_time(random_frames(), 0)
    frame = dataclasses.replace(frame, color=jnp.broadcast_to(rendered(1), frame.color.shape))
    # The second image says that its samples lie a quarter of a pixel to the right and below of where they do.
    frame = dataclasses.replace(frame, jitter=jnp.array([[0.0, 0.0], [0.25, 0.25]]))
    for scale, images in zip(SCALES, upscalers()(untrained, frame), strict=True):
        reference = np.log1p(rendered(scale))
        np.testing.assert_allclose(shift_between(images[0], reference, scale), 0.0, atol=0.1)
        np.testing.assert_allclose(shift_between(images[1], reference, scale), -0.25, atol=0.1)


# --- Rollouts --------------------------------------------------------------------------------------------------------


@functools.cache
def rollout():
    """Renders 0, 2 and extrapolates 1, 3."""
    run = lambda variables, frames: unroll(METHOD, variables, frames, alternate(0)).image  # noqa: E731
    return jax.jit(run, compiler_options=FAST)


def test_streaming_equals_the_rollout(busy):
    frames = random_frames(0)
    images = images_of(busy, frames, alternate(0).kinds(T))
    image = rollout()(busy, frames)
    assert image.shape == (T, B, 45, 60, 3)
    np.testing.assert_allclose(log1p(image), log1p(images), rtol=1e-3, atol=1e-3)
    assert bool(jnp.all(jnp.isfinite(image))) and float(image.min()) >= 0.0


def test_colour_of_extrapolated_frames_is_never_read(busy):
    frames = random_frames(1)
    hidden = indices_of(alternate(0).kinds(T), ESS)
    poisoned = dataclasses.replace(frames, color=frames.color.at[jnp.array(hidden)].set(jnp.nan))
    np.testing.assert_array_equal(rollout()(busy, poisoned), rollout()(busy, frames))


def test_causal(busy):
    frames = random_frames(2)
    image = rollout()(busy, frames)
    for n in (2, 3):
        future = jax.tree.map(
            lambda leaf, n=n: leaf.at[n:].set(leaf[n:][:, ::-1]) if leaf.dtype == jnp.float32 else leaf, frames
        )
        other = rollout()(busy, future)
        np.testing.assert_array_equal(other[:n], image[:n])
        assert float(jnp.abs(other[n] - image[n]).max()) > 0.01


def test_history_ends_at_a_cut(busy):
    frames = random_frames(3)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True))
    before = jax.tree.map(lambda leaf: leaf.at[:2].set(leaf[:2][:, ::-1]), frames.gbuffers)
    changed = dataclasses.replace(frames, gbuffers=before, color=frames.color.at[:2].multiply(1.5))
    image, other = rollout()(busy, frames), rollout()(busy, changed)
    np.testing.assert_array_equal(other[2:, 0], image[2:, 0])
    assert float(jnp.abs(other[2:, 1] - image[2:, 1]).max(axis=(1, 2, 3)).min()) > 1e-3  # no cut there
    started = images_of(busy, select_time(frames, slice(2, 4)), (SS, ESS))
    np.testing.assert_allclose(log1p(image[2:, 0]), log1p(started[:, 0]), rtol=1e-3, atol=1e-3)


def test_batch_elements_are_independent(busy):
    frames, others = random_frames(5), random_frames(6)
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    image, other = rollout()(busy, frames), rollout()(busy, mixed)
    np.testing.assert_allclose(log1p(other[:, 0]), log1p(image[:, 0]), rtol=1e-4, atol=1e-4)
    assert float(jnp.abs(other[:, 1] - image[:, 1]).max()) > 0.1


# --- Masks and the hidden state --------------------------------------------------------------------------------------


def after_first(busy, frames):
    """The history after frame 0 was rendered."""
    first = select_time(frames, 0)
    return step(SS)(busy, METHOD.start(first), first)[0]


def hidden_state(history):
    return history.inner.rendered.frames.content.hidden[0]


def copy(history):
    """Streaming donates what it is given."""
    return jax.tree.map(jnp.copy, history)


def test_holes_of_the_warped_previous_frame_are_cut_from_rendered_frames(busy):
    frames = random_frames(7)
    first, second = select_time(frames, 0), select_time(frames, 1)
    mask = hole_mask(second.gbuffers, first.gbuffers, second.motion, jitter=second.jitter, jitter_previous=first.jitter)
    assert 0.05 < float(mask.mean()) < 0.95
    filled = dataclasses.replace(second, color=jnp.where(mask > 0, second.color, 7.0))
    history, render = after_first(busy, frames), step(SS)
    np.testing.assert_array_equal(render(busy, copy(history), filled)[1], render(busy, copy(history), second)[1])
    whole = fasset(scale=1.5, mask_rendered=False, **TINY)
    assert whole.info.name == "fasset-no-mask"
    masks = jax.jit(lambda *given: {k: whole.render_step(*given)[1].aux[k] for k in ("mask", "valid")})
    aux = masks(busy, history, second)  # without the image no network is compiled
    np.testing.assert_array_equal(aux["valid"], mask)
    np.testing.assert_array_equal(aux["mask"], 1.0)


def test_only_rendered_frames_update_the_hidden_state(busy):
    frames = random_frames(8)
    history = after_first(busy, frames)
    before = np.asarray(hidden_state(history))
    assert np.abs(before).max() > 0.01
    extrapolated, image = step(ESS)(busy, copy(history), select_time(frames, 1))
    np.testing.assert_array_equal(hidden_state(extrapolated), before)
    emptied = copy(history)
    frames_kept = emptied.inner.rendered.frames
    content = dataclasses.replace(frames_kept.content, hidden=jnp.zeros_like(frames_kept.content.hidden))
    kept = dataclasses.replace(emptied.inner.rendered, frames=dataclasses.replace(frames_kept, content=content))
    emptied = dataclasses.replace(emptied, inner=dataclasses.replace(emptied.inner, rendered=kept))
    _, other = step(ESS)(busy, emptied, select_time(frames, 1))
    assert float(jnp.abs(image - other).max()) > 1e-4  # but it is read


@pytest.mark.parametrize("kinds", [(SS, SS), (SS, ESS, SS)], ids=["each", "over an extrapolated frame"])
def test_the_hidden_state_follows_the_motion(busy, kinds):
    """The same frames with the first one shifted, and the motion that undoes it: the recurrent state does not see it.

    It depends on convolutions at input size only, so a shift by any whole pixels is exact away from the border.
    """
    frames = random_frames(9, T=len(kinds))
    flat = GBuffers(
        base_color=frames.gbuffers.base_color,
        normal=jnp.zeros_like(frames.gbuffers.normal),
        depth=jnp.full_like(frames.gbuffers.depth, 5.0),
    )
    frames = dataclasses.replace(
        frames, gbuffers=flat, motion=jnp.zeros_like(frames.motion), jitter=jnp.full_like(frames.jitter, 0.2)
    )
    dx, dy = 3, -2
    first = jnp.roll(frames.color[0], (dy, dx), axis=(1, 2))
    steps = jnp.zeros_like(frames.motion).at[-1].set(jnp.array([dx, dy], jnp.float32))
    moved = dataclasses.replace(frames, color=frames.color.at[0].set(first), motion=steps)
    states = []
    for clip in (frames, moved):
        history = METHOD.start(select_time(clip, 0))
        for n, kind in enumerate(kinds):
            history, _ = step(kind)(busy, history, select_time(clip, n))
        states.append(np.asarray(hidden_state(history))[:, 9:-9, 9:-9])
    np.testing.assert_allclose(states[1], states[0], rtol=1e-3, atol=1e-4)
    alone = after_first(busy, dataclasses.replace(select_time(frames, slice(-1, None)), cut=jnp.ones((1, B), bool)))
    assert np.abs(np.asarray(hidden_state(alone))[:, 9:-9, 9:-9] - states[0]).max() > 1e-3  # it has a memory at all


def without_motion(frames):
    """One flat surface that stands still, seen at each frame's own jitter."""
    gbuffers = GBuffers(
        base_color=frames.gbuffers.base_color,
        normal=jnp.zeros_like(frames.gbuffers.normal),
        depth=jnp.full_like(frames.gbuffers.depth, 5.0),
    )
    jitter = random_image(20, *frames.jitter.shape, low=-0.5, high=0.5)
    return dataclasses.replace(frames, gbuffers=gbuffers, motion=jnp.zeros_like(frames.motion), jitter=jitter)


def with_layer(variables, path, **leaves):
    """A copy of the variables whose layer ``path`` has other leaves."""
    variables = jax.tree.map(jnp.copy, variables)
    layer = variables["fasset"]["params"]
    for name in path:
        layer = layer[name]
    layer.update({name: jnp.full_like(layer[name], value) for name, value in leaves.items()})
    return variables


def test_a_hidden_state_that_is_kept_does_not_see_the_jitter(busy):
    """Update gates closed: over any number of jitters the state stays what it was, where samples were it would blur."""
    frames = without_motion(random_frames(11))
    closed = with_layer(busy, ("frame_encoder", "ConvGRU_0", "Conv_0"), kernel=0.0, bias=-60.0)
    history = after_first(closed, frames)
    state = random_image(12, B, H, W, TINY["width"]) - 0.5
    rendered = history.inner.rendered
    kept = rendered.frames
    kept = dataclasses.replace(kept, content=dataclasses.replace(kept.content, hidden=state[None]))
    inner = dataclasses.replace(history.inner, rendered=dataclasses.replace(rendered, frames=kept))
    history = dataclasses.replace(history, inner=inner)
    for n, kind in ((1, ESS), (2, SS), (3, SS)):
        history, _ = step(kind)(closed, history, select_time(frames, n))
    inside = (slice(None), slice(1, -1), slice(1, -1))  # the border's samples may lie off screen
    np.testing.assert_allclose(hidden_state(history)[inside], state[inside], atol=1e-5)


def test_history_is_read_at_output_size(untrained):
    """Share 1, the same samples at other places: every output is the first one, to the last pixel."""
    frames = without_motion(random_frames(13))
    frames = dataclasses.replace(
        frames, color=jnp.broadcast_to(frames.color[0], frames.color.shape), jitter=0.4 * frames.jitter
    )
    share = jnp.array([40.0, 0.0, 0.0, 0.0])
    all_of_it = jax.tree.map(jnp.copy, untrained)
    all_of_it["fasset"]["params"]["inr"]["Dense_3"]["bias"] = share
    images = images_of(all_of_it, frames, (SS,) * T)
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=1e-4, atol=1e-4)
    assert float(jnp.abs(images_of(untrained, frames, (SS, SS))[1] - images[0]).max()) > 0.1
    # History is no farther off than the current samples: where they are all alike nothing of it is left.
    plain = dataclasses.replace(frames, color=frames.color.at[1].set(0.7))
    np.testing.assert_allclose(images_of(all_of_it, plain, (SS, SS))[1], 0.7, rtol=1e-4)


@pytest.mark.parametrize("kind", [SS, ESS])
def test_texture_is_that_of_the_current_frame(untrained, kind):
    """Light of one colour on changing textures: warped and filled without them, it is exact, in holes as well."""
    frames = random_frames(15)
    light = jnp.array([0.9, 0.6, 0.3])
    color = light * albedo(frames.gbuffers)
    sky = ~jnp.isfinite(frames.gbuffers.depth)
    gbuffers = dataclasses.replace(frames.gbuffers, depth=jnp.where(sky, 5.1, frames.gbuffers.depth))
    frames = dataclasses.replace(frames, color=jnp.where(sky, light * albedo(gbuffers), color), gbuffers=gbuffers)
    second = select_time(frames, 1)
    image = images_of(untrained, frames, (SS, kind))[1]
    expected = jitter_aligned_upsample(log1p(second.color), (45, 60), second.jitter)
    np.testing.assert_allclose(log1p(image), expected, rtol=1e-4, atol=1e-4)


def test_nearness_of_samples():
    near = jax.jit(lambda jitter: sample_nearness((3, 2), (6, 4), jitter))(jnp.array([0.25, -0.4]))
    assert near.shape == (6, 4, 1)
    # Samples at x 1.5, 3.5 (output pixels: 0.5 + 0.25 times 2), y 0.2, 2.2, 4.2; output centres at 0.5, 1.5 ...
    x, y = np.array([-1.0, 0.0, -1.0, 0.0]), np.array([0.3, -0.7, 0.3, -0.7, 0.3, 1.3])
    expected = np.exp(-0.5 * (x[None] ** 2 + y[:, None] ** 2) / 0.65**2)
    np.testing.assert_allclose(near[..., 0], expected, rtol=1e-4)


def test_training_returns_statistics(busy):
    frames = random_frames(16)
    run = lambda variables, frames: unroll(METHOD, variables, frames, alternate(0), train=True).state  # noqa: E731
    state = jax.eval_shape(run, busy, frames)
    assert jax.tree.structure(state["fasset"]["batch_stats"]) == jax.tree.structure(busy["fasset"]["batch_stats"])


def test_frame_without_colour():
    bare = dataclasses.replace(select_time(random_frames(), 0), color=None)
    variables = jax.eval_shape(METHOD.init, jax.random.key(0), bare)
    history, prediction = jax.eval_shape(METHOD.extrapolate_step, variables, METHOD.start(bare), bare)
    assert prediction.image.shape == (B, 45, 60, 3)
    same = jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, history, METHOD.start(bare))
    assert all(jax.tree.leaves(same))  # a history keeps its shapes, so that steps can be scanned


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="scale: expected a number >= 1 or the output's .width, height., got 0"):
        fasset(scale=0)
    with pytest.raises(ValueError, match="FASSET's width: expected at least 4 .*, got 3"):
        fasset(width=3)
    frame = select_time(random_frames(), 0)
    bare = dataclasses.replace(frame, gbuffers=GBuffers(depth=frame.gbuffers.depth))
    with pytest.raises(ValueError, match="fasset needs the buffers base_color, normal, which these frames do not have"):
        METHOD.init(jax.random.key(0), bare)
    with pytest.raises(ValueError, match="fasset: a rendered step needs the frame's colour, got None"):
        METHOD.render_step({}, METHOD.start(frame), dataclasses.replace(frame, color=None))
