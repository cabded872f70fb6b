"""DLCTUS against plain loops written from the thesis' listings (appendix A), and the laws of a method."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import reinhard
from essjax.frames import select_time, without_color
from essjax.methods import dlctus
from essjax.methods._dlctus import REPROJECTIONS, map_color, returning_clip
from essjax.networks import dlctus_network
from essjax.rollout import SS, alternate, every, unroll
from essjax.warp import backward_warp, jitter_aligned_upsample, zero_upsample
from tests.helpers import make_frames, random_image, streamed
from tests.warp.test_sampling import oracle as read_oracle

T, B, H, W = 4, 2, 5, 7
NEAR, FAR = 0.1, 100.0


def random_frames(seed=0, T=T):
    return make_frames(seed, T=T, B=B, H=H, W=W)


def busy_variables(method, seed=0):
    """Noise on every layer, outputs inside the clamp and outside of it."""
    shapes = jax.eval_shape(method.init, jax.random.key(0), select_time(random_frames(), 0))
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        if path[-1].key == "bias":
            return jnp.full(leaf.shape, 0.12)
        return jnp.asarray(rng.normal(0.0, 0.7 / math.sqrt(math.prod(leaf.shape[:-1])), leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


@functools.cache
def compiled(method):
    keep = lambda aux: {name: value for name, value in aux.items() if value is not None}
    return jax.jit(lambda variables, frames: unroll(method, variables, frames, every(), keep=keep))


METHOD, JAU = dlctus(scale=2), methods.jau(scale=2)
VARIABLES = busy_variables(METHOD)


def run(frames, method=METHOD, variables=VARIABLES):
    return compiled(method)(variables, frames)


# --- The listings ----------------------------------------------------------------------------------------------------


def texture_read(image, u, v):
    """``SampleLevel(linear_clamp, uv)``."""
    return read_oracle(image, u * image.shape[1], v * image.shape[0], "bilinear", "border")


def prepare(color, depth, jitter, scale):
    """Zero-upsampled RGB-D and JAU, pixel by pixel as in appendix A.2; ``jitter`` is the thesis' J in [0, 1)."""
    height, width = color.shape[0] * scale, color.shape[1] * scale
    sampled, aligned = np.zeros((height, width, 4)), np.ones((height, width, 4))
    for y in range(height):
        for x in range(width):
            low = y // scale, x // scale
            hit = [int((p + offset) * scale) for p, offset in zip(low[::-1], jitter, strict=True)]
            if hit == [x, y]:
                linear = np.clip((depth[low][0] - NEAR) / (FAR - NEAR), 0, 1)
                sampled[y, x] = [*color[low], linear]
            position = np.array([x, y]) + 0.5 + (0.5 - np.asarray(jitter)) * scale
            aligned[y, x, :3] = texture_read(color, position[0] / width, position[1] / height)
    return sampled, aligned


def convolve(x, kernel, bias, stride, padding):
    """A direct sum: what ``nn.Conv2d`` computes, replicated borders."""
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)), mode="edge")
    size = kernel.shape[0]
    rows = range(0, x.shape[0] - size + 1, stride)
    columns = range(0, x.shape[1] - size + 1, stride)
    patches = np.array([[x[r : r + size, c : c + size] for c in columns] for r in rows])
    return np.einsum("hwijc,ijco->hwo", patches, kernel) + bias


def network_oracle(params, inputs):
    """The layers of appendix A.1 in float64."""
    layers = [params[f"Conv_{k}"] for k in range(9)]
    weights = [(np.asarray(layer["kernel"], np.float64), np.asarray(layer["bias"], np.float64)) for layer in layers]
    height, width = inputs.shape[:2]
    x = np.pad(inputs, ((0, -height % 4), (0, -width % 4), (0, 0)), mode="edge")
    x = convolve(x, *weights[0], stride=4, padding=0)
    for block in range(4):
        residual = np.maximum(convolve(x, *weights[1 + 2 * block], stride=1, padding=1), 0)
        x = x + convolve(residual, *weights[2 + 2 * block], stride=1, padding=1)
    shuffled = np.zeros((x.shape[0] * 4, x.shape[1] * 4, 2))
    for y in range(shuffled.shape[0]):
        for column in range(shuffled.shape[1]):
            start = 2 * (4 * (y % 4) + column % 4)  # channel order (dy, dx, c)
            shuffled[y, column] = x[y // 4, column // 4, start : start + 2]
    return shuffled[:height, :width]


def step_oracle(params, history, color, depth, motion, jitter, scale, accumulation=True):
    """One step of appendix A.1 on x / (1 + x); returns the history."""
    color = np.asarray(color, np.float64)
    sampled, aligned = prepare(color / (1 + color), np.asarray(depth), np.asarray(jitter) + 0.5, scale)
    aligned = aligned if accumulation else aligned[..., :3]
    past = np.array(aligned)
    if history is not None:
        for y in range(past.shape[0]):
            for x in range(past.shape[1]):
                # Motion lies at the samples, like colour (docs/deviations.md).
                low = (np.array([x, y]) + 0.5) / scale - np.asarray(jitter)
                to = np.array([x, y]) + 0.5 + scale * read_oracle(np.asarray(motion), *low, "bilinear", "border")
                if 0 <= to[0] <= past.shape[1] and 0 <= to[1] <= past.shape[0]:
                    past[y, x] = read_oracle(history, *to, "bicubic-0.75", "border")
    outputs = np.clip(network_oracle(params, np.concatenate([sampled, past], axis=-1)), 0, 1)
    result = aligned * outputs[..., :1] + past * (1 - outputs[..., :1])
    if accumulation:
        result[..., 3] *= outputs[..., 1]
    return np.clip(result, 0, 1), outputs


@functools.partial(jax.jit, static_argnames="scale")
def upsample(rgbd, jitter, scale):
    size = scale * rgbd.shape[-3], scale * rgbd.shape[-2]
    return zero_upsample(rgbd, size, jitter), jitter_aligned_upsample(rgbd[..., :3], size, jitter)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("jitter", [(-0.5, 0.49), (0.13, -0.31)])
def test_upsampling_agrees_with_the_listing(scale, jitter):
    color, depth = random_image(1, H, W, 3), random_image(2, H, W, 1, high=120.0)
    sampled, aligned = prepare(np.asarray(color, np.float64), np.asarray(depth), np.asarray(jitter) + 0.5, scale)
    rgbd = np.concatenate([color, np.clip((depth - NEAR) / (FAR - NEAR), 0, 1)], axis=-1)
    got_sampled, got_aligned = upsample(rgbd, jnp.array(jitter), scale)
    np.testing.assert_allclose(got_sampled, sampled, atol=1e-6)
    assert np.count_nonzero(sampled[..., 3]) == H * W
    np.testing.assert_allclose(got_aligned, aligned[..., :3], atol=1e-5)


@pytest.mark.parametrize(("scale", "accumulation"), [(2, True), (4, True), (2, False)])
def test_two_steps_agree_with_the_listing(scale, accumulation):
    method = dlctus(scale=scale, accumulation=accumulation)
    variables = busy_variables(method)
    frames = make_frames(7, T=2, B=1, H=5 if scale == 2 else 3, W=7 if scale == 2 else 4)
    frames = jax.tree.map(lambda leaf: leaf[:, 0], frames)  # no batch axis: every leading axis will do
    frames = dataclasses.replace(frames, motion=frames.motion * 0.8, jitter=jnp.array([[0.2, -0.4], [-0.3, 0.1]]))
    result = run(frames, method, variables)
    params, history = jax.tree.map(np.asarray, variables["dlctus"]["params"]), None
    for n in range(2):
        depth, motion = frames.gbuffers.depth[n], frames.motion[n]
        arguments = frames.color[n], depth, motion, frames.jitter[n], scale
        history, outputs = step_oracle(params, history, *arguments, accumulation=accumulation)
        assert 0.2 < np.mean((outputs > 0) & (outputs < 1)) < 0.95  # both sides of the clamp are tested
        np.testing.assert_allclose(result.aux[SS]["encoded"][n], history[..., :3], atol=2e-5)
        np.testing.assert_allclose(reinhard(result.image[n]), history[..., :3], atol=2e-4)
    np.testing.assert_allclose(map_color(reinhard, result.history)["image"], history, atol=2e-5)


# --- The network -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [2, 4])
def test_number_of_parameters(scale):
    example = select_time(random_frames(), 0)
    count = lambda method: sum(
        math.prod(leaf.shape) for leaf in jax.tree.leaves(jax.eval_shape(method.init, jax.random.key(0), example))
    )
    assert count(dlctus(scale=scale)) == 78_112
    assert count(dlctus(scale=scale, accumulation=False)) == 78_112 - 4 * 4 * 32


def test_untrained_outputs_lie_inside_the_clamp():
    network = dlctus_network()
    inputs = random_image(4, 1, 32, 32, 8, high=1.0)
    outputs, _ = network.apply(network.init(jax.random.key(2), inputs), inputs)
    assert float(jnp.mean((outputs > 0) & (outputs < 1))) > 0.7


def test_clip_leads_back_inside():
    """Forward bit by bit ``jnp.clip``; a gradient passes outside of [0, 1] where descent leads back, and only there."""
    x = jnp.array([-jnp.inf, -2.0, -0.0, 0.0, 0.3, 1.0, 1.0 + 1e-6, 7.0, jnp.inf, jnp.nan])
    np.testing.assert_array_equal(jax.jit(returning_clip)(x), jnp.clip(x, 0.0, 1.0))
    inward = jax.jit(jax.vjp(returning_clip, x)[1])
    np.testing.assert_array_equal(inward(jnp.full(10, 2.0))[0][:9], [0, 0, 2, 2, 2, 2, 2, 2, 2])
    np.testing.assert_array_equal(inward(jnp.full(10, -2.0))[0][:9], [-2, -2, -2, -2, -2, -2, 0, 0, 0])


@pytest.mark.parametrize("bias", [-9.0, 9.0], ids=["only history", "only new samples"])
def test_outputs_outside_the_clamp_have_a_gradient(bias):
    """All of o1 and o2 left the range, the state in which training at the rate of ``quick`` used to end."""
    frames, target = random_frames(9), random_image(11, T, B, 2 * H, 2 * W, 3, high=1.0)
    variables = jax.tree.map(jnp.copy, VARIABLES)
    variables["dlctus"]["params"]["Conv_8"]["bias"] = jnp.full(32, bias)

    @jax.jit
    def gradient(variables):
        def loss(variables):
            aux = unroll(METHOD, variables, frames, every(), keep=lambda aux: aux).aux[SS]
            return jnp.mean(jnp.abs(aux["encoded"] - target)), aux["rate"]

        return jax.grad(loss, has_aux=True)(variables)

    moved, rate = gradient(variables)
    assert float(rate.min()) == float(rate.max()) == (bias > 0)
    norms = [float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(moved)]
    assert all(np.isfinite(norms)) and min(norms) > 1e-6, norms


# --- The laws of a method --------------------------------------------------------------------------------------------


def test_streaming_equals_the_rollout():
    frames = random_frames(1)
    images = streamed(METHOD, VARIABLES, frames, (SS,) * T)
    result = run(frames)
    assert result.image.shape == (T, B, 2 * H, 2 * W, 3) and bool(jnp.all(jnp.isfinite(result.image)))
    np.testing.assert_allclose(reinhard(result.image), reinhard(images), atol=1e-5)


def test_first_frame_and_cut_start_from_the_aligned_frame():
    frames = random_frames(2)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True).at[0].set(False))
    aligned = run(frames, JAU, {}).image
    result = run(frames)
    image = result.image
    np.testing.assert_allclose(reinhard(image[0]), reinhard(aligned[0]), atol=1e-5)  # whatever the network says
    np.testing.assert_allclose(reinhard(image[2, 0]), reinhard(aligned[2, 0]), atol=1e-5)
    assert float(jnp.abs(reinhard(image[2, 1]) - reinhard(aligned[2, 1])).max()) > 0.01
    fresh = run(jax.tree.map(lambda leaf: jnp.roll(leaf, -2, axis=0), frames))  # the stream that starts at the cut
    np.testing.assert_allclose(reinhard(fresh.image[:2, 0]), reinhard(image[2:, 0]), atol=1e-5)


def test_off_screen_is_the_aligned_frame_with_accumulation_one():
    frames = random_frames(3)
    away = frames.motion.at[:, :, :, :2].set(jnp.array([-2.0 * W, 0.3]))  # the left columns come from outside
    frames = dataclasses.replace(frames, motion=away, jitter=jnp.zeros_like(frames.jitter))
    keep_all = jax.tree.map(jnp.zeros_like, VARIABLES)  # o1 = o2 = 0 but for the bias below
    keep_all["dlctus"]["params"]["Conv_8"]["bias"] = jnp.tile(jnp.array([0.0, 1.0]), 16)  # o1 = 0, o2 = 1
    result = run(frames, variables=keep_all)
    aligned = run(frames, JAU, {}).image
    outside = (slice(1, None), slice(None), slice(None), slice(0, 3))
    np.testing.assert_allclose(reinhard(result.image[outside]), reinhard(aligned[outside]), atol=1e-5)
    np.testing.assert_allclose(result.aux[SS]["accumulation"], 1.0, atol=1e-5)
    inside = reinhard(result.image[1:, :, :, 4:]) - reinhard(aligned[1:, :, :, 4:])
    assert float(jnp.abs(inside).max()) > 0.05  # history is kept there: o1 = 0


def test_batch_elements_are_independent():
    frames, others = random_frames(4), random_frames(5)
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    image, other = reinhard(run(frames).image), reinhard(run(mixed).image)
    np.testing.assert_allclose(other[:, 0], image[:, 0], atol=1e-6)
    assert float(jnp.abs(other[:, 1] - image[:, 1]).max()) > 0.1


def test_test_time_variations_share_the_variables():
    frames = random_frames(6)
    plain, varied = (reinhard(run(frames, m).image) for m in (METHOD, dlctus(reprojection="5-tap", dilate=True)))
    np.testing.assert_allclose(varied[0], plain[0], atol=1e-6)
    assert 1e-3 < float(jnp.abs(varied[1:] - plain[1:]).max()) < 1.0


def test_reprojections():
    image, motion = random_image(8, H, W, 3), random_image(9, H, W, 2, low=-2.0)
    all_of_them = jax.jit(lambda *inputs: {name: reproject(*inputs) for name, reproject in REPROJECTIONS.items()})
    read = all_of_them(image, motion)
    np.testing.assert_allclose(read["9-tap"], read["bicubic-0.75"], atol=2e-5)
    np.testing.assert_allclose(read["bilinear"], backward_warp(image, motion), atol=1e-6)
    assert 0.01 < float(jnp.abs(read["5-tap"] - read["9-tap"]).max()) < 0.3


def test_names_and_kinds():
    settings = [{}, {"reprojection": "bilinear"}, {"reprojection": "5-tap"}, {"reprojection": "9-tap"}]
    settings += [{"dilate": True}, {"accumulation": False}, {"dilate": True, "reprojection": "bilinear"}]
    names = ["dlctus", "dlctus-bilinear", "dlctus-5tap", "dlctus-9tap", "dlctus-dilated", "dlctus-no-accumulation"]
    assert [dlctus(**s).info.name for s in settings] == [*names, "dlctus-dilated-bilinear"]
    info = dlctus(scale=4).info
    assert (info.scale, info.predicts, info.renders_all) == (4, {"ss"}, True)


def test_errors():
    with pytest.raises(ValueError, match="scale: expected 2 or 4, got 3"):
        dlctus(scale=3)
    with pytest.raises(ValueError, match="reprojection: expected one of bicubic-0.75, bilinear, 5-tap, 9-tap, got 'x'"):
        dlctus(reprojection="x")
    with pytest.raises(ValueError, match="expected 0 <= near < far, got near = 3 and far = 2"):
        dlctus(near=3, far=2)
    frames = random_frames()
    with pytest.raises(ValueError, match="dlctus cannot extrapolate: it needs the colour of every frame"):
        unroll(METHOD, VARIABLES, frames, alternate(0))
    frame = without_color(select_time(frames, 0))
    with pytest.raises(ValueError, match="dlctus: a rendered step needs the frame's colour, got None"):
        METHOD.render_step(VARIABLES, METHOD.start(frame), frame)
