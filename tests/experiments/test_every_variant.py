"""Every variant on one rendered scene: each stage of its smoke preset trains, and streaming is unrolling."""

import functools
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.builtin import plan
from essjax.frames import frame_images, select_time
from essjax.rollout import alternate, every, unroll
from experiments import datasets
from experiments.ahead import batch_shapes, state_shapes
from experiments.members import resolve, settings_of
from experiments.training import initial_state, initial_variables, make_batches, make_steps
from experiments.variants import VARIANTS
from tests.helpers import streamed

pytestmark = pytest.mark.skipif(
    not os.environ.get("ESSJAX_SWEEP"), reason="compiles every variant, four minutes: ESSJAX_SWEEP=1, --dist load"
)
STEPS = 8
SIZES = ["data.size=[40,28]", "stages.crop=[32,24]", "data.test_frames=7", "data.train_frames=7"]
STREAMED = [
    name
    for name, variant in VARIANTS.items()
    # Ablations share their method's file; extrass and the TAA family are streamed in their own tests.
    if "-no-" not in name and "-theta-" not in name and not name.startswith(("extrass", "ta", "jau-", "dlctus-"))
]
TRAINED = [name for name, variant in VARIANTS.items() if variant.stages]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """One family, rendered once for all variants."""
    patch = pytest.MonkeyPatch()
    patch.setattr(datasets, "plan", functools.partial(plan, families=["carousel"]))
    settings = settings_of("extrass", "smoke", SIZES)
    yield datasets.prepare(settings, None, tmp_path_factory.mktemp("every"), lambda n, total: None, ranges=True)
    patch.undo()


def assert_same_shapes(expected, actual):
    described = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree) for tree in (expected, actual)]
    assert described[0] == described[1]


def train(name, dataset):
    """Train every stage of a variant on one batch; stage -> losses, and the variables."""
    settings = settings_of(name, "smoke", SIZES)
    member = resolve({name: settings}, "smoke", Path())[name]
    variables, losses = initial_variables(member, dataset), {}
    for stage in member.stages:
        (task, batch), losses[stage.name] = next(make_batches(dataset, settings, stage)), []
        step, state = make_steps(stage, settings)[task], initial_state(member, stage, variables, {task: batch})
        expected = batch_shapes(settings, stage)  # what the run command compiles for, before there are data
        assert_same_shapes(expected, {task: batch})
        assert_same_shapes(state_shapes(member, stage, expected), state)
        for _ in range(STEPS):
            state, terms = step(state, batch, stage.settings.learning_rate)
            losses[stage.name].append(float(terms["loss"]))
        variables = {**variables, **state.variables}
    return losses, variables


@pytest.mark.parametrize("name", TRAINED)
def test_the_loss_falls(name, dataset):
    losses, variables = train(name, dataset)
    for stage, values in losses.items():
        assert np.all(np.isfinite(values)), (stage, values)
        assert min(values[-3:]) < values[0], (stage, values)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(variables))


@pytest.mark.parametrize("name", STREAMED)
def test_streaming_is_unrolling(name, dataset):
    """Frame by frame with donated history, a cut in between, against one scan."""
    method = VARIANTS[name].method(settings_of(name, "smoke", SIZES))
    from essjax.data import disk_source

    sequence = disk_source(dataset, "test", native=method.info.native)[0]
    frames = sequence.native if method.info.native else sequence.frames
    frames = jax.tree.map(lambda leaf: jnp.asarray(leaf[:6, None]), frames)
    frames = frames.__class__(**{**vars(frames), "cut": frames.cut.at[4].set(True)})
    assert set(method.info.requires) <= set(frame_images(frames))
    variables = method.init(jax.random.key(3), select_time(frames, 0))
    schedule = every() if method.info.renders_all else alternate(0)
    unrolled = jax.jit(lambda v, f: unroll(method, v, f, schedule).image)(variables, frames)
    images = list(streamed(method, variables, frames, schedule.kinds(6)))
    late = method.info.latency
    shifted = np.stack(images[late:] + images[-1:] * late)
    assert np.ptp(shifted) > 0.01
    np.testing.assert_allclose(shifted, unrolled, rtol=2e-4, atol=2e-4)
