"""The objectives on fake methods whose steps say what they were given: order of frames, and every term by NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.exposure import exposed
from essjax.frames import Prediction, select_time
from essjax.interfaces import Method, MethodInfo, Network, reset_at_cut
from essjax.losses import census, feature_census
from essjax.methods._extrass import Warped
from essjax.rollout import ESS, SS
from essjax.train import Recurrent, every_phase, extrass_objective, frnet_objective, whole_periods
from essjax.train.objectives.common import follow_every_phase, since_cut, start_every_phase
from tests.helpers import make_sequence, random_image

T, B, H, W = 5, 2, 14, 18


def numbered(T):
    """A clip whose motion holds the frame's number."""
    clip = make_sequence(0, T=T, B=B, H=H, W=W)
    numbers = jnp.arange(T, dtype=jnp.float32)[:, None, None, None, None]
    motion = jnp.broadcast_to(numbers, clip.frames.motion.shape)
    return dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, motion=motion))


def fake(step_aux):
    """A method whose history is ``[frame, kind]`` of the step before, -1 after a cut; ``step_aux`` makes its aux."""

    def start(example):
        return jnp.full((*example.cut.shape, 2), -1.0)

    def step(kind):
        def run(variables, history, frame, *, train=False):
            assert train and (frame.color is not None) == (kind == 0)
            history = reset_at_cut(frame.cut, start(frame), history)
            number = frame.motion[..., 0, 0, 0]
            aux = step_aux(variables, history, frame, kind)
            image = jnp.zeros((*frame.motion.shape[:-1], 3))
            return jnp.stack([number, jnp.full_like(number, kind)], axis=-1), Prediction(image=image, aux=aux)

        return run

    return exposed(Method(lambda key, example: {}, start, step(0), step(1), MethodInfo("fake", 1)))


def said(variables, history, frame, kind):
    """What a step was given: its frame's number, its kind, the history."""
    number = frame.motion[..., 0, 0, 0]
    return {"frame": number, "kind": jnp.full_like(number, kind), "before": history}


@pytest.mark.parametrize(("length", "period"), [(3, 2), (7, 2), (5, 3), (11, 3), (11, 4)])
def test_every_phase_gives_each_frame_once_per_distance_in_order(length, period):
    phases = []

    @jax.jit
    def run(clip):
        phases.extend(every_phase(fake(said), {}, clip, lambda aux: aux, period=period)[0])
        return [phase.kept for phase in phases]

    found = run(numbered(length))
    assert [(phase.distance, phase.kind) for phase in phases] == [(d, ESS if d else SS) for d in range(period)]
    for d, (phase, kept) in enumerate(zip(phases, found, strict=True)):
        frames = np.arange(d, d + length - period + 1)
        np.testing.assert_array_equal(np.arange(length)[phase.frames], frames)
        for b in range(B):
            np.testing.assert_array_equal(kept["frame"][:, b], frames)
            np.testing.assert_array_equal(kept["kind"][:, b], min(d, 1))
            # The schedule's history: rendered frames follow the last extrapolated one, all others a frame later.
            expected = np.stack([frames - 1, np.full_like(frames, d != 1)], axis=-1)
            if d == 0:
                expected[:period] = -1  # the runs start there, without history
            np.testing.assert_array_equal(kept["before"][:, b], expected)


@pytest.mark.parametrize(("length", "period", "fitting"), [(1, 2, 0), (2, 2, 0), (4, 2, 3), (4, 3, 0), (10, 3, 8)])
def test_clips_that_do_not_fit_are_cut_or_refused(length, period, fitting):
    message = f"clip: expected {period - 1} frames and a multiple of {period} .*, got {length}"
    with pytest.raises(ValueError, match=message):
        every_phase(fake(lambda *_: {}), {}, numbered(length), lambda aux: aux, period=period)
    if fitting:
        assert whole_periods(numbered(length), period=period).reference.shape[0] == fitting
    else:
        with pytest.raises(ValueError, match=f"clip: expected at least {2 * period - 1} frames .*, got {length}"):
            whole_periods(numbered(length), period=period)


def follow(objective, windows, step):
    """Terms of clips that follow each other in ``numbered``: window k begins at frame k * step."""
    length = step + objective.period - 1
    whole = numbered(step * (windows - 1) + length)
    parts = [select_time(whole, slice(k * step, k * step + length)) for k in range(windows)]
    history, found, run = objective.start(parts[0]), [], jax.jit(objective.follow)
    for number, part in enumerate(parts):
        cut = part.frames.cut.at[0].set(number == 0)
        part = dataclasses.replace(part, frames=dataclasses.replace(part.frames, cut=cut))
        terms, _, history = run({}, part, history)
        found.append(terms)
    return found


@pytest.mark.parametrize("period", [2, 3])
def test_all_runs_go_on_where_the_clip_before_ended(period):
    """Every frame has the history that one long clip gives it."""
    method = fake(said)

    def follow_it(variables, clip, history):
        phases, state, history = follow_every_phase(method, variables, clip, lambda aux: aux, history, period=period)
        return [phase.kept for phase in phases], state, history

    recurrent = Recurrent(lambda clip: start_every_phase(method, clip, period=period), follow_it, period)
    (whole,) = follow(recurrent, 1, 12)
    for number, part in enumerate(follow(recurrent, 2, 6)):
        expected = jax.tree.map(lambda leaf, first=6 * number: leaf[first : first + 6], whole)
        jax.tree.map(np.testing.assert_array_equal, part, expected)


IMAGES = {kind: random_image(40 + kind, 2 * H, 2 * W, 3) for kind in (0, 1)}
HISTORIES = {kind: random_image(50 + kind, 2 * H, 2 * W, 3) for kind in (0, 1)}
VALID = {kind: random_image(60 + kind, 2 * H, 2 * W, 1, high=1.0) < 0.7 for kind in (0, 1)}
FEATURES = {kind: [random_image(70 + 2 * kind + level, 4, 5, 3) for level in (0, 1)] for kind in (0, 1)}


def with_frame(pattern, frame):
    """The same pattern for both elements, made brighter with the frame's number."""
    return pattern * (1.0 + 0.1 * frame.motion[..., :1, :1, :1])


def extrass_aux(variables, history, frame, kind):
    valid = jnp.broadcast_to(VALID[kind].astype(jnp.float32), (*frame.cut.shape, 2 * H, 2 * W, 1))
    warped = Warped(log_image=with_frame(HISTORIES[kind], frame), valid=valid, valid_low=valid)
    features = [with_frame(level, frame) for level in FEATURES[kind]]
    return {"log_image": with_frame(IMAGES[kind], frame), "warped": warped, "features": features}


def seen(color):
    """x / (1 + x), then the sRGB curve of IEC 61966-2-1."""
    bounded = np.asarray(color, np.float64) / (1.0 + np.asarray(color, np.float64))
    return np.where(bounded <= 0.0031308, 12.92 * bounded, 1.055 * bounded ** (1.0 / 2.4) - 0.055)


def weighted(values, mask):
    mask = np.broadcast_to(mask, values.shape)
    return np.sum(values * mask) / np.sum(mask)


@pytest.mark.parametrize(("exact_masks", "period"), [(True, 2), (False, 3)])
def test_extrass_terms_equal_numpy(exact_masks, period):
    clip = numbered(T)
    clip = clip if exact_masks else dataclasses.replace(clip, valid=None)
    vgg = lambda image: [image[..., ::2, ::2, :], 3.0 * image[..., :1]]
    options = {"occlusion_weight": 2.0, "vgg_weight": 0.5, "temporal_weight": 3.0, "vgg_features": vgg}
    terms, _ = jax.jit(extrass_objective(fake(extrass_aux), period=period, **options))({}, clip)

    count = T - period + 1
    expected = {"features": 0.0}
    for distance in range(period):
        kind, name, share = min(distance, 1), ESS if distance else SS, 1 / max(period - 1, 1) if distance else 1.0
        frames = np.arange(distance, distance + count)
        number = np.repeat(frames, B).reshape(count, B, 1, 1, 1)
        brightness, weight = 1.0 + 0.1 * number, (number + 1) / 8.0
        reference = np.asarray(clip.reference[frames])
        target = seen(reference)
        colors = [np.expm1(np.asarray(pattern[kind]) * brightness) for pattern in (IMAGES, HISTORIES)]
        image, history = map(seen, colors)
        own = np.broadcast_to(np.asarray(VALID[kind], np.float64), (count, B, 2 * H, 2 * W, 1))
        valid = np.repeat(np.repeat(clip.valid[frames], 2, axis=2), 2, axis=3) if exact_masks else own
        hole = weight * (1.0 - valid) * (number > 0)
        difference = colors[0] - reference
        levels = difference[..., ::2, ::2, :], 3.0 * difference[..., :1]
        found = {
            "l1": weighted(np.abs(image - target), weight),
            "occlusion": 2.0 * weighted(np.abs(image - target), hole),
            "temporal": 3.0 * weighted(np.abs(image - history), weight * own),
            "vgg": 0.5 * sum(weighted(level**2, weight) for level in levels),
        }
        for term, value in found.items():
            expected[f"{term}_{name}"] = expected.get(f"{term}_{name}", 0.0) + share * value
    # Frames that are there in every phase, but for those that begin a run as SS.
    common = np.arange(period, count)
    for a, b in zip(FEATURES[0], FEATURES[1], strict=True):
        if len(common):
            weight = ((common + 1) / 8.0).reshape(-1, 1, 1, 1, 1)
            brightness = 1.0 + 0.1 * common.reshape(-1, 1, 1, 1, 1)
            expected["features"] += 3.0 * weighted(np.abs(a - b) * brightness, weight)
    assert set(terms) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-4, err_msg=name)


def test_frames_since_a_cut():
    cut = jnp.array([[False, True], [False, False], [True, False], [False, True]])
    since = np.asarray(since_cut(cut))
    assert (since[:2, 0] > 1000).all()
    np.testing.assert_array_equal(since[2:, 0], [0, 1])
    np.testing.assert_array_equal(since[:, 1], [0, 1, 2, 0])


def test_a_frame_counts_the_more_the_longer_its_shot_has_lasted():
    """(n + 1) / 8 for frame n of a start; all alike in the clip that follows it."""
    reference = seen(numbered(17).reference)
    for number, terms in enumerate(follow(extrass_objective(fake(extrass_aux)), 2, 8)):
        frames = np.arange(8) + 8 * number
        images = np.asarray(IMAGES[0]) * (1.0 + 0.1 * frames).reshape(8, 1, 1, 1, 1)
        errors = np.abs(seen(np.expm1(images)) - reference[frames]).mean(axis=(1, 2, 3, 4))
        weight = np.minimum((frames + 1) / 8, 1.0)
        np.testing.assert_allclose(terms["l1_ss"], np.sum(weight * errors) / np.sum(weight), rtol=1e-5)


@pytest.mark.parametrize(("length", "expected"), [(3, 0.0), (7, 3.0)])
def test_features_are_compared_where_both_encoders_see_history(length, expected):
    """E0's are 9 where there is no history (frames 0 and 1), else 1; E1's are 0. Of three frames none is left."""

    def aux(variables, history, frame, kind):
        value = jnp.where(history[..., 0] < 0, 9.0, 1.0) * (1 - kind)
        level = jnp.broadcast_to(value[..., None, None, None], (*value.shape, 2, 3, 4))
        return {**extrass_aux(variables, history, frame, kind), "features": [level]}

    terms, _ = jax.jit(extrass_objective(fake(aux), temporal_weight=3.0))({}, numbered(length))
    np.testing.assert_allclose(terms["features"], expected, rtol=1e-6)


def test_without_vgg_there_is_no_such_term():
    terms, _ = jax.eval_shape(extrass_objective(fake(extrass_aux)), {}, numbered(3))
    assert not any(name.startswith("vgg") for name in terms)


@dataclasses.dataclass
class Half:
    """What ``frnet_objective`` reads of an ``Extrapolated``."""

    half: jax.Array
    features: list


jax.tree_util.register_dataclass(Half, data_fields=["half", "features"], meta_fields=[])
HALF = random_image(80, H // 2, W // 2, 3)
LEVELS = [random_image(81 + level, H // 2, W // 2, 2) for level in (0, 1)]


@pytest.mark.parametrize(("length", "first"), [(3, 1), (5, 3), (7, 3)])
def test_frnet_terms_equal_numpy(length, first):
    """From frame 3 on, where the two rendered frames differ, if there is such a frame; the last frame counts too."""

    def aux(variables, history, frame, kind):
        if kind == 0:
            return {}
        return {"extrapolated": Half(with_frame(HALF, frame), [with_frame(level, frame) for level in LEVELS])}

    def encode(variables, image, method=None):
        assert method == "encode"
        return [variables * image[..., :2], image[..., 1:] ** 2], {}

    clip = numbered(length)
    method = fake(aux)._replace(networks=(("frnet", Network(None, encode)),))
    objective = frnet_objective(method, feature_weight=0.5)
    terms, _ = jax.jit(objective)({"frnet": jnp.float32(2.0)}, clip)

    scored = np.arange(first, length)
    brightness = np.repeat(1.0 + 0.1 * scored, B).reshape(len(scored), B, 1, 1, 1)
    color = np.asarray(clip.frames.color[first:]).reshape(len(scored), B, H // 2, 2, W // 2, 2, 3)
    target = np.log1p(color.mean(axis=(3, 5)))
    half = np.asarray(HALF) * brightness
    np.testing.assert_allclose(terms["charbonnier"], np.sqrt((half - target) ** 2 + 1e-6).mean(), rtol=1e-4)
    np.testing.assert_allclose(terms["census"], np.mean(census(half, target)), rtol=1e-3)  # has its own oracle
    predicted = [np.asarray(level) * brightness for level in LEVELS]
    truth = [2.0 * target[..., :2], target[..., 1:] ** 2]
    distance = sum(np.mean(feature_census(a, b)) for a, b in zip(predicted, truth, strict=True))
    np.testing.assert_allclose(terms["feature_census"], 0.5 * distance, rtol=1e-3)
    assert set(terms) == {"charbonnier", "census", "feature_census"}
