"""FASSET's networks: the paper's sizes, RenderINR against NumPy, weights of features, where latents are read."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.networks import fasset
from essjax.networks._fasset import LOCAL, MAX_WEIGHT, OUTPUT_GAIN, PAST, RenderINR, Reweighting
from tests.helpers import random_image


def parameters(variables):
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(variables))


def noisy(variables, seed=0, scale=0.3):
    rng = np.random.default_rng(seed)
    noise = lambda leaf: jnp.asarray(scale * rng.normal(size=leaf.shape), jnp.float32)  # noqa: E731

    def add(path, leaf):  # variances stay positive
        return leaf + (jnp.abs(noise(leaf)) if path[-1].key == "var" else noise(leaf))

    return jax.tree_util.tree_map_with_path(add, variables)


def inputs(B, H, W, width, scale=1.5):
    """Frame, mask, G-buffers, history at the samples, hidden state, what is known of output pixels, jitter."""
    low = [random_image(k, B, H, W, c) for k, c in enumerate((3, 1, 7, PAST, width))]
    return *low, random_image(8, B, round(scale * H), round(scale * W), LOCAL), random_image(9, B, 2) - 0.5


@functools.cache
def variables(**settings):
    given = inputs(1, 8, 8, 24, settings.pop("scale", 2))
    return jax.eval_shape(fasset(**settings).init, jax.random.key(0), *given)


def shapes(**settings):
    return variables(**settings)["params"]


def test_sizes_are_the_papers():
    """Section 3.2: fewer than 40 K for RenderINR; Table 3: 0.27 M in all."""
    assert 240_000 < parameters(shapes()) <= 270_000
    assert 39_000 < parameters(shapes()["inr"]) < 40_000
    first = shapes()["inr"]["Dense_0"]["kernel"].shape
    assert first[0] <= 48 and first[1] == 128 and len(shapes()["inr"]) == 5  # 3 hidden, output, pixel size
    assert shapes(scale=3.3) == shapes()  # any size with the same weights
    gated = [name for name in shapes()["frame_encoder"] if name.startswith("GatedConv")]
    assert len(gated) == 7 and all(
        set(variables()["batch_stats"]["frame_encoder"][n]["BatchNorm_0"]) == {"mean", "var"} for n in gated
    )


def test_ablations_differ_in_their_part_only():
    without = shapes(gencoder=False)
    assert set(shapes()) - set(without) == {"gbuffer_encoder"}
    assert without["inr"]["Dense_0"]["kernel"].shape[0] == 21 + 7 + LOCAL
    separate = shapes(shared=False)
    assert parameters(separate) - parameters(shapes()) == parameters(shapes()["frame_encoder"])


def test_render_inr_equals_numpy():
    module, latents = RenderINR(7), np.asarray(random_image(1, 2, 3, 5, 11))
    variables = noisy(module.init(jax.random.key(0), latents, jnp.ones(1)))
    layers = jax.tree.map(np.asarray, variables["params"])
    stacked = np.concatenate([layers["Dense_0"]["kernel"], layers["pixel_size"]["kernel"]])
    x = np.concatenate([latents, np.full((2, 3, 5, 1), 0.4)], axis=-1) @ stacked + layers["Dense_0"]["bias"]
    for name in ("Dense_1", "Dense_2", "Dense_3"):
        x = np.maximum(x, 0) @ layers[name]["kernel"] + layers[name]["bias"]
    color, share = module.apply(variables, latents, jnp.full(1, 0.4))
    np.testing.assert_allclose(share, np.tanh(x[..., :1]), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(color / OUTPUT_GAIN, x[..., 1:], rtol=1e-4, atol=1e-5)


def test_feature_weights_start_in_the_middle_of_their_range():
    """At 1, where tanh is steepest; at a tenth of (0, 10) it had lost two thirds of its gradient and soon the rest."""
    module, image = Reweighting(4), random_image(2, 2, 5, 7, 10)
    variables = module.init(jax.random.key(0), image[..., :3], image[..., 3:])
    apply = jax.jit(module.apply)
    for weight in apply(variables, image[..., :3], image[..., 3:]):
        np.testing.assert_allclose(weight, MAX_WEIGHT / 2, rtol=1e-5)
        np.testing.assert_allclose(weight, 1.0, rtol=1e-5)
    first, second = apply(noisy(jax.tree.map(jnp.zeros_like, variables), 1, 0.2), image[..., :3], image[..., 3:])
    for weight in (first, second):
        assert weight.shape == (2, 5, 7, 1) and 0 <= float(weight.min()) <= float(weight.max()) <= MAX_WEIGHT
        assert float(weight.max() - weight.min()) > 0.1
    assert float(jnp.abs(first - second).max()) > 0.1


@pytest.fixture(scope="module")
def tiny():
    network = fasset(width=4, hidden=5, shared=False)
    variables = network.init(jax.random.key(0), *inputs(2, 9, 14, 4))
    run = {m: jax.jit(lambda v, *x, m=m: network.apply(v, *x, method=m)[0]) for m in ("render", "extrapolate")}
    return run, variables


def test_odd_sizes_and_untrained_output(tiny):
    run, variables = tiny
    color, share, hidden = run["render"](variables, *inputs(2, 9, 14, 4))
    assert color.shape == (2, 14, 21, 3) and hidden.shape == (2, 9, 14, 4)  # 13.5 rounds to even
    np.testing.assert_array_equal(share, jnp.zeros((2, 14, 21, 1)))
    np.testing.assert_array_equal(color, 0.0)


def test_every_input_and_every_task_has_its_say(tiny):
    run, variables = tiny
    variables, given = noisy(variables, 2), inputs(2, 9, 14, 4)
    outputs = {task: run[task](variables, *given)[0] for task in run}
    assert float(jnp.abs(outputs["render"] - outputs["extrapolate"]).max()) > 1e-3  # two encoders
    for k in range(len(given)):
        changed = [x[::-1] if n == k else x for n, x in enumerate(given)]
        assert float(jnp.abs(run["render"](variables, *changed)[0] - outputs["render"]).max()) > 1e-4, k


def test_statistics_are_the_batchs_in_training():
    network, given = fasset(width=4, hidden=5), inputs(2, 9, 14, 4)
    variables = jax.tree.map(jnp.ones_like, jax.eval_shape(network.init, jax.random.key(0), *given))
    apply = lambda v, *x: network.apply(v, *x, train=True, method="extrapolate")[1]  # noqa: E731
    state = jax.jit(apply)(variables, *given)["batch_stats"]
    assert jax.tree.structure(state) == jax.tree.structure(variables["batch_stats"])
    moved = [float(jnp.abs(leaf - 1.0).max()) for leaf in jax.tree.leaves(state)]
    assert min(moved) > 1e-3


# Scale, jitter, first and step of output pixels that read at centres of LR pixels, first and step of the latter.
ALIGNED = [
    (1.5, -0.5, 1, 3, 1, 2),  # (3k + 1.5) / 1.5 + 0.5 = 2k + 1.5: pixel 2k + 1
    (2, -0.25, 0, 2, 0, 1),  # (2k + 0.5) / 2 + 0.25 = k + 0.5
    (3.3, 0.5 / 3.3 - 0.5, 0, 33, 0, 10),  # (33k + 0.5) / 3.3 + 0.5 - 0.5 / 3.3 = 10k + 0.5
]


@functools.cache
def outputs():
    network = fasset(width=4, hidden=5)
    return jax.jit(lambda variables, *x: network.apply(variables, *x, method="render")[0][0])


@pytest.mark.parametrize(("scale", "jitter", "first", "step", "low_first", "low_step"), ALIGNED)
def test_latents_are_read_where_the_samples_lie(tiny, scale, jitter, first, step, low_first, low_step):
    """With any weights: output pixels that fall on samples are those of scale 1, where every pixel does."""
    variables = noisy(tiny[1], 3)
    del variables["params"]["frame_encoder_ess"], variables["batch_stats"]["frame_encoder_ess"]
    pixel_size = variables["params"]["inr"]["pixel_size"]["kernel"]
    first_layer = variables["params"]["frame_encoder"]["GatedConv_0"]["Conv_0"]
    # The encoder is told the jitter, which differs here between what is compared.
    first_layer["kernel"] = first_layer["kernel"].at[:, :, -2:].set(0.0)
    *given, local, _ = inputs(2, 20, 30, 4)  # of which each scale makes a whole number

    def run(scale, jitter, kernel):
        variables["params"]["inr"]["pixel_size"]["kernel"] = kernel
        known = jnp.broadcast_to(local[:, :1, :1], (2, round(scale * 20), round(scale * 30), LOCAL))
        return np.asarray(outputs()(variables, *given, known, jnp.full((2, 2), jitter))) / OUTPUT_GAIN

    low = run(1, 0.0, pixel_size / scale)[:, low_first::low_step, low_first::low_step]
    high = run(scale, jitter, pixel_size)[:, first::step, first::step]
    rows, columns = (min(high.shape[axis], low.shape[axis]) for axis in (1, 2))
    assert rows > 1 and columns > 1 and np.std(low) > 0.05
    np.testing.assert_allclose(high[:, :rows, :columns], low[:, :rows, :columns], rtol=1e-3, atol=1e-3)
