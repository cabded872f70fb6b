"""ExtraSSNet's stage trains on clips that follow each other, and its checkpoints hold the history."""

import dataclasses
import itertools

import jax
import numpy as np

from essjax.builtin import generate, plan
from essjax.train import Checkpoints
from experiments.training import first_batch, initial_state, initial_variables, make_batches, restore_stages
from experiments.variants import config_of, stages_of

SETTINGS = ["size=[40,28]", "crop=[32,24]", "clip=4", "batch=2", "width=4", "first_width=4"]


def test_the_history_is_part_of_what_a_stage_starts_with_and_comes_back(tmp_path):
    clips = plan("train", 1, 7, spp=1, families=["carousel"])
    dataset = generate(tmp_path / "data", clips, 40, 28)
    config = config_of("extrass", "smoke", SETTINGS)
    stages = stages_of("extrass", config)
    flow, last = stages
    followed = list(itertools.islice(make_batches(dataset, config, last), 4))
    assert followed[0].frames.color.shape[:2] == (3, 2)  # of 4 frames 3: both kinds need an odd number
    assert followed[0].frames.cut[0].all() and not all(batch.frames.cut[0].all() for batch in followed)
    assert all(batch.frames.cut[0].all() for batch in itertools.islice(make_batches(dataset, config, flow), 3))

    variables = initial_variables(stages, dataset, config)
    batch = first_batch(dataset, config, last)
    state = initial_state(stages, last, config, variables, batch)
    assert initial_state(stages, flow, config, variables, first_batch(dataset, config, flow)).history is None
    assert state.history.shown.shape == (2, 2, 48, 64, 3)  # both runs
    for stage in stages:
        saved = initial_state(stages, stage, config, variables, batch)
        saved = dataclasses.replace(saved, variables=jax.tree.map(lambda leaf: leaf + 1.0, saved.variables))
        checkpoints = Checkpoints(tmp_path / "out" / "checkpoints" / stage.name)
        content = {"state": saved, "best": saved.variables[stage.name]}
        checkpoints.save(3, content, {"seconds": 2.0, "validated": [{"step": 0, "ss": 20.0}, {"step": 3, "ss": 20.0}]})
        checkpoints.close()
    restored, report = restore_stages(stages, dataset, config, tmp_path / "out", variables)
    assert report["extrassnet"]["steps"] == 0 and report["extrassnet"]["seconds"] == 2.0
    kernel = lambda variables: jax.tree.leaves(variables["extrassnet"])[0]
    np.testing.assert_array_equal(kernel(restored), kernel(variables) + 1.0)
