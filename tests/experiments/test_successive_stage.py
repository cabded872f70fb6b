"""ExtraSSNet's stage trains on clips that follow each other, and its checkpoints hold the history."""

import dataclasses
import itertools

import jax
import numpy as np

from essjax.builtin import generate, plan
from essjax.train import Checkpoints
from experiments.members import resolve, settings_of
from experiments.training import first_batches, initial_state, initial_variables, make_batches, restore_member

SETTINGS = ["data.size=[40,28]", "stages.crop=[32,24]", "stages.clip=3", "method.width=4", "method.frnet_width=4"]


def test_the_history_is_part_of_what_a_stage_starts_with_and_comes_back(tmp_path):
    clips = plan("train", 1, 7, spp=1, families=["carousel"])
    dataset = generate(tmp_path / "data", clips, 40, 28)
    settings = settings_of("extrass", "smoke", SETTINGS)
    member = resolve({"extrass": settings}, "smoke", tmp_path / "out")["extrass"]
    flow, last = member.stages
    followed = [batch for _, batch in itertools.islice(make_batches(dataset, settings, last), 4)]
    assert followed[0].frames.color.shape[:2] == (3, 2)
    assert followed[0].frames.cut[0].all() and not all(batch.frames.cut[0].all() for batch in followed)
    assert all(batch.frames.cut[0].all() for _, batch in itertools.islice(make_batches(dataset, settings, flow), 3))

    variables = initial_variables(member, dataset)
    batches = first_batches(dataset, settings, last)
    state = initial_state(member, last, variables, batches)
    assert initial_state(member, flow, variables, first_batches(dataset, settings, flow)).history == {}
    assert state.history["1:2"].shown.shape == (2, 2, 48, 64, 3)  # both runs
    for stage in member.stages:
        saved = initial_state(member, stage, variables, batches)
        saved = dataclasses.replace(saved, variables=jax.tree.map(lambda leaf: leaf + 1.0, saved.variables))
        checkpoints = Checkpoints(tmp_path / "out" / "checkpoints" / stage.name)
        content = {"state": saved, "best": saved.variables[stage.name]}
        checkpoints.save(3, content, {"seconds": 2.0, "validated": [{"step": 0, "ss": 20.0}, {"step": 3, "ss": 20.0}]})
        checkpoints.close()
    restored, report = restore_member(member, dataset, variables)
    assert report["extrassnet"]["steps"] == 0 and report["extrassnet"]["seconds"] == 2.0
    kernel = lambda variables: jax.tree.leaves(variables["extrassnet"])[0]
    np.testing.assert_array_equal(kernel(restored), kernel(variables) + 1.0)
