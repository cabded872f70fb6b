"""Train steps are compiled while the data renders: their shapes are known before the first frame is."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import jax

from essjax.builtin import Clip, live_source
from essjax.frames import Sequence, select_time
from essjax.train import TrainState
from essjax.typing import Array
from experiments.datasets import rendering_of
from experiments.members import Member
from experiments.settings import Settings
from experiments.training import batch_lead, check_crop, initial_state, lacking, make_steps
from experiments.variants import Stage


def batch_shapes(settings: Settings, stage: Stage) -> dict[str, Sequence]:
    """Return what ``make_batches`` gives of each task on the built-in scenes, as shapes; a small frame is rendered."""
    width, height = check_crop(stage.settings, *settings.data.size, settings.data.scale)
    clip = Clip("train", "carousel", 0, frames=1, spp=settings.data.train_spp)  # the program that renders the data too
    one = live_source([clip], width, height, rendering=rendering_of(settings, ranges=stage.ranges))[0]
    leads = {name: batch_lead(stage, task, settings.data.train_frames) for name, task in stage.tasks.items()}
    clips = {name: lacking(task.without, one) for name, task in stage.tasks.items()}
    return {
        name: jax.tree.map(
            lambda leaf, lead=lead: jax.ShapeDtypeStruct((*lead, *leaf.shape[1:]), leaf.dtype), clips[name]
        )
        for name, lead in leads.items()
    }


class Ahead:
    """The train steps of a variant on the built-in scenes, in the making: a thread compiles them in order."""

    def __init__(self, member: Member):
        """Start at once."""
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="essjax-ahead")
        futures = {
            stage.name: {task: self._worker.submit(_compile, member, stage, task) for task in stage.tasks}
            for stage in member.stages
        }
        everything = [step for steps in futures.values() for step in steps.values()]
        self.steps = {
            stage: {task: _Awaited(everything, step) for task, step in steps.items()}
            for stage, steps in futures.items()
        }
        """Stage -> task -> its step, for ``train``."""

    def close(self) -> None:
        """Begin no further one; the one in the making cannot be stopped."""
        self._worker.shutdown(wait=False, cancel_futures=True)


class _Awaited:
    """Stands for a jitted step towards ``train``: its compilation is waiting for it."""

    def __init__(self, all_steps: list[Future], step: Future):
        self._all, self._step = all_steps, step

    def lower(self, *arguments):
        return self

    def compile(self):
        for step in self._all:  # training beside a compilation would make fewer steps
            step.result()
        return self._step.result()


def state_shapes(member: Member, stage: Stage, batches: Mapping[str, Sequence]) -> TrainState:
    """Return the state that ``train_member`` starts ``stage`` with, as ``jax.ShapeDtypeStruct``s."""

    def make(key: Array, batches: Mapping[str, Sequence]) -> TrainState:
        example = select_time(next(iter(batches.values())).frames, 0)
        return initial_state(member, stage, member.stages[-1].method.init(key, example), batches)

    return jax.eval_shape(make, jax.random.key(0), dict(batches))


def _compile(member: Member, stage: Stage, task: str):
    batches = batch_shapes(member.settings, stage)
    step = make_steps(stage, member.settings)[task]
    return step.lower(state_shapes(member, stage, batches), batches[task], 0.0).compile()
