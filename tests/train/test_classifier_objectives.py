"""The classifier's two objectives on fake methods whose outputs are known; every term by NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import reinhard
from essjax.exposure import exposed
from essjax.frames import Prediction
from essjax.interfaces import Method, MethodInfo, Network
from essjax.labels import Thresholds, label_sequence
from essjax.train import classification_objective, composition_objective
from tests.helpers import make_sequence, random_image

T, B, H, W = 4, 2, 5, 7
AT = Thresholds(ghosting_depth=0.3, ghosting_velocity=4.0, opening=2)


def fake(aux_of, apply=None):
    """A method whose aux follows from its variables and the number of the frame since the start.

    Its classifier is ``apply``.
    """

    def start(example):
        return jnp.zeros((), jnp.int32)

    def step(variables, history, frame, *, train=False):
        assert not train  # both objectives run the method as it is at inference
        aux = aux_of(variables, history)
        return history + 1, Prediction(image=jnp.zeros((B, 2 * H, 2 * W, 3)), aux=aux)

    info, networks = MethodInfo("fake", 2, renders_all=True), (("classifier", Network(None, apply)),)
    return exposed(Method(lambda key, example: {}, start, step, step, info, networks=networks))


@pytest.fixture(scope="module")
def clip():
    return make_sequence(3, T=T, B=B, H=H, W=W, ranges=True)


def test_classification(clip):
    """The network multiplies its inputs with one number; the gradient reaches it there and not through the method."""
    inputs, known = random_image(1, T, B, 2 * H, 2 * W, 6, low=-1.0), random_image(2, T, B, 2 * H, 2 * W, 1) > 0.6
    known = known.at[0].set(False).astype(jnp.float32)

    def apply(variables, x, train=False):
        assert train and x.shape == (T * B, 2 * H, 2 * W, 6)
        return x * variables["w"], {"batch_stats": {"mean": x.mean()}}

    def aux(variables, n):
        return {"inputs": inputs[n] * variables["classifier"]["w"], "known": known[n]}

    objective = classification_objective(fake(aux, apply), thresholds=AT, balance=0.5)

    def loss(w):
        terms, state = objective({"classifier": {"w": w}}, clip)
        return sum(terms.values()), (terms, state)

    run = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (_, (terms, state)), gradient = run(jnp.float32(1.5))
    labels = label_sequence(clip.ranges, clip.frames.cut, at=AT)
    assert set(terms) == {"ghosting", "aliasing"}
    slope = 0.0
    for name, part in (("ghosting", slice(0, 3)), ("aliasing", slice(3, 6))):
        x = 1.5 * np.asarray(inputs, np.float64)[..., part]  # given, though made with the same variable
        classes, mask = np.asarray(getattr(labels, name))[..., 0], np.asarray(known)[..., 0]
        share = np.array([(mask * (classes == k)).sum() for k in range(3)]) / mask.sum()
        weight = mask * (np.maximum(share, 1e-3) ** -0.5)[classes]
        chosen = np.take_along_axis(x, classes[..., None], axis=-1)[..., 0]
        loss = np.logaddexp.reduce(1.5 * x, axis=-1) - 1.5 * chosen
        np.testing.assert_allclose(terms[name], (weight * loss).sum() / weight.sum(), rtol=1e-4)
        softmax = np.exp(1.5 * x - np.logaddexp.reduce(1.5 * x, axis=-1, keepdims=True))
        slope += (weight * ((softmax * x).sum(-1) - chosen)).sum() / weight.sum()
        assert (share > 1e-3).sum() >= 2
    np.testing.assert_allclose(gradient, slope, rtol=1e-3)
    np.testing.assert_allclose(state["classifier"]["batch_stats"]["mean"], 1.5 * inputs.mean(), rtol=1e-4)


def test_composition(clip):
    images = random_image(4, T, B, 2 * H, 2 * W, 3, high=1.0)
    warped, known = random_image(5, T, B, 2 * H, 2 * W, 3, high=1.0), random_image(6, T, B, 2 * H, 2 * W, 1) > 0.4

    def aux(variables, n):
        return {"encoded": images[n], "warped": warped[n], "known": known[n].astype(jnp.float32)}

    for valid in (clip.valid, None):
        chosen = dataclasses.replace(clip, valid=valid)
        terms, state = jax.jit(composition_objective(fake(aux), temporal_weight=0.25))({}, chosen)
        assert state == {} and set(terms) == {"l1", "temporal"}
        error = np.abs(np.asarray(images) - np.asarray(reinhard(clip.reference)))[1:]
        np.testing.assert_allclose(terms["l1"], error.mean(), rtol=1e-5)
        mask = np.asarray(known)[1:].astype(float)
        if valid is not None:
            mask = mask * np.asarray(valid).repeat(2, axis=2).repeat(2, axis=3)[1:]
        change = (mask * np.abs(np.asarray(images) - np.asarray(warped))[1:]).sum() / (3 * mask.sum())
        np.testing.assert_allclose(terms["temporal"], 0.25 * change, rtol=1e-5)


def test_a_clip_without_ranges_says_where_they_come_from(clip):
    objective = classification_objective(fake(lambda *_: {}))
    with pytest.raises(ValueError, match="classifier: .* Render the scenes with --ranges; imported frames have none"):
        objective({}, dataclasses.replace(clip, ranges=None))
