"""Train steps are compiled while the data renders: their shapes are known before the first frame is."""

from concurrent.futures import Future, ThreadPoolExecutor

import jax

from essjax.builtin import Clip, live_source
from essjax.frames import Sequence, select_time
from essjax.train import TrainState
from essjax.typing import Array
from experiments.config import Config
from experiments.datasets import render_settings
from experiments.training import check_crop, clip_length, initial_state, make_step
from experiments.variants.base import Stage


def batch_shapes(config: Config, stage: Stage) -> Sequence:
    """What ``make_batches`` gives on the built-in scenes, as ``jax.ShapeDtypeStruct``s; one small frame is rendered."""
    width, height = check_crop(config, *config.size)
    clip = Clip("train", "carousel", 0, frames=1, spp=1)
    one = live_source([clip], width, height, **render_settings(config), ranges=stage.ranges)[0]
    length = clip_length(stage, config, config.train_frames)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((length, stage.batch, *leaf.shape[1:]), leaf.dtype), one)


class Ahead:
    """The train steps of a variant on the built-in scenes, in the making: a thread compiles them in order."""

    def __init__(self, stages: list[Stage], config: Config):
        """Starts at once."""
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="essjax-ahead")
        futures = {stage.name: self._worker.submit(_compile, stages, stage, config) for stage in stages}
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


def state_shapes(stages: list[Stage], stage: Stage, config: Config, batch: Sequence) -> TrainState:
    """The state that ``train_stages`` starts ``stage`` with, as ``jax.ShapeDtypeStruct``s."""

    def make(key: Array, batch: Sequence) -> TrainState:
        variables = stages[-1].method.init(key, select_time(batch.frames, 0))
        return initial_state(stages, stage, config, variables, batch)

    return jax.eval_shape(make, jax.random.key(0), batch)


def _compile(stages: list[Stage], stage: Stage, config: Config):
    batch = batch_shapes(config, stage)
    return make_step(stage, config).lower(state_shapes(stages, stage, config, batch), batch, 0.0).compile()
