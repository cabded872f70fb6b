"""What the thesis' own TUS and the options of the TAA family do, against sums written out and laws."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import reinhard, rgb_to_ycocg
from essjax.frames import Frame, GBuffers
from essjax.methods._taau import UPSAMPLED_WEIGHT, clip_to_box
from essjax.rollout import every, unroll
from essjax.scenes.jitter import jitter_sequence
from essjax.warp import gaussian_resample, jitter_aligned_upsample
from tests.helpers import make_frames

H, W = 4, 5
ENDLESS = {"clamp": "none", "kernel": "tent", "dilate": False}


def painted(x, y):
    """Colours in (0, 1), on x / (1 + x)."""
    return np.stack([0.5 + 0.3 * np.sin(0.9 * x + 0.4 * y), 0.4 + 0.3 * np.cos(1.3 * y - x), 0.1 + 0.05 * x], axis=-1)


def still(scale, frames=16):
    """A resting picture, sampled with the pattern of DLCTUS."""
    jitter = jitter_sequence(frames, pattern="dlctus", scale=scale)
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    encoded = np.stack([painted(x + j[0], y + j[1]) for j in jitter]).astype(np.float32)
    lead = (frames, H, W)
    return encoded, Frame(
        color=jnp.asarray(encoded / (1 - encoded)),
        gbuffers=GBuffers(depth=jnp.full((*lead, 1), 5.0)),
        motion=jnp.zeros((*lead, 2)),
        jitter=jnp.asarray(jitter),
        cut=jnp.arange(frames) == 0,
        exposure=jnp.ones(frames),
    )


def run(method, frames):
    variables = method.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], frames))
    return reinhard(jax.jit(lambda frames: unroll(method, variables, frames, every()).image)(frames))


def accumulated(scale, rate_of):
    """Frame after frame, pixel by pixel: the JAU of frame 0, then samples; ``rate_of(number of samples)``."""
    encoded, frames = still(scale)
    image = np.array(
        jitter_aligned_upsample(jnp.asarray(encoded[0]), (scale * H, scale * W), frames.jitter[0]), np.float64
    )
    seen = np.zeros(image.shape[:2])
    for n, jitter in enumerate(np.asarray(frames.jitter)):
        for y in range(H):
            for x in range(W):
                column, row = (int(np.floor((p + 0.5 + j) * scale)) for p, j in ((x, jitter[0]), (y, jitter[1])))
                seen[row, column] += 1
                if n:
                    image[row, column] += rate_of(seen[row, column]) * (encoded[n, y, x] - image[row, column])
    return frames, image


def test_tent_with_alpha_1_at_4x4_collects_every_sample_once():
    frames, expected = accumulated(4, lambda seen: 1.0)
    got = run(methods.taau(scale=4, alpha=1.0, accumulation="constant", **ENDLESS), frames)[-1]
    np.testing.assert_allclose(got, expected, atol=1e-4)
    x, y = np.meshgrid((np.arange(4 * W) + 0.5) / 4, (np.arange(4 * H) + 0.5) / 4)
    away = np.ones((4 * H, 4 * W), bool)
    away[::4, ::4] = False  # frame 0's samples were shown as their own JAU
    np.testing.assert_allclose(expected[away], painted(x, y)[away], atol=1e-5)


def test_average_of_the_samples_in_a_pixel():
    """1 / N; the upsampled colour that came first counts next to nothing where no sample was."""
    frames, expected = accumulated(2, lambda seen: 1.0 / seen)
    got = run(methods.taau(scale=2, accumulation="average", **ENDLESS), frames)[-1]
    np.testing.assert_allclose(got, expected, atol=2 * UPSAMPLED_WEIGHT)


@pytest.fixture(scope="module")
def tus_frames():
    """Batch element 0 is cut at frame 2; the left columns come from outside; and what ``tus`` makes of it."""
    frames = make_frames(3, T=3, B=2, H=H, W=W)
    motion = jnp.zeros_like(frames.motion).at[:, :, :, :2].set(jnp.array([-2.0 * W, 0.0]))
    frames = dataclasses.replace(frames, motion=motion, jitter=jnp.full_like(frames.jitter, 0.3))
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True))
    return frames, run(methods.tus(), frames)


def test_tus_is_started_and_padded_with_the_aligned_frame(tus_frames):
    frames, image = tus_frames
    aligned = jitter_aligned_upsample(reinhard(frames.color), (2 * H, 2 * W), frames.jitter)
    np.testing.assert_allclose(image[0], aligned[0], atol=1e-5)
    np.testing.assert_allclose(image[1:, :, :, :3], aligned[1:, :, :, :3], atol=1e-5)
    np.testing.assert_allclose(image[2, 0], aligned[2, 0], atol=1e-5)
    assert float(jnp.abs(image[2, 1] - aligned[2, 1]).max()) > 0.01


def test_tus_is_equation_39_with_a_constant_alpha(tus_frames):
    frames, image = tus_frames
    color = reinhard(frames.color[1])
    current = jax.jit(
        lambda color: gaussian_resample(color, color, frames.jitter[1], jnp.float32(0.65), (2 * H, 2 * W))
    )(color)
    rate = 0.5 * current.weight
    expected = rate * current.color + (1 - rate) * jnp.clip(image[0], current.low, current.high)
    np.testing.assert_allclose(image[1, :, :, 6:], expected[:, :, 6:], atol=1e-4)  # there nothing moves


def walk(color, low, high, center):
    """The colour on the way to ``center`` where the box begins, by bisection."""
    if np.all((color >= low) & (color <= high)):
        return color
    outside, inside = 1.0, 0.0  # shares of the way from the centre
    for _ in range(50):
        middle = (outside + inside) / 2
        here = center + middle * (color - center)
        outside, inside = (outside, middle) if np.all((here >= low) & (here <= high)) else (middle, inside)
    return center + inside * (color - center)


def test_clip_to_box_stops_where_the_box_begins():
    samples = np.random.default_rng(0).uniform(size=(40, 9, 3))
    samples[5] = samples[5, 0]  # a box without size
    samples[6, :, 1] = 0.3  # and one without thickness
    low, high, center = samples.min(axis=1), samples.max(axis=1), samples.mean(axis=1)
    color = np.random.default_rng(1).uniform(-0.5, 1.5, (40, 3))
    color[:3] = samples[:3, 4]  # inside
    color[7] = center[7]
    expected = [walk(*arguments) for arguments in zip(color, low, high, center, strict=True)]
    got = clip_to_box(*(jnp.asarray(a, jnp.float32) for a in (color, low, high, center)))
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_clipped_history_lies_in_the_box_of_its_space():
    """With α near 0 the image is the rectified history."""
    frames = jax.tree.map(lambda leaf: leaf[:, 0], make_frames(4, T=2, B=1, H=H, W=W, motion_range=0.1))
    frames = dataclasses.replace(frames, color=frames.color.at[1].multiply(0.1), jitter=jnp.zeros_like(frames.jitter))
    settings = {"alpha": 1e-6, "clamp": "ycocg", "accumulation": "constant"}
    clipped, clamped = (
        np.asarray(rgb_to_ycocg(run(methods.taau(scale=1, rectification=name, **settings), frames)[1]))
        for name in ("clip", "clamp")
    )
    padded = np.pad(np.asarray(rgb_to_ycocg(reinhard(frames.color[1]))), ((1, 1), (1, 1), (0, 0)), mode="edge")
    near = np.stack([padded[dy : dy + H, dx : dx + W] for dy in range(3) for dx in range(3)])
    low, high = near.min(axis=0), near.max(axis=0)
    for image in (clipped, clamped):
        assert np.all(image >= low - 1e-3) and np.all(image <= high + 1e-3)
    assert np.abs(clipped - clamped).max() > 0.005
    # The clamp ends on faces that it need not touch: more values lie on the border of the box than with the clip.
    assert np.mean(np.abs(clamped - high) < 1e-3) > np.mean(np.abs(clipped - high) < 1e-3)


def test_info_and_errors():
    info = methods.tus(scale=4).info
    assert (info.name, info.scale, info.predicts, info.renders_all) == ("tus", 4, {"ss"}, True)
    example = jax.tree.map(lambda leaf: leaf[0], still(2, 1)[1])
    alphas = [float(methods.tus(scale=scale).init(jax.random.key(0), example)["alpha"]) for scale in (2, 4)]
    assert alphas == [0.5, 1.0]  # section 5.3.1
    with pytest.raises(ValueError, match="kernel: expected one of gaussian, tent, got 'box'"):
        methods.taau(kernel="box")
    with pytest.raises(ValueError, match="rectification: expected one of clamp, clip, got 'reject'"):
        methods.taa(rectification="reject")
    with pytest.raises(ValueError, match="accumulation: expected one of bounded, constant, average, got 'sum'"):
        methods.taau_half(accumulation="sum")
