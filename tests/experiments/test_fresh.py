"""Training on ever new scenes: ``--set data.fresh=N``."""

import dataclasses
import functools
import itertools
from pathlib import Path

import jax
import numpy as np
import pytest

from essjax.builtin import generate, plan
from essjax.data import Rounds
from experiments import datasets
from experiments.ahead import batch_shapes
from experiments.members import resolve, settings_of
from experiments.training import make_batches

SETTINGS = ["data.size=[40,28]", "stages.crop=[32,24]", "data.train_frames=5", "data.train_spp=1", "stages.batch=2"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    clips = plan("train", 1, 5, spp=1, families=["carousel"])
    return generate(tmp_path_factory.mktemp("fresh"), clips, 40, 28)


def batches(dataset, monkeypatch, *settings):
    monkeypatch.setattr(datasets, "plan", functools.partial(plan, families=["carousel"]))
    return make_batches(dataset, *last_stage(*settings))


def last_stage(*settings):
    own = settings_of("extrass", "smoke", [*SETTINGS, *settings])
    return own, resolve({"extrass": own}, "smoke", Path())["extrass"].stages[-1]


def test_the_second_round_is_of_other_scenes_and_looks_alike(dataset, monkeypatch):
    (_, first), _, (_, third) = itertools.islice(batches(dataset, monkeypatch, "data.fresh=2"), 3)
    assert jax.tree.structure(first) == jax.tree.structure(third)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(third), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
    textures = [set(np.round(batch.frames.gbuffers.base_color, 4).ravel().tolist()) for batch in (first, third)]
    assert len(textures[0] & textures[1]) < 0.5 * len(textures[1])
    _, again = list(itertools.islice(batches(dataset, monkeypatch, "data.fresh=2"), 3))[2]
    np.testing.assert_array_equal(again.reference, third.reference)


def test_without_it_batches_are_as_ever(dataset, monkeypatch):
    assert not isinstance(batches(dataset, monkeypatch), Rounds)


def test_shapes_are_known_before_there_are_scenes(dataset, monkeypatch):
    """What the run command compiles for while the data renders."""
    expected = batch_shapes(*last_stage())
    shapes = [
        jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)
        for tree in (expected, dict([next(batches(dataset, monkeypatch))]))
    ]
    assert shapes[0] == shapes[1]


def test_imported_data_has_no_new_scenes(dataset, monkeypatch):
    imported = dataclasses.replace(dataset, source={"renderer": "blender"})
    with pytest.raises(ValueError, match=r"--set data.fresh=2: .* was not made by the built-in renderer"):
        batches(imported, monkeypatch, "data.fresh=2")


def test_at_least_one_step():
    with pytest.raises(ValueError, match="--set data.fresh: expected at least 1, got 0"):
        settings_of("extrass", "smoke", ["data.fresh=0"])
    assert settings_of("extrass", "smoke", ["data.fresh=null"]).data.fresh is None
