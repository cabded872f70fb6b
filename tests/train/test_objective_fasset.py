"""FASSET's objective on a method whose steps say what they return: eq 2-5 by NumPy; what ExtraNet+ is trained on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.frames import select_time
from essjax.rollout import ESS, SS
from essjax.train import fasset_objective
from essjax.train.objectives.extranet import frame_shading, reference_shading
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
@pytest.mark.parametrize("period", [2, 3])
def test_terms_equal_numpy(exact, period):
    clip = clip_of(T + 1, exact)
    objective = fasset_objective(fake(aux), hole_weight=5.0, hard_weight=0.7, share=0.1, period=period)
    terms, state = jax.jit(lambda clip: objective({}, clip))(clip)
    assert not state and len(terms) == 6
    count = (T + 1 - period + 1) // period * period  # the frames left over are left out
    expected = dict.fromkeys(terms, 0.0)
    for distance in range(period):
        kind, name, share = min(distance, 1), ESS if distance else SS, 1 / (period - 1) if distance else 1.0
        frames = np.arange(distance, distance + count)
        image = np.stack([np.asarray(IMAGES[kind], np.float64) + 0.1 * n for n in frames])[:, None]
        errors = np.abs(image - np.log1p(np.asarray(clip.reference, np.float64)[frames]))  # [count, B, 2H, 2W, 3]
        if exact:
            hole = 1 - np.asarray(clip.valid)[frames].repeat(2, axis=2).repeat(2, axis=3)
        else:
            hole = np.broadcast_to((np.arange(2 * W) < 2 * (kind + 1))[:, None], (*errors.shape[:-1], 1))
        hole = hole * (frames > 0).reshape(-1, 1, 1, 1, 1)  # frame 0 is a cut
        pixels = errors.mean(axis=-1).reshape(count, B, -1)
        worst = round(0.1 * pixels.shape[-1])
        expected[f"l1_{name}"] += share * errors.mean()
        expected[f"hole_{name}"] += share * 5 * errors[(hole[..., 0] > 0)].mean()
        # Eq 4 divides by all pixels.
        expected[f"hard_{name}"] += share * 0.7 * np.sort(pixels, axis=-1)[..., -worst:].sum() / pixels.size
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-5, err_msg=name)


def test_target_of_extranet_plus():
    """Where base colour is the same everywhere, upsampling changes nothing: the reference over the divisor."""
    clip = select_time(make_sequence(2, T=1, B=B, H=H, W=W), 0)
    nowhere = jnp.isfinite(clip.frames.gbuffers.depth)
    gbuffers = dataclasses.replace(
        clip.frames.gbuffers,
        base_color=jnp.full_like(clip.frames.color, 0.3),
        depth=jnp.where(nowhere, clip.frames.gbuffers.depth, 5.0),
        metallic=None,
    )
    clip = dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, gbuffers=gbuffers))
    np.testing.assert_allclose(reference_shading(clip), clip.reference / (0.3 + 0.08 * 0.5), rtol=1e-4)
    np.testing.assert_allclose(frame_shading(clip), clip.frames.color / (0.3 + 0.08 * 0.5), rtol=1e-4)
