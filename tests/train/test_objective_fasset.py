"""FASSET's objective on a method whose steps say what they return: every term of eq 2-5 by NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.rollout import ESS, SS
from essjax.train import fasset_objective
from tests.helpers import make_sequence, random_image
from tests.train.test_objectives import fake

T, B, H, W = 5, 2, 6, 10
IMAGES = {kind: random_image(40 + kind, 2 * H, 2 * W, 3) for kind in (0, 1)}


def aux(variables, history, frame, kind):
    number = frame.motion[..., 0, 0, 0][..., None, None, None]
    image = jnp.broadcast_to(IMAGES[kind], (*number.shape[:-3], 2 * H, 2 * W, 3))
    valid = jnp.broadcast_to(jnp.arange(W)[:, None] >= kind + 1.0, frame.gbuffers.depth.shape)
    return {"log_image": image + 0.1 * number, "valid": valid.astype(jnp.float32), "mask": 0.0 * valid}


def clip_of(length, exact):
    clip = make_sequence(1, T=length, B=B, H=H, W=W)
    motion = jnp.broadcast_to(
        jnp.arange(length, dtype=jnp.float32)[:, None, None, None, None], clip.frames.motion.shape
    )
    frames = dataclasses.replace(clip.frames, motion=motion)
    return dataclasses.replace(clip, frames=frames, valid=clip.valid if exact else None)


@pytest.mark.parametrize("exact", [True, False], ids=["exact holes", "the network's holes"])
def test_terms_equal_numpy(exact):
    clip = clip_of(T + 1, exact)  # an even number: the last frame is left out
    objective = fasset_objective(fake(aux), hole_weight=5.0, hard_weight=0.7, share=0.1)
    terms, state = jax.jit(lambda clip: objective({}, clip))(clip)
    assert not state and len(terms) == 6
    target = np.log1p(np.asarray(clip.reference, np.float64)[1 : T - 1])
    for kind, name in enumerate((SS, ESS)):
        image = np.stack([np.asarray(IMAGES[kind], np.float64) + 0.1 * n for n in range(1, T - 1)])[:, None]
        errors = np.abs(image - target)  # [T - 2, B, 2H, 2W, 3]
        np.testing.assert_allclose(terms[f"l1_{name}"], errors.mean(), rtol=1e-5)
        if exact:
            hole = 1 - np.asarray(clip.valid)[1 : T - 1].repeat(2, axis=2).repeat(2, axis=3)
        else:
            hole = np.broadcast_to((np.arange(2 * W) < 2 * (kind + 1))[:, None], (*errors.shape[:-1], 1))
        np.testing.assert_allclose(terms[f"hole_{name}"], 5 * errors[(hole[..., 0] > 0)].mean(), rtol=1e-5)
        pixels = errors.mean(axis=-1).reshape(T - 2, B, -1)
        count = round(0.1 * pixels.shape[-1])
        hard = np.sort(pixels, axis=-1)[..., -count:].sum() / pixels.size  # eq 4 divides by all pixels
        np.testing.assert_allclose(terms[f"hard_{name}"], 0.7 * hard, rtol=1e-5)
