"""Spatial upscalers, the plain warp and temporal accumulation, on scenes whose truth is known in closed form."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image as Pillow

from essjax import methods
from essjax.cameras import pixel_positions
from essjax.color import display, reinhard
from essjax.frames import Frame, GBuffers, select_time, without_color
from essjax.rollout import alternate, every, unroll
from tests.helpers import make_frames, random_image

SCALE = 2
JITTER = np.array([[0.0, -1 / 6], [-0.25, 1 / 6], [0.25, -7 / 18], [-0.375, -1 / 18], [0.125, 5 / 18],
                   [-0.125, -5 / 18], [0.375, 1 / 18], [-7 / 16, 7 / 18]], np.float32)  # fmt: skip
"""Halton (2, 3) minus one half, elements 1 to 8."""


def texture(x, y):
    """A smooth, asymmetric HDR picture, defined everywhere; ``x`` and ``y`` in LR pixels."""
    red = 1.0 + 0.8 * np.sin(0.9 * x + 0.4 * y)
    green = 1.0 + 0.8 * np.sin(1.7 * x - 0.8) * np.cos(1.3 * y)
    blue = 1.5 * (np.floor(x / 2.5) + np.floor(y / 3.5)) % 2 + 0.1
    return np.stack([red, green, np.broadcast_to(blue, red.shape)], axis=-1)


def supersampled(height, width, scale, shift, samples=8):
    """Box-filtered truth of ``texture(x - shift)`` on the grid of ``scale * (height, width)`` pixels."""
    total = 0.0
    offsets = (np.arange(samples) + 0.5) / samples
    for dy in offsets:
        for dx in offsets:
            x, y = np.meshgrid((np.arange(width * scale) + dx) / scale, (np.arange(height * scale) + dy) / scale)
            total = total + texture(x - shift[0], y - shift[1])
    return np.asarray(total / samples**2, np.float32)


def moving_texture(T, H=15, W=22, velocity=(0.0, 0.0), jitter=True, scale=SCALE):
    """Frames of the texture translating by ``velocity`` LR pixels per frame, and their supersampled truth."""
    jitters = JITTER[(np.arange(T) // 2) % 8] * (1.0 if jitter else 0.0)
    color, truth = [], []
    for t in range(T):
        shift = np.array(velocity) * t
        position = np.asarray(pixel_positions(H, W)) + jitters[t]
        color.append(texture(position[..., 0] - shift[0], position[..., 1] - shift[1]))
        truth.append(supersampled(H, W, scale, shift))
    frames = Frame(
        color=np.asarray(color, np.float32),
        gbuffers=GBuffers(
            base_color=np.full((T, H, W, 3), 0.5, np.float32),
            normal=np.broadcast_to(np.array([0, 0, 1], np.float32), (T, H, W, 3)),
            depth=np.full((T, H, W, 1), 5.0, np.float32),
        ),
        motion=np.broadcast_to(-np.array(velocity, np.float32), (T, H, W, 2)),
        jitter=jitters,
        cut=np.arange(T) == 0,
        exposure=np.ones(T, np.float32),
    )
    return jax.tree.map(jnp.asarray, frames), jnp.asarray(np.stack(truth))


@functools.cache
def compiled(method, extrapolate):
    """One jitted rollout per method and schedule: compiling is what these tests would spend their time on."""
    schedule = alternate(0) if extrapolate else every()
    return jax.jit(lambda variables, frames: unroll(method, variables, frames, schedule).image)


def run(method, frames, *, extrapolate=False, **changes):
    """Images of a rollout in which every frame is rendered, or every other extrapolated; ``changes`` to variables."""
    variables = method.init(jax.random.key(0), select_time(frames, 0))
    return compiled(method, extrapolate)(variables | {k: jnp.float32(v) for k, v in changes.items()}, frames)


def psnr(image, truth, border=4):
    inside = (slice(border, -border), slice(border, -border))
    error = reinhard(image)[..., *inside, :] - reinhard(truth)[..., *inside, :]
    return -10.0 * np.log10(np.mean(np.square(error), axis=(-3, -2, -1)))


BILINEAR, BICUBIC, JAU = methods.bilinear(), methods.bicubic(), methods.jau()
WARP, WARP_BLUR = methods.warp(), methods.warp(blur=0.5)
TAAU = {clamp: methods.taau(clamp=clamp) for clamp in ("none", "rgb", "ycocg")}
TAAU_HALF, TAA = methods.taau_half(), methods.taa()
ALL = [BILINEAR, BICUBIC, JAU, WARP, WARP_BLUR, TAAU["ycocg"], TAAU_HALF, TAA]
by_name = pytest.mark.parametrize("method", ALL, ids=lambda method: method.info.name)


def random_frames(seed=1):
    """The one shape of random frames here."""
    return make_frames(seed, T=4, B=2, H=5, W=7)


@by_name
def test_info_and_size(method):
    frames = random_frames()
    image = run(method, frames, extrapolate=not method.info.renders_all)
    assert image.shape == (4, 2, 5 * method.info.scale, 7 * method.info.scale, 3)
    assert np.all(np.isfinite(image)) and np.all(image >= 0)


def test_names_and_kinds():
    facts = {
        m.info.name: (m.info.scale, "".join(sorted(m.info.predicts)), m.info.native, m.info.renders_all) for m in ALL
    }
    assert facts == {
        "bilinear": (2, "ss", False, False),
        "bicubic": (2, "ss", False, False),
        "jau": (2, "ss", False, False),
        "warp": (1, "ess", False, False),
        "warp-blur": (1, "ess", False, False),
        "taau": (2, "ss", False, True),
        "taau-half": (2, "essss", False, False),
        "taa": (1, "ss", True, True),
    }


@by_name
def test_batch_elements_are_independent(method):
    frames = random_frames(2)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 1].set(True))
    extrapolate = not method.info.renders_all
    both = run(method, frames, extrapolate=extrapolate)
    swapped = run(method, jax.tree.map(lambda leaf: leaf[:, ::-1], frames), extrapolate=extrapolate)
    np.testing.assert_array_equal(swapped[:, ::-1], both)
    other = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, random_frames(3))
    np.testing.assert_array_equal(run(method, other, extrapolate=extrapolate)[:, 0], both[:, 0])


@by_name
def test_a_constant_stays_constant(method):
    frames = dataclasses.replace(random_frames(3), color=jnp.full((4, 2, 5, 7, 3), 0.7, jnp.float32))
    np.testing.assert_allclose(run(method, frames, extrapolate=not method.info.renders_all), 0.7, rtol=1e-4)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_spatial_upscaling_equals_pillow(mode):
    frames = random_frames(4)
    image = run(BILINEAR if mode == "bilinear" else BICUBIC, frames)[0, 0]
    kernel = {"bilinear": Pillow.Resampling.BILINEAR, "bicubic": Pillow.Resampling.BICUBIC}[mode]  # a = -0.5
    encoded = np.asarray(reinhard(frames.color[0, 0]))
    expected = np.stack([Pillow.fromarray(encoded[..., c]).resize((14, 10), kernel) for c in range(3)], axis=-1)
    # Pillow renormalises at the border, we repeat it: compare the inside.
    np.testing.assert_allclose(reinhard(image)[3:-3, 3:-3], np.clip(expected, 0, 1)[3:-3, 3:-3], atol=2e-5)


def test_spatial_methods_repeat_on_extrapolated_frames():
    frames = random_frames(5)
    image = run(BICUBIC, frames, extrapolate=True)
    np.testing.assert_array_equal(image[1], image[0])
    np.testing.assert_array_equal(image[3], image[2])


def test_jau_reads_sample_positions():
    """A horizontal ramp, sampled with jitter: JAU restores it exactly, plain bilinear is off by slope * jitter."""
    H, W, jitter = 6, 9, (0.3, -0.2)
    x, y = (np.asarray(pixel_positions(H, W))[..., k] + jitter[k] for k in (0, 1))
    encoded = np.repeat((0.1 + 0.05 * x + 0.02 * y)[..., None], 3, axis=-1)  # linear in x / (1 + x)
    frames, _ = moving_texture(1, H, W)
    frames = dataclasses.replace(
        frames, color=jnp.asarray(encoded / (1 - encoded), jnp.float32)[None], jitter=jnp.array([jitter])
    )
    truth = pixel_positions(2 * H, 2 * W) / 2
    truth = 0.1 + 0.05 * truth[..., 0] + 0.02 * truth[..., 1]
    inside = (slice(2, -2), slice(2, -2))
    aligned = reinhard(run(JAU, frames))[0, ..., 0]
    np.testing.assert_allclose(aligned[inside], truth[inside], atol=1e-5)
    plain = reinhard(run(BILINEAR, frames))[0, ..., 0]
    np.testing.assert_allclose(plain[inside], truth[inside] + 0.05 * 0.3 - 0.02 * 0.2, atol=1e-5)


def test_warp_follows_integer_motion_and_jitter():
    """With equal jitter an integer shift is exact; two extrapolated frames in a row both read the rendered one."""
    frames, _ = moving_texture(5, velocity=(2.0, -1.0), jitter=False)
    render, extrapolate = jax.jit(WARP.render_step), jax.jit(WARP.extrapolate_step)
    history, shown = render({}, WARP.start(select_time(frames, 0)), select_time(frames, 0))
    np.testing.assert_array_equal(shown.image, frames.color[0])
    for t in (1, 2):
        history, prediction = extrapolate({}, history, without_color(select_time(frames, t)))
        expected = frames.color[t]
        np.testing.assert_allclose(prediction.image[: -t - 1, 2 * t :], expected[: -t - 1, 2 * t :], atol=1e-5)
    history, _ = render({}, history, select_time(frames, 3))  # two in a row: the latest counts
    history, _ = render({}, history, select_time(frames, 4))
    np.testing.assert_array_equal(history.inner["color"], frames.color[4])
    np.testing.assert_array_equal(history.inner["motion"], 0.0)


def test_warp_adds_the_jitter_difference():
    """On an image that is linear in x and y, bilinear reads are exact, so the result is the ramp at the new samples."""
    H, W = 8, 11
    frames, _ = moving_texture(2, H, W)
    jitter = jnp.array([[0.3, -0.4], [-0.2, 0.1]])
    x, y = (pixel_positions(H, W, jitter)[..., k] for k in (0, 1))
    ramp = jnp.repeat((2.0 + 0.5 * x + 0.25 * y)[..., None], 3, axis=-1)
    motion = jnp.broadcast_to(jnp.array([0.6, 0.7]), (2, H, W, 2))  # the ramp moves by the opposite
    frames = dataclasses.replace(frames, color=ramp, jitter=jitter, motion=motion)
    image = run(WARP, frames, extrapolate=True)[1]
    expected = ramp[1] + 0.5 * 0.6 + 0.25 * 0.7
    np.testing.assert_allclose(image[1:-2, 1:-2], expected[1:-2, 1:-2], atol=1e-4)


def test_warp_blur():
    image = random_image(0, 9, 12, 3)
    np.testing.assert_array_equal(methods.gaussian_blur(image, 0.0), image)
    impulse = jnp.zeros((15, 17, 1)).at[7, 8].set(1.0)
    blurred = methods.gaussian_blur(impulse, 0.5)
    weights = np.exp(-0.5 * (np.arange(-2, 3) / 0.5) ** 2)
    weights /= weights.sum()
    np.testing.assert_allclose(blurred[5:10, 6:11, 0], np.outer(weights, weights), atol=1e-6)
    assert methods.warp(blur=0.5).info.name == "warp-blur" and methods.warp().info.name == "warp"
    frames = random_frames(6)
    frames = dataclasses.replace(frames, motion=jnp.zeros_like(frames.motion))  # frames 0 and 1 share their jitter
    shown = run(WARP_BLUR, frames, extrapolate=True)
    np.testing.assert_array_equal(shown[0], frames.color[0])  # a rendered frame is shown as it is
    np.testing.assert_allclose(shown[1], methods.gaussian_blur(frames.color[0], 0.5), rtol=1e-5)
    with pytest.raises(ValueError, match="blur: expected a standard deviation >= 0 in pixels, got -1"):
        methods.warp(blur=-1)


STATIC = {"alpha": 0.05, "sigma": 0.4}


def test_accumulation_converges_to_the_supersampled_truth():
    frames, truth = moving_texture(16)
    quality = psnr(run(TAAU["none"], frames, **STATIC), truth)
    assert quality[15] > quality[7] > quality[0]
    assert quality[15] > 30.0
    for baseline in (BILINEAR, JAU, BICUBIC):
        assert quality[15] > psnr(run(baseline, frames), truth).max() + 3.0


def test_native_accumulation_converges():
    frames, truth = moving_texture(16, scale=1)
    quality = psnr(run(TAA, frames, **STATIC), truth)
    alias = psnr(frames.color, truth)
    assert quality[15] > alias.max() + 2.0


@pytest.mark.parametrize("clamp", ["none", "rgb", "ycocg"])
def test_accumulation_follows_integer_motion(clamp):
    """1.5 LR pixels are 3 output pixels: history is shifted exactly, so motion costs (almost) nothing."""
    frames, truth = moving_texture(16, velocity=(1.5, -0.5))
    still, still_truth = moving_texture(16)
    variables = {"alpha": 0.1, "sigma": 0.5}
    moving = psnr(run(TAAU[clamp], frames, **variables), truth, border=8)
    resting = psnr(run(TAAU[clamp], still, **variables), still_truth, border=8)
    assert moving[-4:].mean() > resting[-4:].mean() - 1.5
    wrong = dataclasses.replace(frames, motion=-frames.motion)
    assert psnr(run(TAAU[clamp], wrong, **variables), truth, border=8)[-4:].mean() < moving[-4:].mean() - 2


def test_half_rate_shows_the_warped_output_between():
    frames, truth = moving_texture(16, velocity=(1.5, -0.5))
    image = run(TAAU_HALF, frames, extrapolate=True, **STATIC)
    shifted = image[14][1:, :-3]  # the output of frame 14 moved by (+3, -1) output pixels
    np.testing.assert_allclose(image[15][:-1, 3:], shifted, rtol=1e-3, atol=1e-4)
    quality = psnr(image, truth, border=8)
    assert abs(quality[15] - quality[14]) < 1.5
    assert quality[14] > psnr(run(JAU, frames), truth, border=8)[14] + 1.0


def test_half_rate_equals_full_rate_where_every_frame_is_rendered():
    frames = random_frames(7)
    np.testing.assert_allclose(run(TAAU_HALF, frames), run(TAAU["ycocg"], frames), rtol=1e-4, atol=1e-5)


def test_two_extrapolations_in_a_row_read_the_rendered_output_once():
    frames, _ = moving_texture(3, velocity=(0.25, 0.0))  # half an output pixel per frame: two make one, exactly
    method = TAAU_HALF
    variables = method.init(jax.random.key(0), select_time(frames, 0))
    render, extrapolate = jax.jit(method.render_step), jax.jit(method.extrapolate_step)
    history, first = render(variables, method.start(select_time(frames, 0)), select_time(frames, 0))
    for t in (1, 2):
        history, prediction = extrapolate(variables, history, without_color(select_time(frames, t)))
    np.testing.assert_allclose(prediction.image[:, 2:], first.image[:, 1:-1], rtol=1e-4, atol=1e-5)


def test_off_screen_history_is_the_jitter_aligned_frame():
    frames, _ = moving_texture(16, velocity=(2.0, 0.0))  # 4 output columns enter on the left
    image = run(TAAU["ycocg"], frames)
    aligned = run(JAU, frames)
    np.testing.assert_allclose(image[0], aligned[0], rtol=1e-4, atol=1e-5)  # nor does the first frame have any
    np.testing.assert_allclose(image[1, :, :4], aligned[1, :, :4], rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(image[1, :, 4:] - aligned[1, :, 4:]).max()) > 0.01


@pytest.mark.parametrize("method", [TAAU["ycocg"], TAAU_HALF], ids=["taau", "taau-half"])
def test_cut_resets_accumulation(method):
    frames = random_frames(8)
    frames = dataclasses.replace(frames, cut=frames.cut.at[3, 0].set(True))
    image, aligned = (run(m, frames) for m in (method, JAU))
    np.testing.assert_allclose(image[3, 0], aligned[3, 0], rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(image[3, 1] - aligned[3, 1]).max()) > 0.01


def test_clamp_removes_ghosts():
    """A bright picture turns dark without a cut: the clamp drops it at once, plain accumulation keeps a trail."""
    frames, _ = moving_texture(16)
    frames = dataclasses.replace(frames, color=frames.color.at[4:].multiply(0.05))
    truth = run(JAU, frames)[4]
    error = {
        clamp: float(jnp.abs(display(run(TAAU[clamp], frames, alpha=0.1)[4]) - display(truth)).mean())
        for clamp in ("none", "rgb", "ycocg")
    }
    assert error["rgb"] < 0.25 * error["none"]
    assert error["ycocg"] < 0.25 * error["none"]


def test_background_does_not_disturb_accumulation():
    frames, truth = moving_texture(16)
    depth = frames.gbuffers.depth.at[:, :, ::3].set(jnp.inf)
    sky = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, depth=depth))
    image = run(TAAU["ycocg"], sky)
    assert np.all(np.isfinite(image))
    np.testing.assert_allclose(image, run(TAAU["ycocg"], frames), rtol=1e-4)  # motion is 0 everywhere


def test_settings_are_runtime_arrays():
    frames, _ = moving_texture(16)
    variables = TAAU["ycocg"].init(jax.random.key(0), select_time(frames, 0))
    assert {name: value.dtype for name, value in variables.items()} == {"alpha": jnp.float32, "sigma": jnp.float32}
    images = [run(TAAU["ycocg"], frames, alpha=a, sigma=s) for a, s in ((0.1, 0.5), (0.5, 0.5), (0.1, 0.9))]
    compilations = compiled(TAAU["ycocg"], False)._cache_size()
    assert float(jnp.abs(images[0] - images[1]).max()) > 1e-3 and float(jnp.abs(images[0] - images[2]).max()) > 1e-3
    run(TAAU["ycocg"], frames, alpha=0.3, sigma=0.7)
    assert compiled(TAAU["ycocg"], False)._cache_size() == compilations


def test_errors():
    with pytest.raises(ValueError, match="clamp: expected one of none, rgb, ycocg, got 'hsv'"):
        methods.taau(clamp="hsv")
    with pytest.raises(ValueError, match="scale: expected a number >= 1 or the output's .width, height., got 0.5"):
        methods.taau(scale=0.5)
    with pytest.raises(ValueError, match="expected 0 < alpha <= 1 and sigma > 0, got alpha = 2"):
        methods.taau_half(alpha=2)
    frames = random_frames()
    with pytest.raises(ValueError, match="taa cannot extrapolate: it needs the colour of every frame"):
        run(TAA, frames, extrapolate=True)
    frame = without_color(select_time(frames, 0))
    for method in (methods.warp(), JAU, TAAU_HALF):
        with pytest.raises(ValueError, match="a rendered step needs the frame's colour, got None"):
            method.render_step(method.init(jax.random.key(0), frame), method.start(frame), frame)
