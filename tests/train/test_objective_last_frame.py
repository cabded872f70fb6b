"""Objectives on one frame of a clip, NSRR's and IFRNet's: which frame, from which history, and every term by NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from essjax.color import display
from essjax.exposure import exposed
from essjax.frames import Prediction
from essjax.interfaces import Method, MethodInfo, Network
from essjax.losses import census, feature_census
from essjax.train import ifrnet_objective, nsrr_objective
from tests.helpers import make_sequence, random_image

T, B, H, W = 6, 2, 14, 18
STATE = {"fake": {"batch_stats": {}}}


def clip_of(length=T):
    return make_sequence(0, T=length, B=B, H=H, W=W)


def fake(aux, seen):
    """A method whose history counts its steps; ``seen`` collects which were traced."""

    def start(example):
        return jnp.zeros(example.cut.shape)

    def step(kind):
        def run(variables, history, frame, *, train=False):
            assert (frame.color is not None) == (kind == "ss")
            seen.append((kind, train))
            image = jnp.zeros((*frame.motion.shape[:-1], 3))
            return history + 1, Prediction(image=image, aux=aux(variables, history + 1), state=STATE)

        return run

    return exposed(Method(lambda key, example: {}, start, step("ss"), step("ess"), MethodInfo("fake", 1)))


def test_nsrr_terms_equal_skimage():
    image = random_image(1, B, 2 * H, 2 * W, 3, high=1.0)
    seen = []

    def aux(variables, history):
        return {"display_image": variables["nsrr"] * image * history[:, None, None, None]}

    clip = clip_of()
    variables = {"nsrr": jnp.float32(0.2)}  # times 5 frames: the image
    terms, state = jax.jit(nsrr_objective(fake(aux, seen)))(variables, clip)
    assert (
        set(seen[:-1]) == {("ss", False)}
        and seen[-1] == ("ss", True)
        and state == STATE
        and set(terms) == {"dissimilarity"}
    )
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
    target = np.asarray(display(clip.reference[-1]))
    expected = [structural_similarity(np.asarray(image[b]), target[b], channel_axis=-1, **options) for b in range(B)]
    np.testing.assert_allclose(terms["dissimilarity"], 1.0 - np.mean(expected), atol=1e-4)


@pytest.mark.parametrize(("length", "rendered"), [(6, 4), (11, 5)])
def test_nsrr_on_half_of_the_frames(length, rendered):
    """Of 6 frames 0, 1, 3, 5 are rendered, of the last 9 of 11 every other one."""
    image, seen = random_image(1, B, 2 * H, 2 * W, 3, high=1.0), []

    def start(example):
        return jnp.zeros(example.cut.shape)

    def step(kind):
        def run(variables, history, frame, *, train=False):
            seen.append((kind, train))
            return history + (kind == "ss"), Prediction(image=image, aux={"display_image": history})

        return run

    method = exposed(Method(lambda key, example: {}, start, step("ss"), step("ess"), MethodInfo("fake", 1)))
    clip = clip_of(length)
    counted = {}

    def similarity(shown, target):
        counted["before"] = shown
        np.testing.assert_array_equal(target, display(clip.reference[-1]))
        return jnp.zeros(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("essjax.train.objectives.nsrr.ssim_map", similarity)
        nsrr_objective(method, half=True)({}, clip)
    np.testing.assert_array_equal(counted["before"], rendered - 1)
    assert seen[-1] == ("ss", True) and ("ess", False) in seen


def test_nsrr_perceptual_term_is_on_radiance():
    reference = clip_of().reference[-1]

    def aux(variables, history):
        return {"display_image": jnp.zeros((B, 2 * H, 2 * W, 3))}

    def larger(method):  # the fake's image is 0, at the reference's size
        def step(variables, history, frame, *, train=False):
            history, prediction = method.render_step(variables, history, frame, train=train)
            return history, dataclasses.replace(prediction, image=jnp.zeros_like(reference))

        return method._replace(render_step=step)

    objective = nsrr_objective(larger(fake(aux, [])), vgg_weight=0.5, vgg_features=lambda x: [x[..., :1], 2.0 * x])
    terms, _ = jax.jit(objective)({}, clip_of())
    expected = 0.5 * (np.mean(np.square(reference[..., :1])) + 4.0 * np.mean(np.square(reference)))
    np.testing.assert_allclose(terms["vgg"], expected, rtol=1e-5)


def test_ifrnet_terms_equal_numpy():
    image, levels = random_image(2, B, H, W, 3), [random_image(3 + k, B, H // 2, W // 2, 2) for k in range(3)]
    seen = []

    def aux(variables, history):  # the counts: two rendered frames and one between them
        scale = history[:, None, None, None] / 3.0
        return {"image": scale * image, "features": levels, "mean": jnp.full((B, 1, 1, 1), 0.25)}

    def encode(variables, image, method=None):
        assert method == "encode"
        small = image[:, ::2, ::2]
        return [variables * small[..., :2], small[..., 1:] ** 2, small[..., :2] + 1.0, small], {}

    method = fake(aux, seen)._replace(networks=(("ifrnet", Network(None, encode)),))
    objective = ifrnet_objective(method, feature_weight=0.5)
    clip = clip_of()
    terms, state = jax.jit(objective)({"ifrnet": jnp.float32(2.0)}, clip)
    assert ("ess", False) in seen and seen[-1] == ("ss", True) and state == STATE
    target = jnp.log1p(clip.frames.color[-2])
    np.testing.assert_allclose(terms["charbonnier"], np.sqrt((image - target) ** 2 + 1e-6).mean(), rtol=1e-4)
    np.testing.assert_allclose(terms["census"], np.mean(census(image, target)), rtol=1e-3)  # has its own oracle
    small = (target - 0.25)[:, ::2, ::2]
    truth = [2.0 * small[..., :2], small[..., 1:] ** 2, small[..., :2] + 1.0]
    distance = sum(np.mean(feature_census(a, b)) for a, b in zip(levels, truth, strict=True))
    np.testing.assert_allclose(terms["feature_census"], 0.5 * distance, rtol=1e-3)
    gradient = jax.grad(lambda v: objective({"ifrnet": v}, clip)[0]["feature_census"])(jnp.float32(2.0))
    assert float(gradient) == 0.0  # the target's features are given
    with pytest.raises(ValueError, match=r"clip: expected at least 3 frames .*, got 2"):
        objective({}, clip_of(2))
