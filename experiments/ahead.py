"""Train steps are compiled while the data renders: their shapes are known before the first frame is."""

from concurrent.futures import Future, ThreadPoolExecutor

import jax

from essjax.builtin import Clip, live_source
from essjax.frames import Sequence, select_time
from essjax.train import TrainState
from essjax.typing import Array
from experiments.datasets import rendering_of
from experiments.members import Member
from experiments.settings import Settings
from experiments.training import check_crop, clip_length, initial_state, make_step
from experiments.variants import Stage


def batch_shapes(settings: Settings, stage: Stage) -> Sequence:
    """Return what ``make_batches`` gives on the built-in scenes, as shapes; one small frame is rendered."""
    width, height = check_crop(stage.settings, *settings.data.size, settings.data.scale)
    clip = Clip("train", "carousel", 0, frames=1, spp=1)
    one = live_source([clip], width, height, rendering=rendering_of(settings, ranges=stage.ranges))[0]
    lead = clip_length(stage, settings.data.train_frames), stage.settings.batch
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*lead, *leaf.shape[1:]), leaf.dtype), one)


class Ahead:
    """The train steps of a variant on the built-in scenes, in the making: a thread compiles them in order."""

    def __init__(self, member: Member):
        """Start at once."""
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="essjax-ahead")
        futures = {stage.name: self._worker.submit(_compile, member, stage) for stage in member.stages}
        self.steps = {name: _Awaited(list(futures.values()), step) for name, step in futures.items()}
        """Stage -> its step, for ``train``."""

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


def state_shapes(member: Member, stage: Stage, batch: Sequence) -> TrainState:
    """Return the state that ``train_member`` starts ``stage`` with, as ``jax.ShapeDtypeStruct``s."""

    def make(key: Array, batch: Sequence) -> TrainState:
        variables = member.stages[-1].method.init(key, select_time(batch.frames, 0))
        return initial_state(member, stage, variables, batch)

    return jax.eval_shape(make, jax.random.key(0), batch)


def _compile(member: Member, stage: Stage):
    batch = batch_shapes(member.settings, stage)
    return make_step(stage, member.settings).lower(state_shapes(member, stage, batch), batch, 0.0).compile()
