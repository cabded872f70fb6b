"""Frames of colour, depth and motion alone: what runs on them, and what says clearly that it cannot."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from essjax import methods, warp
from essjax.frames import OPTIONAL_GBUFFERS, select_time
from essjax.rollout import alternate, every, unroll
from experiments import comparison
from experiments.evaluate import Clip
from experiments.members import all_settings, resolve
from tests.helpers import make_frames, make_sequence


def bare(frames):
    """Without every G-buffer but depth."""
    return dataclasses.replace(
        frames, gbuffers=dataclasses.replace(frames.gbuffers, **dict.fromkeys(OPTIONAL_GBUFFERS)), camera=None
    )


@pytest.mark.parametrize(
    ("method", "schedule"),
    [
        (methods.warp(), alternate()),
        (methods.bilinear(), every()),
        (methods.jau(), every()),
        (methods.taau_half(), alternate()),
        (methods.taa(), every()),
    ],
    ids=lambda value: value.info.name if hasattr(value, "info") else "",
)
def test_heuristics_see_nothing_but_color_depth_and_motion(method, schedule):
    frames, others = (make_frames(seed, T=4, B=1, H=6, W=8) for seed in (3, 4))
    run = jax.jit(lambda frames: unroll(method, variables, frames, schedule).image)
    variables = method.init(jax.random.key(0), select_time(frames, 0))
    changed = {name: getattr(others.gbuffers, name) for name in OPTIONAL_GBUFFERS}
    changed = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, **changed))
    np.testing.assert_array_equal(run(changed), run(frames))
    np.testing.assert_allclose(run(bare(frames)), run(frames), rtol=1e-5)  # another program


@pytest.mark.parametrize("method", [methods.fasset(width=4, hidden=8), methods.extranet()])
def test_methods_say_which_buffer_is_missing_and_why(method):
    frames = make_frames(0, T=2, B=1, H=8, W=8)
    frames = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, normal=None))
    with pytest.raises(
        ValueError,
        match=rf"{method.info.name} needs the buffers normal, which these frames do not have .*normal tells surfaces "
        r"apart: guides the warp\. Render or import",
    ):
        unroll(method, {}, frames, alternate())
    with pytest.raises(ValueError, match=rf"{method.info.name} needs the buffers base_color, "):
        method.init(jax.random.key(0), select_time(bare(frames), 0))  # training makes the variables first


def test_holes_without_normals_are_those_of_zero_normals():
    now, before = (bare(select_time(make_frames(5, T=2, B=1), t)) for t in (1, 0))
    zero = [
        dataclasses.replace(f.gbuffers, normal=np.zeros((*f.motion.shape[:-1], 3), np.float32)) for f in (now, before)
    ]
    got = warp.hole_mask(now.gbuffers, before.gbuffers, now.motion)
    np.testing.assert_array_equal(got, warp.hole_mask(*zero, now.motion))
    assert 0.1 < np.mean(got) < 0.9


def test_a_comparison_leaves_out_what_lacks_a_buffer_and_says_so():
    sequence = jax.tree.map(lambda leaf: leaf[:, 0], make_sequence(0, T=3, B=1))
    poor = dataclasses.replace(sequence, frames=bare(sequence.frames))
    assert comparison.unfit(methods.extrass_w(), sequence) == ""
    assert comparison.unfit(methods.fasset(), sequence) == comparison.unfit(methods.extrass_w(), poor) == ""
    assert comparison.unfit(methods.fasset(), poor) == "this dataset has no base_color, normal"
    assert comparison.unfit(methods.taau(scale=2), poor) == ""
    asked, holes = ["bilinear", "extranet+taa"], np.zeros((3, 12, 18, 1))
    members = resolve(all_settings(asked, "smoke", []), "smoke", Path())
    remarks = {
        name: comparison.notes(members, asked, [Clip("a", s, (0, 1, 2), [1, 2], holes, False)], {})
        for name, s in (("rich", sequence), ("poor", poor))
    }
    for row in ("taa", "extranet+taa"):
        assert f"No {row} row: this dataset has no colour at native resolution." in remarks["rich"]
    assert not any("extrass-w" in remark for remark in (*remarks["rich"], *remarks["poor"]))


def test_a_comparison_leaves_out_upscalers_where_the_reference_is_not_larger():
    sequence = jax.tree.map(lambda leaf: leaf[:, 0], make_sequence(0, T=2, B=1, scale=1))
    assert comparison.unfit(methods.bilinear(scale=2), sequence) == (
        "its output (x2) is 36x24, this dataset's reference (x1) is 18x12"
    )
    assert comparison.unfit(methods.warp(), sequence) == ""
