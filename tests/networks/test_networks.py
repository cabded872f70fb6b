"""FRNet and ExtraSSNet: budgets of size and work, odd sizes, and what they return before training."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.frames import select_time
from essjax.methods import extrass
from essjax.networks import extrassnet, frnet
from essjax.networks._extrassnet import CONDITIONS
from essjax.networks._frnet import OFFSETS, _halfway, _read, matched_flow
from essjax.networks.blocks import crop, pad_to_multiple
from essjax.warp import backward_warp
from tests.helpers import make_frames, random_image


def parameters(variables):
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(variables))


def giga_operations(function, *arguments):
    """XLA's count before compilation, 2 per multiply-add."""
    return jax.jit(function).lower(*arguments).cost_analysis()["flops"] / 1e9


@functools.cache
def defaults():
    """Shapes of the variables of ``extrass`` at default width for 960x540 input, and E0's and E1's input channels."""
    frames = make_frames(T=1, B=1, H=8, W=8)
    variables = jax.eval_shape(extrass().init, jax.random.key(0), select_time(frames, 0))
    first = lambda name: variables["extrassnet"]["params"][name]["ConvBlock_0"]["Conv_0"]["kernel"].shape[2]
    return variables, first("encoder_ss"), first("encoder_ess")


def test_number_of_parameters():
    variables, _, _ = defaults()
    assert 20_000 < parameters(variables["frnet"]) <= 500_000
    assert 200_000 < parameters(variables["extrassnet"]) <= 600_000


def test_work_for_540p():
    variables, channels_ss, channels_ess = defaults()
    image = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float32)

    def run(method):
        apply = extrassnet().apply
        return lambda variables, inputs: apply(variables, inputs, jnp.zeros((1, CONDITIONS)), method=method)[0]

    ss = giga_operations(run("render"), variables["extrassnet"], image(1, 540, 960, channels_ss))
    ess = giga_operations(run("extrapolate"), variables["extrassnet"], image(1, 540, 960, channels_ess))
    flow = giga_operations(
        lambda v, *inputs: frnet().apply(v, *inputs)[0],
        variables["frnet"],
        image(2, 1, 270, 480, 3),
        image(1, 270, 480, 1),
        image(2, 1),
    )
    assert 10 < ss <= 80 and 10 < ess <= 80
    assert max(ss, ess) <= 1.15 * min(ss, ess)
    assert 1 < flow <= 40


def test_work_is_counted_in_multiply_adds_times_two():
    count = giga_operations(lambda a, b: a @ b, jnp.zeros((100, 200)), jnp.zeros((200, 50)))
    np.testing.assert_allclose(count, 2 * 100 * 200 * 50 / 1e9, rtol=1e-6)


def randomised(variables, seed=3):
    """Weights with noise, so that no layer is at its initial zero."""
    leaves, tree = jax.tree.flatten(variables)
    rng = np.random.default_rng(seed)
    noise = [jnp.asarray(leaf + 0.05 * rng.normal(size=leaf.shape), jnp.float32) for leaf in leaves]
    return jax.tree.unflatten(tree, noise)


@pytest.fixture(scope="module")
def small_frnet():
    network = frnet(width=4)
    return network, network.init(
        jax.random.key(0), jnp.zeros((2, 1, 8, 8, 3)), jnp.zeros((1, 8, 8, 1)), jnp.ones((2, 1))
    )


def test_frnet_on_odd_sizes(small_frnet):
    network, variables = small_frnet
    warped, roughness = random_image(0, 2, 2, 7, 11, 3), random_image(1, 2, 7, 11, 1)
    run = jax.jit(lambda v, *inputs: network.apply(v, *inputs)[0])
    ages = jnp.array([[1.0, 2.0], [3.0, 5.0]])  # two elements, of different rates
    untrained = run(variables, warped, roughness, ages)
    assert untrained["flow"].shape == (2, 7, 11, 2)
    matched = matched_flow(pad_to_multiple(warped, 4), pad_to_multiple(roughness, 4), ages)
    matched = ages[0, :, None, None, None] * matched
    np.testing.assert_allclose(untrained["flow"], crop(matched, 7, 11), atol=1e-5)
    assert [f.shape for f in untrained["features"]] == [(2, 8, 12, 4), (2, 4, 6, 6), (2, 2, 3, 8)]

    trained = run(randomised(variables), warped, roughness, ages)
    assert float(jnp.abs(trained["flow"] - untrained["flow"]).max()) > 1e-3
    padded = run(randomised(variables), pad_to_multiple(warped, 4), pad_to_multiple(roughness, 4), ages)
    np.testing.assert_allclose(trained["flow"], crop(padded["flow"], 7, 11), rtol=1e-4, atol=1e-5)
    encoded, state = network.apply(variables, random_image(2, 2, 7, 11, 3), method="encode")
    assert [f.shape for f in encoded] == [f.shape for f in untrained["features"]] and state == {}


@pytest.mark.parametrize(("flow", "ages"), [((1, 0), (3, 7)), ((0, 1), (2, 5)), ((-1, 1), (1, 3)), ((1, 1), (1, 4))])
def test_matching_finds_shading_that_moves_evenly(flow, ages):
    """A picture that moved by whole pixels, on a mirror (left half) and on a rough surface (right half)."""
    picture = 0.2 * np.asarray(random_image(4, 40, 40, 3, high=1.0))
    y, x = np.mgrid[8:32, 8:32]
    # newest(x + a f) = older(x + b f) = what is seen now, frames of a and b frames ago.
    warped = jnp.stack([jnp.asarray(picture[y - k * flow[1], x - k * flow[0]]) for k in ages])
    roughness = jnp.where(jnp.arange(24) < 12, 0.1, 0.9)[None, :, None] * jnp.ones((24, 24, 1))
    found = np.asarray(jax.jit(matched_flow)(warped, roughness, jnp.array(ages, jnp.float32)))
    np.testing.assert_allclose(found[8:16, 8:11], np.broadcast_to(flow, (8, 3, 2)), atol=0.02)
    np.testing.assert_allclose(found[:, 12:], 0.0, atol=1e-4)


def test_matching_reads_what_a_warp_reads():
    """Every offset at every age, of two elements at once: slices of the half-pixel images against the bilinear warp."""
    image = random_image(6, 2, 7, 9, 3)
    read = jax.jit(lambda ages, offset: _read(_halfway(image), ages, offset, (7, 9)))
    for ages in ([1.0, 3.0], [2.0, 7.0]):
        for offset in OFFSETS:
            flow = jnp.array(ages)[:, None, None, None] * jnp.broadcast_to(offset, (2, 7, 9, 2))
            np.testing.assert_allclose(read(jnp.array(ages), offset), backward_warp(image, flow), atol=1e-5)


def test_matching_of_equal_frames_finds_no_motion():
    image = random_image(5, 12, 16, 3)
    found = matched_flow(jnp.stack([image, image]), jnp.zeros((12, 16, 1)), jnp.array([1.0, 3.0]))
    np.testing.assert_allclose(found[4:8, 4:12], 0.0, atol=1e-3)


def test_extrassnet_on_odd_sizes():
    network = extrassnet(width=4)
    ss, ess = random_image(0, 2, 9, 13, 5), random_image(1, 2, 9, 13, 7)
    conditions = random_image(2, 2, CONDITIONS)
    variables = network.init(jax.random.key(0), ss, ess, conditions)

    @jax.jit
    def run(variables, ss, ess, conditions=conditions):
        inputs = ("render", ss), ("extrapolate", ess)
        return [network.apply(variables, images, conditions, method=method)[0] for method, images in inputs]

    for head, features in run(variables, ss, ess):
        assert head.shape == (2, 9, 13, 20)
        np.testing.assert_array_equal(head, 0.0)
        assert [f.shape for f in features] == [(2, 16, 16, 4), (2, 8, 8, 6), (2, 4, 4, 8), (2, 2, 2, 12)]
    variables = randomised(variables)
    padded = run(variables, *(pad_to_multiple(x, 8) for x in (ss, ess)))
    for (head, _), (whole, _) in zip(run(variables, ss, ess), padded, strict=True):
        assert float(jnp.abs(head).max()) > 1e-3
        np.testing.assert_allclose(head, crop(whole, 9, 13), rtol=1e-4, atol=1e-5)
    for (head, _), (other, _) in zip(run(variables, ss, ess), run(variables, ss, ess, 0 * conditions), strict=True):
        assert float(jnp.abs(head - other).max()) > 1e-3


def test_initial_kernels_have_he_variance_and_depend_on_the_key():
    network = extrassnet(width=24)
    shapes = (1, 8, 8, 31), (1, 8, 8, 37), (1, CONDITIONS)
    inputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    first, second = (network.init(jax.random.key(seed), *inputs)["params"] for seed in (0, 1))
    for encoder in ("encoder_ss", "encoder_ess"):
        kernel = np.asarray(first[encoder]["ConvBlock_3"]["Conv_1"]["kernel"])
        np.testing.assert_allclose(kernel.std(), math.sqrt(2 / math.prod(kernel.shape[:-1])), rtol=0.05)
        assert abs(kernel.mean()) < 0.05 * kernel.std()
    a, b = (first[e]["ConvBlock_3"]["Conv_1"]["kernel"].reshape(-1) for e in ("encoder_ss", "encoder_ess"))
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.05  # no two layers share their numbers
    assert abs(np.corrcoef(a, second["encoder_ss"]["ConvBlock_3"]["Conv_1"]["kernel"].reshape(-1))[0, 1]) < 0.05
