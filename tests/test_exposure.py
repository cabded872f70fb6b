"""Pictures do not depend on the unit of radiance, and what exposure is where none is recorded."""

import dataclasses
import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.color import display
from essjax.exposure import GREY, Metered, clip_exposure, log_luminance, read_meter, start_meter
from essjax.frames import select_time, without_color
from essjax.rollout import alternate, every, unroll
from tests.helpers import make_frames, random_image

measure = jax.jit(log_luminance)
WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
SWEEP = pytest.mark.skipif(not os.environ.get("ESSJAX_SWEEP"), reason="compiles every method: ESSJAX_SWEEP=1")
METHODS = {
    "jau": methods.jau(), "warp": methods.warp(), "taau": methods.taau(), "taau-half": methods.taau_half(),
    "extrass-w": methods.extrass_w(),
}  # fmt: skip
COSTLY = {
    "tus": methods.tus(), "taa": methods.taa(), "bsr": methods.bsr(), "ifrnet": methods.ifrnet(width=4),
    "dlctus": methods.dlctus(), "fasset": methods.fasset(width=4, hidden=8), "3d-warp": methods.warp_3d(),
    "extrass-e": methods.extrass_e(width=8), "extrass": methods.extrass(width=8, frnet_width=8),
    "classifier": methods.classifier(width=8, composition_width=4), "nsrr": methods.nsrr(width=4),
    "extranet": methods.extranet(), "extranet-plus": methods.extranet_plus(),
    "extranet+nsrr": methods.extranet_nsrr(width=4), "nsrr+extranet": methods.nsrr_extranet(width=4),
    "ifrnet+taa": methods.with_taa(methods.ifrnet(width=4)),
}  # fmt: skip
EVERY = [*METHODS, *(pytest.param(name, marks=SWEEP) for name in COSTLY)]


@functools.cache
def runner(name):
    """A method's rollout, its variables, and frames (a cut at 3) whose exposure changes from frame to frame."""
    method = {**METHODS, **COSTLY}[name]
    frames = make_frames(3, T=5, H=14, W=18)
    exposure = jnp.asarray(np.random.default_rng(1).uniform(0.5, 2.0, frames.cut.shape), jnp.float32)
    frames = dataclasses.replace(frames, exposure=exposure, cut=frames.cut.at[3, 1].set(True))
    schedule = every() if method.info.renders_all else alternate(0)
    run = jax.jit(lambda variables, frames: unroll(method, variables, frames, schedule).image)
    return run, method.init(jax.random.key(0), select_time(frames, 0)), frames


def in_unit(frames, unit, *, recorded=True):
    """The frames as another renderer stores them: radiance times ``unit``."""
    exposure = frames.exposure / unit if recorded else None
    return dataclasses.replace(frames, color=frames.color * unit, exposure=exposure)


@pytest.mark.parametrize("name", EVERY)
def test_pictures_do_not_depend_on_the_unit(name):
    run, variables, frames = runner(name)
    image = np.asarray(run(variables, frames))
    assert np.ptp(image) > 0.1
    for unit in (2.0**-10, 2.0**13):  # powers of two round nothing: what differs comes from a constant in radiance
        np.testing.assert_array_equal(run(variables, in_unit(frames, unit)) / unit, image)


@pytest.mark.parametrize("name", ["taau-half", pytest.param("extrass", marks=SWEEP)])
def test_pictures_do_not_depend_on_the_unit_where_exposure_is_metered(name):
    run, variables, frames = runner(name)
    images = [run(variables, in_unit(frames, unit, recorded=False)) / unit for unit in (1.0, 1e-3, 1e4)]
    for image in images[1:]:
        np.testing.assert_allclose(display(image), display(images[0]), atol=1e-3)


@pytest.mark.parametrize("name", EVERY)
def test_radiance_stays_when_exposure_changes(name):
    """A room of one colour and material at a changing exposure: untrained methods show it as at a constant one."""
    run, variables, frames = runner(name)
    buffers = frames.gbuffers
    paint = {"base_color": jnp.full_like(buffers.base_color, 0.5), "metallic": jnp.zeros_like(buffers.metallic)}
    buffers = dataclasses.replace(buffers, depth=jnp.where(jnp.isfinite(buffers.depth), buffers.depth, 30.0), **paint)
    cut = frames.cut.at[3].set(False)  # it would show base colour at the exposure
    white = dataclasses.replace(frames, color=jnp.full_like(frames.color, 0.6), gbuffers=buffers, cut=cut)
    images = [run(variables, dataclasses.replace(white, exposure=e)) for e in (white.exposure, white.exposure * 0 + 1)]
    np.testing.assert_allclose(images[0], images[1], rtol=0.05)  # networks see the exposure


def test_log_luminance_by_hand():
    color = jnp.asarray(np.array([[[0.1, 0.4, 0.2], [3.0, 1.0, 0.5]]]), jnp.float32)
    luminance = np.asarray(color[0], np.float64) @ WEIGHTS
    weight = luminance / (luminance + 0.01 * luminance.mean())
    mean, lit = measure(color)
    np.testing.assert_allclose(mean, (weight * np.log(luminance)).sum() / weight.sum(), rtol=1e-5)
    assert bool(lit)


def test_log_luminance_follows_the_unit_and_minds_neither_black_nor_undefined_pixels():
    image = random_image(0, 2, 7, 9, 3, low=0.2)
    mean, _ = measure(image)
    for unit in (1e-3, 1e4):
        np.testing.assert_allclose(measure(image * unit)[0], mean + np.log(unit), atol=1e-4)
    night = jnp.concatenate([image, jnp.zeros((2, 7, 91, 3))], axis=-2)  # nine tenths are black
    np.testing.assert_allclose(measure(night)[0], mean, atol=0.2)
    broken = jnp.concatenate([image, jnp.array([jnp.nan, jnp.inf, -1.0, 0.0, 0.0, 0.0, 0.0])[:, None, None]
                              * jnp.ones((2, 7, 1, 3))], axis=-2)  # fmt: skip
    np.testing.assert_allclose(measure(broken)[0], mean, atol=0.05)
    mean, lit = measure(jnp.zeros((3, 4, 3)))
    assert float(mean) == 0.0 and not bool(lit)


def test_exposure_of_a_clip():
    flat = (
        jnp.ones((4, 6, 3)) * jnp.array([2.0, 0.0, 8.0, 0.5])[:, None, None, None]
    )  # [T, H, W, 3], one frame is black
    np.testing.assert_allclose(clip_exposure(flat), GREY / 2.0, rtol=1e-5)
    assert clip_exposure(np.zeros((2, 4, 6, 3), np.float32)) == 1.0
    exposure = clip_exposure(random_image(1, 3, 5, 7, 3))
    np.testing.assert_allclose(clip_exposure(random_image(1, 3, 5, 7, 3) * 1e4), exposure * 1e-4, rtol=1e-4)


def test_meter_averages_the_rendered_frames_of_a_shot():
    values = np.array([[2.0, 1.0], [8.0, 0.0], [5.0, 5.0], [0.5, 4.0], [3.0, 9.0]])  # [T, B]; frame 2 is not rendered
    cuts = np.array([[1, 1], [0, 0], [0, 1], [0, 0], [1, 0]], bool)
    expected = [[2.0, 1.0], [4.0, 1.0], [4.0, 1.0], [2.0, 4.0], [3.0, 6.0]]  # geometric means
    frames = make_frames(0, T=5, B=2, H=5, W=7)
    frames = dataclasses.replace(
        frames, color=jnp.ones_like(frames.color) * values[..., None, None, None], cut=jnp.asarray(cuts), exposure=None
    )
    meter, read = start_meter(select_time(frames, 0)), jax.jit(read_meter)
    np.testing.assert_allclose(GREY * np.exp(-np.asarray(meter.log_mean)), 1.0, rtol=1e-6)
    for n in range(5):
        frame = select_time(frames, n)
        meter, exposure = read(meter, without_color(frame) if n == 2 else frame)
        np.testing.assert_allclose(exposure, GREY / np.array(expected[n]), rtol=1e-4)


def test_a_recorded_exposure_has_no_meter():
    frame = select_time(make_frames(0, T=1, H=6, W=8), 0)
    method, unknown = METHODS["taau"], dataclasses.replace(frame, exposure=None)
    history = method.start(unknown)
    assert isinstance(history, Metered)
    assert jax.tree.structure(method.start(frame)) == jax.tree.structure(history.history)


def test_history_is_radiance():
    """What taau remembers of a frame at exposure 4 is that frame, not four times it."""
    method, frame = METHODS["taau"], select_time(make_frames(0, T=1, H=6, W=8), 0)
    frame = dataclasses.replace(frame, exposure=jnp.full_like(frame.exposure, 4.0))
    history, prediction = jax.jit(method.render_step)({"alpha": 0.7, "sigma": 0.8}, method.start(frame), frame)
    np.testing.assert_array_equal(history["color"], prediction.image)
    np.testing.assert_array_equal(prediction.aux["exposure"], frame.exposure)
    assert float(prediction.image.mean()) == pytest.approx(float(frame.color.mean()), rel=0.3)
