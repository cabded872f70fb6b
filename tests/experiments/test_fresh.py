"""Training on ever new scenes: ``--set fresh=N``."""

import dataclasses
import functools
import itertools

import jax
import numpy as np
import pytest

from essjax.builtin import generate, plan
from essjax.data import Rounds
from experiments import datasets
from experiments.ahead import batch_shapes
from experiments.config import make_config
from experiments.training import make_batches
from experiments.variants import config_of, stages_of

SETTINGS = ["size=[40,28]", "crop=[32,24]", "train_sequences=1", "train_frames=5", "train_spp=1", "batch=2"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    clips = plan("train", 1, 5, spp=1, families=["carousel"])
    return generate(tmp_path_factory.mktemp("fresh"), clips, 40, 28)


def batches(dataset, monkeypatch, *settings):
    monkeypatch.setattr(datasets, "plan", functools.partial(plan, families=["carousel"]))
    config = config_of("extrass", "smoke", [*SETTINGS, *settings])
    return make_batches(dataset, config, stages_of("extrass", config)[-1])


def test_the_second_round_is_of_other_scenes_and_looks_alike(dataset, monkeypatch):
    first, _, third = itertools.islice(batches(dataset, monkeypatch, "fresh=2"), 3)
    assert jax.tree.structure(first) == jax.tree.structure(third)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(third), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
    textures = [set(np.round(batch.frames.gbuffers.base_color, 4).ravel().tolist()) for batch in (first, third)]
    assert len(textures[0] & textures[1]) < 0.5 * len(textures[1])
    again = list(itertools.islice(batches(dataset, monkeypatch, "fresh=2"), 3))[2]
    np.testing.assert_array_equal(again.reference, third.reference)


def test_without_it_batches_are_as_ever(dataset, monkeypatch):
    assert not isinstance(batches(dataset, monkeypatch), Rounds)


def test_shapes_are_known_before_there_are_scenes(dataset, monkeypatch):
    """What the run command compiles for while the data renders."""
    config = config_of("extrass", "smoke", SETTINGS)
    expected = batch_shapes(config, stages_of("extrass", config)[-1])
    shapes = [
        jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)
        for tree in (expected, next(batches(dataset, monkeypatch)))
    ]
    assert shapes[0] == shapes[1]


def test_imported_data_has_no_new_scenes(dataset, monkeypatch):
    imported = dataclasses.replace(dataset, source={"renderer": "blender"})
    with pytest.raises(ValueError, match=r"--set fresh=2: .* was not made by the built-in renderer"):
        batches(imported, monkeypatch, "fresh=2")


def test_at_least_one_step():
    with pytest.raises(ValueError, match="--set fresh: expected at least 1 step on each round of scenes, got 0"):
        make_config("smoke", ["fresh=0"])
    assert make_config("smoke", []).fresh is None and make_config("smoke", ["fresh=null"]).fresh is None
