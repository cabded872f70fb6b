"""Classifier-guided supersampling: what each class does to history, by hand; the buffers; the laws of a method."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import display, reinhard, rgb_to_ycocg, ycocg_to_rgb
from essjax.frames import GBuffers, frame_size, select_time, without_color
from essjax.methods import classifier, jau
from essjax.methods._classifier import (
    RANGE_RATE,
    classifier_inputs,
    closeness,
    depth_difference,
    look,
    map_colors,
    warp_history,
)
from essjax.rollout import SS, alternate, every, unroll
from essjax.warp import backward_warp, jitter_aligned_upsample
from tests.helpers import make_frames
from tests.methods.scene import wall

T, B, H, W = 4, 2, 7, 9
METHOD = classifier(width=8, composition_width=8)
VISIBILITY, SHADING, NONE = ((30.0, 0.0, 0.0), (0.0, 30.0, 0.0), (0.0, 0.0, 30.0))


FAST = {"xla_backend_optimization_level": 0}
"""Compiles in half the time."""


def bare(frames):
    """What the method reads, so that all tests share one compilation."""
    gbuffers, reactive = GBuffers(depth=frames.gbuffers.depth), jnp.zeros_like(frames.gbuffers.depth)
    return dataclasses.replace(frames, gbuffers=gbuffers, camera=None, reactive=reactive)


def random_frames(seed=0, T=T):
    return bare(make_frames(seed, T=T, B=B, H=H, W=W))


@functools.cache
def rollout():
    def run(variables, frames):
        return unroll(METHOD, variables, frames, every(), keep=lambda aux: aux)

    return jax.jit(run, compiler_options=FAST)


step = jax.jit(METHOD.render_step, compiler_options=FAST)


see = jax.jit(lambda frame, unit: look(frame, unit, tuple(2 * side for side in frame_size(frame)), 0.8))


@pytest.fixture(scope="module")
def untrained():
    return METHOD.init(jax.random.key(0), select_time(random_frames(), 0))


@pytest.fixture(scope="module")
def busy(untrained):
    """Every layer has its say, the last ones too."""
    rng = np.random.default_rng(0)
    noisy = lambda leaf: leaf + jnp.asarray(0.2 * np.abs(rng.normal(size=leaf.shape)), jnp.float32)
    return jax.tree.map(noisy, untrained)


def certain(variables, logits):
    """Variables whose ghosting class is always the same."""
    params = variables["classifier"]["params"]
    norm = {"bias": jnp.asarray((*logits, 0.0, 0.0, 0.0)), "scale": jnp.zeros(6)}
    params = {**params, "BatchNorm_0": norm}
    return {**variables, "classifier": {**variables["classifier"], "params": params}}


def two_frames(seed=1):
    """Motion by whole pixels, another one each frame; the same everywhere, so that dilation changes nothing."""
    frames = random_frames(seed, T=2)
    motion = jnp.broadcast_to(jnp.asarray([[1.0, 0.0], [-2.0, 1.0]])[:, None, None, None], frames.motion.shape)
    return dataclasses.replace(frames, motion=motion)


def moved(image):
    """The previous frame's image at this frame's pixels: 4 output pixels from the left, 2 from below."""
    height, width = image.shape[1:3]
    rows, columns = np.clip(np.arange(height) + 2, 0, height - 1), np.clip(np.arange(width) - 4, 0, width - 1)
    return np.asarray(image)[:, rows][:, :, columns]


KNOWN = np.zeros((2 * H, 2 * W, 1), bool)
KNOWN[:-2, 4:] = True


@jax.jit
def bicubic(frame):
    return jnp.clip(jitter_aligned_upsample(reinhard(frame.color), (2 * H, 2 * W), frame.jitter, mode="bicubic"), 0, 1)


@pytest.mark.parametrize("logits", [VISIBILITY, SHADING, NONE], ids=["visibility", "shading", "none"])
def test_the_class_says_what_becomes_of_history(untrained, logits):
    frames, variables = two_frames(), certain(untrained, logits)
    first, second = select_time(frames, 0), select_time(frames, 1)
    history, prediction = step(variables, METHOD.start(first), first)
    now = bicubic(first)
    np.testing.assert_allclose(reinhard(prediction.image), now, atol=2e-4)  # after a cut: the frame itself
    np.testing.assert_array_equal(history.counter, 0.0)
    new, prediction = step(variables, history, second)
    history, new = (map_colors(reinhard, h) for h in (history, new))  # as the steps see it
    np.testing.assert_allclose(history.low, now, atol=1e-5)

    then, now = np.clip(backward_warp(history.image, moved_motion(), mode="bicubic"), 0, 1), bicubic(second)
    samples = see(second, history.depth_scale).samples
    clamped = np.asarray(ycocg_to_rgb(jnp.clip(rgb_to_ycocg(then), samples.low, samples.high)))
    rejected = (logits == VISIBILITY) | ~KNOWN
    rectified = np.where(rejected, now, clamped if logits == SHADING else then)
    counter = np.where(rejected, 0.0, 1.0)
    weight = np.clip(np.maximum(0.5 * samples.weight, 1 / (1 + counter)), 0.02, 0.98)
    expected = rectified + weight * (now - rectified)
    np.testing.assert_allclose(prediction.aux["encoded"], expected, atol=1e-4)
    np.testing.assert_allclose(new.counter, np.broadcast_to(counter, new.counter.shape), atol=1e-6)
    low, high = moved(history.low), moved(history.high)
    low, high = np.minimum(now, low + RANGE_RATE * (now - low)), np.maximum(now, high + RANGE_RATE * (now - high))
    np.testing.assert_allclose(new.low, np.where(rejected, now, low), atol=1e-5)
    np.testing.assert_allclose(new.high, np.where(rejected, now, high), atol=1e-5)
    assert float(np.abs(then - now)[:, KNOWN[..., 0]].max()) > 0.1 and float(np.abs(clamped - then).max()) > 0.01


def moved_motion():
    return jnp.broadcast_to(jnp.array([-4.0, 2.0]), (B, 2 * H, 2 * W, 2))


def test_the_classifier_sees_what_the_paper_lists(untrained):
    frames = two_frames()
    first, second = select_time(frames, 0), select_time(frames, 1)
    history, _ = step(certain(untrained, (0.5, 0.25, 0.125)), METHOD.start(first), first)
    history = map_colors(reinhard, history)
    history = dataclasses.replace(history, counter=history.counter + 3.0, high=history.high + 0.1)
    current = see(second, history.depth_scale)
    inputs = np.asarray(jax.jit(lambda h, c: classifier_inputs(c, warp_history(h, c)))(history, current))
    assert inputs.shape == (B, 2 * H, 2 * W, 20)
    np.testing.assert_allclose(inputs[..., :3], bicubic(second), atol=1e-6)
    unit = np.asarray(history.depth_scale)[:, None, None, None]
    depth = jitter_aligned_upsample(second.gbuffers.depth, (2 * H, 2 * W), second.jitter, mode="nearest")
    reversed_now = np.where(np.isinf(depth), 0, unit / depth)
    np.testing.assert_allclose(inputs[..., 3:4], reversed_now / (1 + reversed_now), rtol=1e-5)
    np.testing.assert_allclose(
        inputs[..., 4:6], np.broadcast_to([-np.log(5), np.log(3)], (B, 2 * H, 2 * W, 2)), rtol=1e-5
    )
    np.testing.assert_allclose(inputs[..., 6:7], np.broadcast_to(np.where(KNOWN, 0.25, 1.0), inputs[..., :1].shape))
    now = bicubic(second)
    np.testing.assert_allclose(inputs[..., 7:10], np.where(KNOWN, moved(history.low), now), atol=1e-6)
    np.testing.assert_allclose(inputs[..., 10:13], np.where(KNOWN, moved(history.high), now), atol=1e-6)
    reversed_then = moved(history.closeness)
    with np.errstate(invalid="ignore"):
        difference = np.nan_to_num((reversed_then - reversed_now) / np.maximum(reversed_then, reversed_now))
    np.testing.assert_allclose(inputs[..., 13:14], np.where(KNOWN, difference, 0), atol=1e-5)
    np.testing.assert_allclose(inputs[..., 14:17], KNOWN * np.broadcast_to([0.5, 0.25, 0.125], inputs[..., :3].shape))
    assert np.abs(difference).max() > 0.5 and not inputs[..., 17:].any()


def test_depth_difference_by_hand():
    there, here = jnp.array([2.0, 1.0, 0.0, 0.0, 3.0]), jnp.array([1.0, 4.0, 0.0, 5.0, 0.0])
    np.testing.assert_allclose(depth_difference(there, here), [0.5, -0.75, 0.0, -1.0, 1.0])
    frame = select_time(random_frames(), 0)
    depth = frame.gbuffers.depth.at[0, 0, 0, 0].set(jnp.inf).at[0, 0, 1, 0].set(4.0)
    frame = dataclasses.replace(frame, gbuffers=dataclasses.replace(frame.gbuffers, depth=depth))
    np.testing.assert_allclose(closeness(frame, jnp.array([2.0, 1.0]))[0, 0, :2, 0], [0.0, 0.5])


def test_dilated_motion_is_read_nearest():
    """A near pixel's motion reaches its eight neighbours; twice enlarged, no value lies between."""
    frame = select_time(random_frames(), 0)
    motion = jnp.zeros((B, H, W, 2)).at[:, 3, 4].set(jnp.array([3.0, -1.0]))
    depth = jnp.full((B, H, W, 1), 10.0).at[:, 3, 4].set(2.0)
    gbuffers = dataclasses.replace(frame.gbuffers, depth=depth)
    frame = dataclasses.replace(frame, motion=motion, gbuffers=gbuffers, jitter=jnp.zeros((B, 2)))
    expected = np.zeros((2 * H, 2 * W, 2))
    expected[4:10, 6:12] = [6.0, -2.0]
    np.testing.assert_array_equal(see(frame, jnp.ones(B)).motion[0], expected)


def test_a_reactive_pixel_has_no_history(untrained):
    frames, variables = two_frames(), certain(untrained, NONE)
    frames = dataclasses.replace(frames, reactive=frames.reactive.at[:, :, 2, 5].set(1.0))
    history, _ = step(variables, METHOD.start(select_time(frames, 0)), select_time(frames, 0))
    _, prediction = step(variables, history, select_time(frames, 1))
    rejected, second = prediction.aux["ghosting"][..., 0], select_time(frames, 1)
    mask = jitter_aligned_upsample(second.reactive, (2 * H, 2 * W), second.jitter, mode="nearest")[
        ..., 0
    ]  # of the nearest sample
    assert 2 * B <= float(mask.sum()) <= 6 * B
    np.testing.assert_array_equal(rejected[mask > 0], 1.0)
    assert (rejected[:, 4:6, 6:8] < 1e-6).all()


def stream(variables, frames):
    history, images = METHOD.start(select_time(frames, 0)), []
    for n in range(frames.motion.shape[0]):
        history, prediction = step(variables, history, select_time(frames, n))
        images.append(prediction.image)
    return jnp.stack(images)


def test_streaming_equals_the_rollout(busy):
    frames = random_frames()
    result = rollout()(busy, frames)
    assert result.image.shape == (T, B, 2 * H, 2 * W, 3) and bool(jnp.isfinite(result.image).all())
    np.testing.assert_allclose(reinhard(result.image), reinhard(stream(busy, frames)), atol=1e-4)
    for name in ("ghosting", "aliasing"):
        assert float(result.aux[SS][name].std()) > 0.02
        np.testing.assert_allclose(result.aux[SS][name].sum(axis=-1), 1.0, rtol=1e-5)


def test_batch_elements_are_independent_and_later_frames_are_not_seen(busy):
    frames, others = random_frames(2), random_frames(3)
    mixed = jax.tree.map(lambda a, b: a.at[2:, 1].set(b[2:, 1]), frames, others)
    image, other = rollout()(busy, frames).image, rollout()(busy, mixed).image
    np.testing.assert_allclose(other[:, 0], image[:, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(other[:2], image[:2])
    assert float(jnp.abs(reinhard(other[2:, 1]) - reinhard(image[2:, 1])).max()) > 0.1


def test_history_ends_at_a_cut(busy):
    frames = random_frames(4)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True))
    changed = dataclasses.replace(frames, color=frames.color.at[:2].multiply(1.5))
    image, other = rollout()(busy, frames).image, rollout()(busy, changed).image
    np.testing.assert_array_equal(other[2:, 0], image[2:, 0])
    assert float(jnp.abs(other[2:, 1] - image[2:, 1]).max()) > 1e-3
    started = stream(busy, select_time(frames, slice(2, 4)))  # a stream that begins there
    np.testing.assert_allclose(reinhard(image[2:, 0]), reinhard(started[:, 0]), atol=1e-4)


def test_before_training_it_accumulates(untrained):
    scene = wall(10, B, H, W)
    images = stream(untrained, bare(scene.frames))
    alone = jax.jit(lambda frames: unroll(jau(scale=2, mode="bicubic"), {}, frames, every()).image)(scene.frames)
    inside = (Ellipsis, slice(4, -4), slice(4, -4), slice(None))
    error = lambda image: np.square(display(image)[inside] - display(scene.reference)[inside]).mean(axis=(2, 3, 4))
    gain = 10 * np.log10(error(alone) / error(images))  # [T, B]
    np.testing.assert_allclose(gain[0], 0.0, atol=0.01)
    assert (gain[6:].mean(axis=0) > 2.0).all()


def test_it_refuses_to_extrapolate(untrained):
    with pytest.raises(ValueError, match=r"classifier cannot extrapolate: .* Use schedule every\(\)"):
        unroll(METHOD, untrained, random_frames(), alternate(0))
    with pytest.raises(ValueError, match="classifier: a rendered step needs the frame's colour"):
        METHOD.render_step(
            untrained, METHOD.start(select_time(random_frames(), 0)), without_color(select_time(random_frames(), 0))
        )
