"""The rollout against a plain Python loop over the same two steps, on a toy method whose history is easy to follow."""

import dataclasses
import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.frames import Prediction, select_time, without_color
from essjax.interfaces import Method, MethodInfo, refuse_extrapolation, reset_at_cut
from essjax.rollout import ESS, SS, alternate, bake, check_supported, every, stream, stream_step, unroll
from tests.helpers import at, indices_of, make_frames, streamed


def toy(latency: int = 0, **info) -> Method:
    """History: the last image and a count. Rendering averages it with the colour, extrapolating adds the motion's x."""

    def start(example):
        return {"image": jnp.zeros_like(example.color), "count": jnp.zeros(example.cut.shape)}

    def refresh(history, frame):
        fresh = jax.tree.map(jnp.zeros_like, history)
        return reset_at_cut(frame.cut, fresh, history)

    def render_step(variables, history, frame, *, train=False):
        history = refresh(history, frame)
        image = variables["mix"] * frame.color + (1 - variables["mix"]) * history["image"]
        history = {"image": image, "count": history["count"] + 1}
        return history, Prediction(image=image, aux={"count": history["count"], "train": jnp.array(train)})

    def extrapolate_step(variables, history, frame, *, train=False):
        assert frame.color is None, "an extrapolated frame's colour must be taken away"
        history = refresh(history, frame)
        image = history["image"] + variables["mix"] * frame.motion[..., :1]
        history = {"image": image, "count": history["count"] + 100}
        return history, Prediction(image=image, aux={"count": history["count"], "speed": jnp.max(frame.motion)})

    details = MethodInfo(name="toy", scale=1, latency=latency, **info)
    return Method(lambda key, example: {"mix": jnp.array(0.25)}, start, render_step, extrapolate_step, details)


VARIABLES = {"mix": jnp.array(0.25)}
TOY = toy()
STEPS = {SS: jax.jit(TOY.render_step), ESS: jax.jit(TOY.extrapolate_step)}
EVERY, EVEN, ODD, FOURTH = every(), alternate(0), alternate(1), alternate(2, period=4)


@functools.cache
def compiled(schedule, method=TOY, **options):
    return jax.jit(lambda frames: unroll(method, VARIABLES, frames, schedule, **options))


def python_loop(frames, kinds):
    history, images, counts = TOY.start(at(frames, 0)), [], []
    for n, kind in enumerate(kinds):
        frame = at(frames, n)
        history, prediction = STEPS[kind](VARIABLES, history, frame if kind == SS else without_color(frame))
        images.append(prediction.image)
        counts.append(prediction.aux["count"])
    return jnp.stack(images), history, counts


def test_kinds():
    assert every().kinds(3) == (SS, SS, SS)
    assert alternate(0).kinds(5) == (SS, ESS, SS, ESS, SS)
    assert alternate(1).kinds(6) == (SS, SS, ESS, SS, ESS, SS)
    assert indices_of(alternate(1).kinds(6), ESS) == [2, 4]
    both = [set(indices_of(alternate(phase).kinds(9), ESS)) for phase in (0, 1)]
    assert both[0] | both[1] == set(range(1, 9)) and not both[0] & both[1]  # every frame but 0 is extrapolated once
    assert alternate(period=3).kinds(5) == (SS, ESS, ESS, SS, ESS)
    assert alternate(2, period=3).kinds(7) == (SS, ESS, SS, ESS, ESS, SS, ESS)
    rendered = [set(indices_of(alternate(phase, period=4).kinds(13), SS)) - {0} for phase in range(4)]
    assert sorted(n for each in rendered for n in each) == list(range(1, 13))  # every frame but 0 is rendered once
    with pytest.raises(ValueError, match=r"phase: expected 0 to 1 \(period 2\), got 2"):
        alternate(2)
    with pytest.raises(ValueError, match="period: expected a whole number of at least 2, got 1"):
        alternate(period=1)


@pytest.mark.parametrize("length", [1, 2, 5, 6])
@pytest.mark.parametrize("schedule", [EVERY, EVEN, ODD, FOURTH], ids=["every", "even", "odd", "fourth"])
def test_unroll_equals_a_python_loop(schedule, length):
    frames = make_frames(length, T=length, H=4, W=5)
    frames = dataclasses.replace(frames, cut=frames.cut.at[min(3, length - 1), 1].set(True))
    images, history, counts = python_loop(frames, schedule.kinds(length))
    result = compiled(schedule, keep=lambda aux: {"count": aux["count"]})(frames)
    np.testing.assert_allclose(result.image, images, rtol=1e-6, atol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), result.history, history)
    for kind in (SS, ESS):
        chosen = indices_of(schedule.kinds(length), kind)
        assert (kind in result.aux) == bool(chosen)
        if chosen:
            np.testing.assert_array_equal(result.aux[kind]["count"], jnp.stack([counts[n] for n in chosen]))


def test_options_change_neither_values_nor_gradients():
    frames = make_frames(1, T=6, H=4, W=5)

    def value_and_grad(**options):
        loss = lambda variables: jnp.sum(unroll(TOY, variables, frames, ODD, **options).image ** 2)
        return jax.jit(jax.value_and_grad(loss))(VARIABLES)

    value, gradient = value_and_grad()
    other, other_gradient = value_and_grad(remat=True)
    np.testing.assert_allclose(other, value, rtol=1e-5)
    np.testing.assert_allclose(other_gradient["mix"], gradient["mix"], rtol=1e-4)


def test_cut_resets_history():
    frames = make_frames(5, T=6, B=2, H=4, W=5)
    frames = dataclasses.replace(frames, cut=frames.cut.at[4, 0].set(True))
    image = compiled(EVEN)(frames).image
    other = dataclasses.replace(frames, color=frames.color.at[:4].multiply(3.0))  # only what lies before the cut
    changed = compiled(EVEN)(other).image
    np.testing.assert_array_equal(image[4:, 0], changed[4:, 0])
    assert float(jnp.abs(image[4:, 1] - changed[4:, 1]).min(axis=(1, 2, 3)).max()) > 0.0  # the other element has no cut


def test_extrapolated_colour_is_never_read():
    frames = make_frames(2, T=6, H=4, W=5)
    poisoned = dataclasses.replace(frames, color=frames.color.at[jnp.array([2, 4])].set(jnp.nan))
    np.testing.assert_array_equal(compiled(ODD)(poisoned).image, compiled(ODD)(frames).image)


def test_causal():
    frames = make_frames(3, T=6, H=4, W=5)
    later = dataclasses.replace(frames, color=frames.color.at[4:].add(1.0), motion=frames.motion.at[4:].add(1.0))
    a, b = (compiled(EVEN)(f).image for f in (frames, later))
    np.testing.assert_array_equal(a[:4], b[:4])
    assert float(jnp.abs(a[4:] - b[4:]).max()) > 0.1


def test_latency_is_shifted_away():
    frames = make_frames(4, T=5, H=4, W=5)
    prompt = compiled(EVERY)(frames).image
    late = compiled(EVERY, toy(latency=1))(frames).image  # toy(latency=1) claims step n shows frame n - 1
    np.testing.assert_array_equal(late[:-1], prompt[1:])
    np.testing.assert_array_equal(late[-1], prompt[-1])


def test_train_flag_reaches_the_steps():
    frames = make_frames(4, T=3, H=4, W=5)
    keep = lambda aux: aux.get("train", jnp.array(False))
    assert bool(compiled(EVERY, train=True, keep=keep)(frames).aux[SS].all())
    assert not bool(compiled(EVERY, keep=keep)(frames).aux[SS].any())


def test_unsupported_frames_and_schedules():
    frames = make_frames(0, T=4, H=4, W=5)
    message = "toy cannot extrapolate: it needs the colour of every frame. Use schedule every()"
    with pytest.raises(ValueError, match=re.escape(message)):
        unroll(toy(renders_all=True), VARIABLES, frames, EVEN)
    jax.eval_shape(lambda f: unroll(toy(renders_all=True), VARIABLES, f, EVERY), frames)
    with pytest.raises(ValueError, match=re.escape(message)):
        refuse_extrapolation("toy")({}, {}, frames)
    poor = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, roughness=None))
    with pytest.raises(ValueError, match="toy needs the buffers roughness, which these frames do not have"):
        check_supported(toy(requires=frozenset({"roughness"})), poor, (SS,))
    with pytest.raises(ValueError, match="toy needs the buffers color"):
        check_supported(toy(), without_color(frames), (SS,))


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_sixteen_bit_frames_are_refused(dtype):
    """Histories would change their type from frame to frame."""
    frames = make_frames(0, T=4, H=4, W=5)
    short = dataclasses.replace(frames, color=frames.color.astype(dtype))
    with pytest.raises(ValueError, match=f"frames, color: expected float32, got {dtype}. Cast it to float32"):
        unroll(TOY, VARIABLES, short, EVEN)
    with pytest.raises(ValueError, match=f"frames, motion: expected float32, got {dtype}. Cast it to float32"):
        check_supported(TOY, dataclasses.replace(frames, motion=frames.motion.astype(dtype)), (SS, ESS))


def test_a_baked_method_needs_no_variables():
    frames, baked = make_frames(6, T=5, H=4, W=5), bake(TOY, VARIABLES)
    assert baked.init(jax.random.key(0), at(frames, 0)) == {} and baked.info == TOY.info
    images = jax.jit(lambda frames: unroll(baked, {}, frames, EVEN).image)(frames)
    np.testing.assert_allclose(images, compiled(EVEN)(frames).image, rtol=1e-6)


def test_streaming_equals_the_rollout():
    frames = make_frames(6, T=5, H=4, W=5)
    images = streamed(TOY, VARIABLES, frames, itertools.cycle((SS, ESS)))
    np.testing.assert_allclose(images, compiled(EVEN)(frames).image, rtol=1e-6)


def test_a_stream_asks_for_a_frame_when_its_image_is_due_and_compiles_once():
    frames, asked = make_frames(6, T=5, H=4, W=5), []
    hidden = dataclasses.replace(frames, color=frames.color.at[1::2].set(jnp.nan))
    given = (asked.append(n) or at(hidden, n) for n in range(5))
    method = toy()
    images = stream(method, VARIABLES, given, EVEN.kinds(5))
    assert not asked
    first = next(images)
    assert asked == [0]
    rest = [np.asarray(image) for image in images]
    assert all(np.isfinite(image).all() for image in rest)
    again = streamed(method, VARIABLES, frames, itertools.cycle((SS, ESS)))
    np.testing.assert_allclose(again, np.stack([first, *rest]), rtol=1e-6)
    assert {kind: stream_step(method, kind)._cache_size() for kind in (SS, ESS)} == {SS: 1, ESS: 1}


def test_a_stream_says_what_its_first_frame_lacks():
    frames = make_frames(0, T=2, H=4, W=5)
    with pytest.raises(ValueError, match="toy needs the buffers color, which these frames do not have"):
        next(stream(TOY, VARIABLES, [without_color(at(frames, 0))], (SS,)))
    with pytest.raises(ValueError, match="toy cannot extrapolate: it needs the colour of every frame"):
        next(stream(toy(renders_all=True), VARIABLES, [at(frames, 0)], (ESS,)))


def test_a_rollout_goes_on_from_the_history_of_another():
    """In two parts, cut between pairs, it gives what the whole gives; a cut in the second part still forgets all."""
    frames = make_frames(3, 7, 2, 4, 6)
    frames = dataclasses.replace(frames, cut=jnp.asarray(frames.cut).at[5].set(True))
    whole = compiled(EVEN)(frames)
    first = compiled(EVEN)(select_time(frames, slice(0, 4)))
    rest = select_time(frames, slice(4, 7))
    second = jax.jit(lambda frames, history: unroll(TOY, VARIABLES, frames, EVEN, history=history))(rest, first.history)
    np.testing.assert_allclose(jnp.concatenate([first.image, second.image]), whole.image, rtol=1e-6)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), second.history, whole.history)
