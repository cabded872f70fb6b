"""Cuts inside a training clip: what is made of nothing is no target, and nothing is compared across a cut."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.exposure import exposed
from essjax.frames import Prediction
from essjax.interfaces import Network
from essjax.losses import spatio_temporal
from essjax.methods._extrass import Warped
from essjax.train import (
    dlctus_objective,
    extranet_objective,
    extrass_objective,
    fasset_objective,
    frnet_objective,
    ifrnet_objective,
)
from essjax.train.objectives import since_cut
from tests.helpers import make_sequence, random_image
from tests.train.test_objectives import Half, fake

T, B, H, W = 9, 2, 14, 18
GARBAGE = 1e4


def clip_of(*cuts):
    """A clip with cuts (frame, element), whose motion holds each frame's place in its shot; cuts are all holes."""
    clip = make_sequence(0, T=T, B=B, H=H, W=W)
    cut = clip.frames.cut
    for n, b in cuts:
        cut = cut.at[n, b].set(True)
    age = since_cut(cut)[..., None, None, None]
    frames = dataclasses.replace(clip.frames, cut=cut, motion=jnp.broadcast_to(age, (T, B, H, W, 2)) * 1.0)
    valid = jnp.where(age == 0, 0.0, clip.valid)
    return dataclasses.replace(clip, frames=frames, valid=valid)


CUTS = (3, 0), (4, 0), (6, 1)
IMAGE = random_image(1, 2 * H, 2 * W, 3)


def place(frame):
    return frame.motion[..., :1, :1, :1]


def extrass_terms(spoil):
    """Terms where ``spoil(age, kind)`` says that image and features are garbage: two flags."""

    def aux(variables, history, frame, kind):
        bad_image, bad_features = spoil(place(frame), kind)
        image = IMAGE + jnp.where(bad_image, GARBAGE, 0.0)
        valid = jnp.broadcast_to(jnp.where(place(frame) > 0, 1.0, 0.0), (*image.shape[:-1], 1))
        warped = Warped(log_image=image - 0.1, valid=valid, valid_low=valid)
        features = [jnp.where(bad_features, GARBAGE, 0.5 + kind) * jnp.ones((2, 3, 4))]
        return {"log_image": image, "warped": warped, "features": features}

    objective = extrass_objective(fake(aux), vgg_features=lambda image: [jnp.log1p(jnp.abs(image[..., ::2, ::2, :]))])
    return jax.jit(lambda clip: objective({}, clip)[0])(clip_of(*CUTS))


def test_extrass():
    good = extrass_terms(lambda age, kind: (age < 0, age < 0))
    bad = extrass_terms(lambda age, kind: ((age == 0) & (kind == 1), age < 2))
    assert set(good) == set(bad) and len(good) == 9
    for name, value in good.items():
        assert 0.005 < float(value) < 3.0, name
        np.testing.assert_allclose(bad[name], value, rtol=1e-6, err_msg=name)
    rendered = extrass_terms(lambda age, kind: ((age == 0) & (kind == 0), age < 0))
    changed = {name for name, value in good.items() if not np.isclose(rendered[name], value)}
    assert changed == {"l1_ss", "vgg_ss"}  # a cut has no holes, all is new


def fasset_terms(kind_of_garbage):
    def aux(variables, history, frame, kind):
        image = IMAGE + jnp.where((place(frame) == 0) & (kind == kind_of_garbage), GARBAGE, 0.0)
        return {"log_image": image, "valid": jnp.ones((*image.shape[:-3], H, W, 1))}

    return jax.jit(lambda clip: fasset_objective(fake(aux))({}, clip)[0])(clip_of(*CUTS))


def test_fasset():
    good, ess, ss = (fasset_terms(kind) for kind in (-1, 1, 0))
    for name, value in good.items():
        assert 0.05 < float(value) < 10.0, name
        np.testing.assert_allclose(ess[name], value, rtol=1e-6, err_msg=name)
    assert {name for name, value in good.items() if not np.isclose(ss[name], value)} == {"l1_ss", "hard_ss"}


def test_frnet_learns_from_frames_with_two_pictures():
    half, levels = random_image(2, H // 2, W // 2, 3), [random_image(3, H // 2, W // 2, 2)]

    def terms(limit):
        def aux(variables, history, frame, kind):
            times = jnp.where(place(frame) < limit, GARBAGE, 1.0)
            return {"extrapolated": Half(half * times, [level * times for level in levels])} if kind else {}

        networks = (("frnet", Network(None, lambda variables, image, method: ([image[..., :2]], {}))),)
        objective = frnet_objective(fake(aux)._replace(networks=networks))
        return jax.jit(lambda clip: objective({"frnet": 0.0}, clip)[0])(clip_of((4, 0), (3, 1)))

    good, bad, worse = terms(0), terms(3), terms(4)
    for name, value in good.items():
        assert 1e-5 < float(value) < 2.0
        np.testing.assert_allclose(bad[name], value, rtol=1e-6, err_msg=name)
        assert not np.isclose(worse[name], value)


@dataclasses.dataclass
class Mask:
    """What ``extranet_objective`` reads of ``Inputs``."""

    mask: jax.Array


jax.tree_util.register_dataclass(Mask, data_fields=["mask"], meta_fields=[])


def last_frame_terms(build, clip):
    """Of both elements, and of the second alone."""
    alone = jax.tree.map(lambda leaf: leaf[:, 1:], clip)
    return [jax.jit(lambda clip: build()({"ifrnet": 1.0}, clip)[0])(given) for given in (clip, alone)]


def extranet():
    def aux(variables, history, frame, kind):
        lead = frame.cut.shape
        image = jnp.broadcast_to(IMAGE[:H, :W], (*lead, H, W, 3))
        mask = jnp.broadcast_to(jnp.arange(W)[:, None] > 3.0, (*lead, H, W, 1)) * (place(frame) > 0)
        return {"log_shading": image, "inputs": Mask(mask * 1.0)}

    return extranet_objective(training(aux))


def ifrnet():
    def aux(variables, history, frame, kind):
        image = jnp.broadcast_to(IMAGE[:H, :W], (*frame.cut.shape, H, W, 3))
        return {"image": image, "mean": 0.0 * image[..., :1, :1, :1], "features": [image[..., :2]]}

    network = Network(None, lambda variables, image, method: ([image[..., 1:]], {}))
    return ifrnet_objective(training(aux)._replace(networks=(("ifrnet", network),)))


def training(aux):
    """``fake`` that is also stepped without ``train``, as before a clip's last frame."""
    method = fake(aux)

    def always(step):
        return lambda *given, train=False: step(*given, train=True)

    return method._replace(render_step=always(method.render_step), extrapolate_step=always(method.extrapolate_step))


@pytest.mark.parametrize(("build", "cut"), [(extranet, T - 1), (ifrnet, T - 1), (ifrnet, T - 2)])
def test_objectives_on_one_frame_leave_out_what_has_no_source(build, cut):
    both, alone = last_frame_terms(build, clip_of((cut, 0)))
    for name, value in alone.items():
        assert float(value) > 1e-4
        np.testing.assert_allclose(both[name], value, rtol=1e-5, err_msg=name)
    nothing, _ = last_frame_terms(build, clip_of((cut, 0), (cut, 1)))
    assert all(float(value) == 0.0 for value in nothing.values())


def test_dlctus_compares_nothing_across_a_cut():
    encoded = random_image(5, T, B, 2 * H, 2 * W, 3, high=1.0)

    def render_step(variables, history, frame, *, train=False):
        return history + 1, Prediction(image=encoded[history], aux={"encoded": encoded[history]})

    method = fake(lambda *_: {})._replace(render_step=render_step, start=lambda example: jnp.zeros((), jnp.int32))
    method = exposed(method)
    clip = clip_of((T - 1, 0))
    still = dataclasses.replace(clip.frames, motion=jnp.zeros_like(clip.frames.motion), jitter=clip.frames.jitter * 0)
    clip = dataclasses.replace(clip, frames=still)
    loss = dlctus_objective(method, targets=1, theta=0.5)({}, clip)[0]["spatio_temporal"]
    error, before = (encoded[n] - clip.reference[n] / (1 + clip.reference[n]) for n in (T - 1, T - 2))
    expected = jnp.stack([jnp.abs(error[0]), spatio_temporal(error[1], before[1], theta=0.5)])
    np.testing.assert_allclose(loss, expected.mean(), rtol=1e-5)
