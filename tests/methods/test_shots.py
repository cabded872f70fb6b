"""What every method promises: nothing crosses a cut, and nothing of history is left where a frame is reactive."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import reinhard
from essjax.frames import select_time, without_color
from essjax.methods.shots import unlit, within_shots
from essjax.rollout import ESS, SS, alternate, every
from tests.helpers import make_frames, random_image

T, H, W = 6, 12, 18
METHODS = {
    "bicubic": methods.bicubic(),
    "bilinear": methods.bilinear(),
    "bsr": methods.bsr(),
    "classifier": methods.classifier(width=8, composition_width=4),
    "dlctus": methods.dlctus(),
    "extranet": methods.extranet(),
    "extranet_nsrr": methods.extranet_nsrr(width=4),
    "extranet_plus": methods.extranet_plus(),
    "extrass": methods.extrass(width=8, frnet_width=4),
    "extrass_e": methods.extrass_e(width=4),
    "extrass_w": methods.extrass_w(),
    "fasset": methods.fasset(width=4, hidden=8),
    "ifrnet": methods.ifrnet(width=4),
    "jau": methods.jau(),
    "nsrr": methods.nsrr(width=4),
    "nsrr_extranet": methods.nsrr_extranet(width=4),
    "taa": methods.taa(),
    "taau": methods.taau(),
    "taau_half": methods.taau_half(),
    "tus": methods.tus(),
    "warp": methods.warp(),
    "warp_3d": methods.warp_3d(),
    "with_taa": methods.with_taa(methods.warp()),
    "with_taa, late": methods.with_taa(methods.warp_3d()),
}
NO_METHODS = {
    "composed", "extranet_from_torch", "gaussian_blur", "jau_image", "load", "make", "save", "settled",
}  # fmt: skip


def test_every_method_is_tested():
    assert set(methods.__all__) - NO_METHODS == set(METHODS) - {"with_taa, late"}


@functools.cache
def busy(name):
    """Variables in which nothing is zero, so that all that a network sees reaches its output, without ``init``."""
    frame = select_time(mixed([0] * T, [0]), 0)
    shapes = jax.eval_shape(METHODS[name].init, jax.random.key(0), frame)
    if len(jax.tree.leaves(shapes)) <= 2:  # settings, no network
        return METHODS[name].init(jax.random.key(0), frame)
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        noise = rng.uniform(-1.0, 1.0, leaf.shape) * 2.0 / np.sqrt(np.prod(leaf.shape[:-1]))
        around = {"kernel": 0.0, "bias": 0.0, "mean": 0.0}.get(path[-1].key, 1.0)
        return jnp.asarray(around + (noise if path[-1].key == "kernel" else 0.05 * noise), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


@functools.cache
def steps(name):
    """One program per kind, for all positions of a cut."""
    method = METHODS[name]
    compiled = {SS: method.render_step, ESS: method.extrapolate_step}
    return {
        kind: jax.jit(lambda *given, step=step: (lambda r: (r[0], r[1].image))(step(*given)))
        for kind, step in compiled.items()
    }


def schedules(name):
    return [every()] if METHODS[name].info.renders_all else [alternate(0), alternate(1)]


def run(name, frames, kinds):
    """Images ``[T, B, h, w, 3]``, those of a method that lags at the frames that they show."""
    method, variables = METHODS[name], busy(name)
    history, images = method.start(select_time(frames, 0)), []
    for n, kind in enumerate(kinds):
        frame = select_time(frames, n)
        history, image = steps(name)[kind](variables, history, frame if kind == SS else without_color(frame))
        images.append(np.asarray(image))
    late = method.info.latency
    return np.stack(images[late:] + images[-1:] * late)


@functools.cache
def scene(seed):
    """Frames of one scene: smooth motion, surfaces that are found again in part, and masks of zeros."""
    frames = make_frames(seed, T=T, B=1, H=H, W=W)
    sky = ~jnp.isfinite(frames.gbuffers.depth)
    gbuffers = dataclasses.replace(
        frames.gbuffers,
        depth=jnp.where(sky, jnp.inf, random_image(seed + 1, T, 1, H, W, 1, low=5.0, high=5.3)),
        normal=jnp.zeros_like(frames.gbuffers.normal),
        world_position=None,
        stencil=None,
    )
    return dataclasses.replace(
        frames,
        gbuffers=gbuffers,
        reactive=jnp.zeros_like(gbuffers.depth),
        jitter=random_image(seed + 2, T, 1, 2, low=-0.5, high=0.499),
        exposure=jnp.full_like(frames.exposure, 0.5),
        camera=None,
    )


def mixed(sources, cuts):
    """A batch of one: frame n of scene ``sources[n]``, cuts at ``cuts``."""
    frames = jax.tree.map(lambda *leaves: jnp.stack([leaf[n] for n, leaf in enumerate(leaves)]), *map(scene, sources))
    return dataclasses.replace(frames, cut=jnp.isin(jnp.arange(T), jnp.array(cuts))[:, None])


def batch(elements):
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *elements)


POSITIONS = range(1, T)


@functools.cache
def everything():
    """One batch for all that is asked below, so that every method is compiled and run once: four groups of cuts at each
    frame, after which it is always scene 3, and two of masks of ones in each frame."""
    before = [[mixed([s] * n + [3] * (T - n), [0, n]) for n in POSITIONS] for s in (1, 2)]
    spoiled = [poisoned(frames, n) for frames, n in zip(before[1], POSITIONS, strict=True)]
    again = [mixed([2] * n + [3] * (T - n), [0, n, n + 1]) for n in POSITIONS]
    masked = [[reactive(mixed([s] * n + [3] * (T - n), [0]), n) for n in POSITIONS] for s in (1, 2)]
    return batch([element for group in (*before, spoiled, again, *masked) for element in group])


def reactive(frames, n):
    """Frame n with a mask of ones; frame 0 with the depth of scene 1, whose median is the unit of depth from there."""
    gbuffers = dataclasses.replace(frames.gbuffers, depth=frames.gbuffers.depth.at[0].set(scene(1).gbuffers.depth[0]))
    return dataclasses.replace(frames, gbuffers=gbuffers, reactive=frames.reactive.at[n].set(1.0))


def poisoned(frames, count):
    """The first frames hold pixels that are no number, the worst that could be left over."""
    spot = jnp.arange(H)[:, None, None] % 3 == 0
    return dataclasses.replace(
        frames, color=frames.color.at[:count].set(jnp.where(spot, jnp.nan, frames.color[:count]))
    )


@functools.cache
def images(name):
    """The kinds of each schedule with its images ``[T, group, position, h, w, 3]``."""
    found = []
    for schedule in schedules(name):
        result = run(name, everything(), schedule.kinds(T))
        found.append((schedule.kinds(T), result.reshape(T, 6, len(POSITIONS), *result.shape[2:])))
    return found


@pytest.mark.parametrize("name", METHODS)
def test_nothing_crosses_a_cut(name):
    """Cut at each frame, both parities: what came before was scene 1, scene 2, or scene 2 with NaN in it.

    The fourth group calls the frame behind frame n a cut too, which says nothing new where frame n is not rendered: its
    shot begins when something is.
    """
    last = T - METHODS[name].info.latency  # the image of the last frame is still due
    for kinds, shown in images(name):
        for k, n in enumerate(POSITIONS):
            first, second, spoiled, again = shown[n:last, :4, k].swapaxes(0, 1)
            assert np.all(np.isfinite(first)), n
            np.testing.assert_array_equal(second, first)
            np.testing.assert_array_equal(spoiled, first)
            assert np.any(shown[:n, 0, k] != shown[:n, 1, k])
            if kinds[n] == ESS:
                np.testing.assert_array_equal(again[1:], first[1:])


def test_a_metered_exposure_crosses_no_cut_either():
    """Without a recorded exposure: from the first rendered frame on; before that only the last exposure is known."""
    frames = dataclasses.replace(everything(), exposure=None)
    for schedule in schedules("taau_half"):
        kinds = schedule.kinds(T)
        shown = run("taau_half", frames, kinds)
        shown = shown.reshape(T, 6, len(POSITIONS), *shown.shape[2:])
        for k, n in enumerate(POSITIONS):
            start = n + (kinds[n] == ESS)
            np.testing.assert_array_equal(shown[start:, 1, k], shown[start:, 0, k])
            np.testing.assert_array_equal(shown[start:, 2, k], shown[start:, 0, k])


@pytest.mark.parametrize("name", METHODS)
def test_a_shot_without_a_rendered_frame_shows_its_base_colour(name):
    method = METHODS[name]
    for kinds, shown in images(name):
        for k, n in enumerate(POSITIONS):
            if kinds[n] == ESS:
                # One that lags waits for the next rendered frame, unless that belongs to another shot.
                got = shown[n, 3 if method.info.latency else 0, k]
                expected = unlit(select_time(mixed([3] * T, [n]), n), method.info.scale)[0]
                assert np.ptp(expected) > 1.5
                if n < T - 1 or not method.info.latency:
                    error = reinhard(got) - reinhard(expected)
                    # TAA moves what it is shown from its samples to the pixels' centres.
                    assert np.abs(error).max() < (0.6 if "taa" in name and method.info.native else 1e-5)


@pytest.mark.parametrize("name", METHODS)
def test_a_mask_of_ones_leaves_nothing_of_history_in_a_rendered_frame(name):
    for kinds, shown in images(name):
        for k, n in enumerate(POSITIONS):
            if kinds[n] == SS and n < T - METHODS[name].info.latency:
                np.testing.assert_array_equal(shown[n, 5, k], shown[n, 4, k])
                assert np.any(shown[n - 1, 5, k] != shown[n - 1, 4, k])


@pytest.mark.parametrize("name", ["extranet_nsrr", "fasset", "nsrr_extranet", "taau_half"])
def test_nothing_comes_along_a_path_through_a_reactive_frame(name):
    """The mask is on an extrapolated frame: the next rendered one follows its motion through it."""
    for kinds, shown in images(name):
        for k, n in enumerate(POSITIONS[:-1]):
            if kinds[n] == ESS:
                np.testing.assert_array_equal(shown[n + 1, 5, k], shown[n + 1, 4, k])
                assert np.any(shown[n, 5, k] != shown[n, 4, k]) == (name != "fasset")  # to FASSET all is a hole


def test_extrass_extrapolates_reactive_pixels_without_its_last_output():
    variables, frames = busy("extrass"), everything()
    second = select_time(frames, 1)
    second = dataclasses.replace(without_color(second), cut=second.cut & False)
    history, _ = steps("extrass")[SS](
        variables, METHODS["extrass"].start(select_time(frames, 0)), select_time(frames, 0)
    )
    other = dataclasses.replace(history, shown=history.shown + 1.0)
    for reactive, same in ((0.0, False), (1.0, True)):
        given = dataclasses.replace(second, reactive=jnp.full_like(second.reactive, reactive))
        first, changed = (steps("extrass")[ESS](variables, h, given)[1] for h in (history, other))
        assert np.array_equal(first, changed, equal_nan=True) == same


def test_a_method_that_lags_is_refused():
    with pytest.raises(ValueError, match="within_shots: expected a method without latency, got bsr"):
        within_shots(methods.bsr())


@pytest.mark.parametrize("name", ["extranet", "taau_half"])
def test_masks_come_with_every_frame_or_with_none(name):
    first, second = (select_time(scene(1), n) for n in range(2))
    history = METHODS[name].start(dataclasses.replace(first, reactive=None))
    with pytest.raises(ValueError, match="reactive: expected a mask in every frame or in none, got one after others"):
        METHODS[name].extrapolate_step({}, history, without_color(second))


def test_without_base_colour_it_is_black():
    frame = select_time(scene(1), 2)
    bare = dataclasses.replace(frame, gbuffers=dataclasses.replace(frame.gbuffers, base_color=None))
    np.testing.assert_array_equal(unlit(bare, 2), np.zeros((1, 2 * H, 2 * W, 3)))
    np.testing.assert_allclose(unlit(frame), frame.gbuffers.base_color / 0.5)
