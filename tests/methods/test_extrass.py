"""ExtraSS: the warp alone on worlds with known answers, what a step may read, and a useful picture before training."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import demodulate, display, log1p, modulate, reinhard, reinhard_inverse
from essjax.frames import GBuffers, select_time, without_color
from essjax.methods import extrass, extrass_e, extrass_w
from essjax.methods._extrass import history_motion, trusted, warp_shown
from essjax.methods.extrass_low import blend_mask, refine
from essjax.methods.rendered import albedo, hole_buffers
from essjax.networks import frnet
from essjax.rollout import ESS, SS, alternate, stream_step, unroll
from essjax.warp import gbuffer_guided_warp, guides
from tests.helpers import indices_of, make_frames, random_image, streamed
from tests.methods.scene import wall

T, B, H, W = 5, 2, 15, 22


def random_frames(seed=0, T=T):
    """Random frames with the buffers of ``wall`` and surfaces close enough that some history is valid."""
    frames = make_frames(seed, T=T, B=B, H=H, W=W)
    sky = ~jnp.isfinite(frames.gbuffers.depth)
    depth = jnp.where(sky, jnp.inf, random_image(seed + 1, T, B, H, W, 1, low=5.0, high=5.3))
    gbuffers = GBuffers(
        base_color=frames.gbuffers.base_color, normal=jnp.zeros_like(frames.gbuffers.normal), depth=depth
    )
    return dataclasses.replace(frames, gbuffers=gbuffers, camera=None)


# --- extrass-w -------------------------------------------------------------------------------------------------------


SHARP = extrass_w(sigma_guide=0.002)
NEAREST = extrass_w(sigma_distance=0.1)


def test_resting_camera_returns_the_frame():
    """Every pixel has a base colour of its own, so the guide leaves one candidate: the pixel itself."""
    frame = select_time(random_frames(), slice(0, 1))
    frames = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 3), frame)
    frames = dataclasses.replace(frames, motion=jnp.zeros_like(frames.motion), cut=frames.cut.at[1:].set(False))
    hit = jnp.isfinite(frames.gbuffers.depth[0])  # sky has one guide everywhere
    images = streamed(SHARP, {}, frames, (SS, ESS, ESS))
    np.testing.assert_array_equal(images[0], frames.color[0])
    for image in images[1:]:
        np.testing.assert_allclose(jnp.where(hit, image, 0), jnp.where(hit, frames.color[0], 0), rtol=1e-4, atol=1e-5)


def test_one_frame_by_hand():
    frames = random_frames(4)
    first, second = select_time(frames, 1), select_time(frames, 2)  # their jitters differ
    first = dataclasses.replace(first, cut=jnp.array([True, True]))
    history, _ = stream_step(SHARP, SS)({}, SHARP.start(first), first)
    _, image = stream_step(SHARP, ESS)({}, history, second)
    assert float(jnp.abs(first.jitter - second.jitter).max()) > 0.05
    warp = jax.jit(functools.partial(gbuffer_guided_warp, sigma_guide=0.002))
    encoded = reinhard(demodulate(first.color, albedo(first.gbuffers)))
    shading = encoded, guides(first.gbuffers), guides(second.gbuffers)
    by_hand = [
        modulate(reinhard_inverse(warp(*shading, second.motion + sign * (second.jitter - first.jitter)[:, None, None])),
                 albedo(second.gbuffers)) for sign in (1, -1)
    ]  # fmt: skip
    np.testing.assert_allclose(image, by_hand[0], rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(image - by_hand[1]).max()) > 0.1  # the sign of the jitter difference matters


@pytest.mark.parametrize("kinds", [(SS, ESS, ESS), (SS, ESS, ESS, ESS)], ids=["two", "three"])
def test_extrapolations_in_a_row_follow_the_composed_motion(kinds):
    """A picture without guides shifts by whole pixels, another shift each frame."""
    steps = np.array([(0, 0), (2, -1), (1, 3), (-4, 1)])
    picture = np.asarray(random_image(7, 2, H, W, 3))
    frames = select_time(random_frames(), slice(0, len(kinds)))
    flat = GBuffers(
        base_color=jnp.full_like(frames.gbuffers.base_color, 0.5),
        normal=jnp.zeros_like(frames.gbuffers.normal),
        depth=jnp.full_like(frames.gbuffers.depth, 5.0),
    )
    motion = jnp.broadcast_to(jnp.asarray(steps[: len(kinds), None, None, None], jnp.float32), frames.motion.shape)
    color = frames.color.at[0].set(picture)
    frames = dataclasses.replace(
        frames, gbuffers=flat, motion=motion, color=color, jitter=jnp.zeros_like(frames.jitter)
    )
    images = np.asarray(streamed(NEAREST, {}, frames, kinds))
    dx, dy = steps[: len(kinds)].sum(axis=0)
    y, x = np.mgrid[4 : H - 4, 4 : W - 4]
    np.testing.assert_allclose(images[-1][:, y, x], picture[:, y + dy, x + dx], rtol=1e-4)


# --- FRNet's part ----------------------------------------------------------------------------------------------------


def test_blend_mask_equals_numpy():
    base, normal = random_image(0, H, W, 3, high=1.0), np.random.default_rng(1).normal(size=(H, W, 3))
    normal = np.round(normal / np.linalg.norm(normal, axis=-1, keepdims=True)[..., :1], 3)
    normal[:8] = [0.0, 0.6, 0.8]
    warped = random_image(2, H, W, 3)
    padded = np.pad(warped, [(0, 1), (0, 0), (0, 0)], mode="edge")
    before = padded.reshape(8, 2, 11, 2, 3).mean(axis=(1, 3))
    refined = before * np.random.default_rng(3).uniform(0.8, 1.2, (8, 11, 1))
    refined[0, 0] = before[0, 0] = 0.0
    buffers = GBuffers(base_color=base, normal=jnp.asarray(normal, jnp.float32), depth=jnp.ones((H, W, 1), jnp.float32))
    mask = jax.jit(blend_mask)(jnp.asarray(refined, jnp.float32), warped, buffers)

    half = lambda image: np.pad(image, [(0, 1), (0, 0), (0, 0)], mode="edge").reshape(8, 2, 11, 2, 3).mean(axis=(1, 3))
    expected, undecided = np.zeros((H, W)), np.zeros((H, W), bool)
    means, base_half, normal_half = half(np.asarray(warped)), half(np.asarray(base)), half(normal)
    for y in range(H):
        for x in range(W):
            at = y // 2, x // 2
            distance = np.linalg.norm(base_half[at] - base[y, x]) / np.sqrt(3.0)
            similar = (1.0 - distance) * np.dot(normal_half[at], normal[y, x])
            changed = np.linalg.norm(refined[at] - means[at]) / max(np.linalg.norm(refined[at]), 1e-3)
            expected[y, x] = similar > 0.1 and changed > 0.1
            undecided[y, x] = min(abs(similar - 0.1), abs(changed - 0.1)) < 1e-4
    np.testing.assert_array_equal(np.where(undecided, 0, mask[..., 0]), np.where(undecided, 0, expected))
    assert 0.1 < expected.mean() < 0.9 and undecided.mean() < 0.02


def test_untrained_refinement_keeps_the_warp_of_rough_surfaces():
    network = frnet(width=4)
    frames = random_frames()
    frames = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, roughness=None))  # counts as 1
    warped = 1.0 + random_image(5, 2, B, H, W, 3, high=0.1)
    variables = network.init(jax.random.key(0), jnp.zeros((2, B, 8, 11, 3)), jnp.zeros((B, 8, 11, 1)), jnp.ones((2, B)))
    ages = jnp.ones((2, B)) * jnp.array([[1.0], [3.0]])
    run = jax.jit(lambda *arguments: refine(network, *arguments))
    result = run(variables, warped, select_time(frames.gbuffers, 0), ages)
    np.testing.assert_allclose(result["flow"], 0.0, atol=1e-6)
    np.testing.assert_array_equal(result["mask"], 0.0)
    np.testing.assert_array_equal(result["image"], warped[0])


# --- The whole of it -------------------------------------------------------------------------------------------------


METHOD = extrass(width=4, frnet_width=4)


@pytest.fixture(scope="module")
def untrained():
    return METHOD.init(jax.random.key(0), select_time(random_frames(), 0))


@pytest.fixture(scope="module")
def busy(untrained):
    """Variables none of which is zero: every layer has its say."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: leaf + jnp.asarray(0.05 * rng.normal(size=leaf.shape), jnp.float32), untrained)


@functools.cache
def rollout(parity):
    return jax.jit(lambda variables, frames: unroll(METHOD, variables, frames, alternate(parity)).image)


def frames_for(parity, seed):
    """Whole pairs, so that a rollout compiles as few steps as it can: SS ESS SS ESS, or SS SS ESS SS ESS."""
    return random_frames(seed, T=4 + parity)


both_parities = pytest.mark.parametrize("parity", [0, 1])


@both_parities
def test_streaming_equals_the_rollout(busy, parity):
    frames = frames_for(parity, 0)
    images = streamed(METHOD, busy, frames, alternate(parity).kinds(4 + parity))
    image = rollout(parity)(busy, frames)
    assert image.shape == (4 + parity, B, 2 * H, 2 * W, 3)
    np.testing.assert_allclose(log1p(image), log1p(images), rtol=1e-3, atol=1e-3)
    assert bool(jnp.all(jnp.isfinite(image))) and float(image.min()) >= 0.0


@both_parities
def test_colour_of_extrapolated_frames_is_never_read(busy, parity):
    frames = frames_for(parity, 1)
    hidden = indices_of(alternate(parity).kinds(4 + parity), ESS)
    poisoned = dataclasses.replace(frames, color=frames.color.at[jnp.array(hidden)].set(jnp.nan))
    np.testing.assert_array_equal(rollout(parity)(busy, poisoned), rollout(parity)(busy, frames))


@pytest.mark.parametrize("method", [SHARP, extrass_e(width=4), METHOD], ids=lambda method: method.info.name)
def test_frame_without_colour(method):
    frames = random_frames()
    bare = without_color(select_time(frames, 0))
    variables = jax.eval_shape(method.init, jax.random.key(0), bare)
    history, prediction = jax.eval_shape(method.extrapolate_step, variables, method.start(bare), bare)
    size = int(method.info.scale)
    assert prediction.image.shape == (B, size * H, size * W, 3)
    same = jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, history, method.start(bare))
    assert all(jax.tree.leaves(same))  # a history keeps its shapes, so that steps can be scanned


@both_parities
def test_causal(busy, parity):
    frames = frames_for(parity, 2)
    for n in (2, 3):
        future = jax.tree.map(
            lambda leaf, n=n: leaf.at[n:].set(leaf[n:][:, ::-1]) if leaf.dtype == jnp.float32 else leaf, frames
        )
        image, other = rollout(parity)(busy, frames), rollout(parity)(busy, future)
        np.testing.assert_array_equal(other[:n], image[:n])
        assert float(jnp.abs(other[n] - image[n]).max()) > 0.01


def test_history_ends_at_a_cut(busy):
    frames = random_frames(3)
    frames = dataclasses.replace(frames, cut=frames.cut.at[3, 0].set(True))  # parity 1 renders frame 3
    before = jax.tree.map(lambda leaf: leaf.at[:3].set(leaf[:3][:, ::-1]), frames.gbuffers)
    changed = dataclasses.replace(frames, gbuffers=before, color=frames.color.at[:3].multiply(1.5))
    image, other = rollout(1)(busy, frames), rollout(1)(busy, changed)
    np.testing.assert_array_equal(other[3:, 0], image[3:, 0])
    assert float(jnp.abs(other[3:, 1] - image[3:, 1]).max(axis=(1, 2, 3)).min()) > 1e-3  # no cut there
    alone = select_time(frames, slice(3, 5))  # the same as a stream that starts there
    started = streamed(METHOD, busy, alone, (SS, ESS))
    np.testing.assert_allclose(log1p(image[3:, 0]), log1p(started[:, 0]), rtol=1e-3, atol=1e-3)


@both_parities
def test_batch_elements_are_independent(busy, parity):
    frames, others = frames_for(parity, 5), frames_for(parity, 6)
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    image, other = rollout(parity)(busy, frames), rollout(parity)(busy, mixed)
    np.testing.assert_allclose(log1p(other[:, 0]), log1p(image[:, 0]), rtol=1e-5, atol=1e-5)
    assert float(jnp.abs(other[:, 1] - image[:, 1]).max()) > 0.1


def psnr(image, truth):
    inside = (slice(4, -4), slice(4, -4))
    error = display(image)[..., *inside, :] - display(truth)[..., *inside, :]
    return -10.0 * np.log10(np.mean(np.square(error), axis=(-3, -2, -1)))


def test_untrained_network_is_a_sensible_baseline(untrained):
    scene = wall(14, B, H, W)
    images = streamed(METHOD, untrained, scene.frames, alternate(0).kinds(14))
    quality = psnr(images, scene.reference)  # [T, B]
    color = scene.frames.color
    bilinear = psnr(jax.image.resize(color, images.shape, "linear"), scene.reference)
    nearest = psnr(jnp.repeat(jnp.repeat(color, 2, axis=2), 2, axis=3), scene.reference)
    late_ss, late_ess = quality[8::2].mean(axis=0), quality[9::2].mean(axis=0)
    assert np.all(late_ss > bilinear[8::2].mean(axis=0) + 1.0)
    assert np.all(late_ss > nearest[8::2].mean(axis=0) + 1.0)
    assert np.all(np.abs(late_ess - late_ss) < 1.5)
    assert np.all(late_ss > quality[0] + 1.0)  # it accumulates


def test_history_beside_a_lamp_does_not_ring():
    """A bicubic read of linear radiance would draw a black ring around one bright pixel."""
    frame = select_time(random_frames(), 1)
    height, width = frame.motion.shape[-3:-1]
    frame = dataclasses.replace(frame, motion=jnp.full_like(frame.motion, 0.25), cut=jnp.zeros_like(frame.cut))
    image = jnp.ones((frame.motion.shape[0], 2 * height, 2 * width, 3)).at[:, 9, 11].set(1000.0)
    warped = jax.jit(lambda image, frame: warp_shown(image, history_motion(frame, (2 * height, 2 * width))))(
        image, frame
    )
    assert float(jnp.expm1(warped).min()) > 0.7
    assert float(jnp.expm1(warped[:, 9, 11]).max()) < 1000


def test_trust_is_soft_beside_a_hole():
    """One LR pixel that another surface covered before: its neighbours trust history a little less each."""
    frame = select_time(random_frames(), 1)
    still = dataclasses.replace(frame, motion=jnp.zeros_like(frame.motion), cut=jnp.zeros_like(frame.cut))
    still = dataclasses.replace(still, reactive=None, gbuffers=dataclasses.replace(
        still.gbuffers, depth=jnp.full_like(still.gbuffers.depth, 10.0)))  # fmt: skip
    before = dataclasses.replace(still, gbuffers=dataclasses.replace(
        still.gbuffers, depth=still.gbuffers.depth.at[:, 5, 6].set(2.0)))  # fmt: skip
    valid = trusted(still, hole_buffers(before.gbuffers), before.jitter)[0, ..., 0]
    expected = np.ones(valid.shape)
    expected[4:7, 5:8] = 8 / 9
    np.testing.assert_allclose(valid, expected, rtol=1e-5)


def test_training_observes_all_frames_before_its_loop(busy):
    """Images, what losses read, history and gradients are those of the steps, one frame at a time; with cuts inside."""
    frames = random_frames(4, T=4)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True).at[3, 1].set(True))
    stepwise = METHOD._replace(parts=None)

    def run(method, variables, frames):
        def loss(network):
            keep = lambda aux: {name: aux[name] for name in ("log_image", "warped", "features")}
            result = unroll(method, {**variables, "extrassnet": network}, frames, alternate(0), train=True, keep=keep)
            return jnp.mean(log1p(result.image)), result

        return jax.grad(loss, has_aux=True)(variables["extrassnet"])

    programs = [jax.jit(functools.partial(run, method)).trace(busy, frames) for method in (METHOD, stepwise)]
    assert str(programs[0].jaxpr) != str(programs[1].jaxpr)
    (gradient, result), (gradient_of_steps, steps) = (each.lower().compile()(busy, frames) for each in programs)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), result, steps)
    largest = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient_of_steps))
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5 * largest), gradient, gradient_of_steps
    )
