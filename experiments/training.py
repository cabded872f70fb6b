"""Train a variant: its stages in order, each resumable from its newest checkpoint."""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from essjax.builtin import RENDERER, live_source
from essjax.data import CachedSource, Rounds, clips, disk_source, successive_clips
from essjax.data.layout import Dataset
from essjax.frames import Sequence, select_time
from essjax.train import (
    OPTIMIZERS,
    Checkpoints,
    Recurrent,
    TrainState,
    Validation,
    chosen_variables,
    create_state,
    learning_rate,
    make_train_step,
    read_progress,
    restore_stage,
    train,
)
from essjax.typing import PyTree
from experiments.config import Config
from experiments.datasets import render_settings, train_clips
from experiments.validation import Scorer
from experiments.variants.base import Stage

MIN_CROP = 24


class Watcher:
    """What a training tells; this one listens to nothing."""

    def on_compile(self, stage: str) -> None:
        """The step of ``stage`` is about to be compiled, or waited for."""

    def on_step(self, stage: str, step: int, progress: float, terms: dict[str, float]) -> None:
        """A step is done; progress in [0, 1]."""

    def on_validation(self, stage: str, step: int, progress: float, scores: dict[str, float]) -> None:
        """A validation begins (no scores), or is done."""


def check_crop(config: Config, width: int, height: int) -> tuple[int, int]:
    """Width and height of the crops that are cut out of frames of ``width`` x ``height``.

    Raises:
      ValueError: they are too small.
    """
    crop = min(config.crop[0], width), min(config.crop[1], height)
    if min(crop) < MIN_CROP:
        raise ValueError(
            f"crop: expected at least {MIN_CROP}x{MIN_CROP} LR pixels (FRNet's coarsest features are an eighth), "
            f"got {crop[0]}x{crop[1]} from crop {config.crop} of {width}x{height} frames."
        )
    return crop


def check_batches(dataset: Dataset, config: Config, stage: Stage) -> None:
    """Refuse what ``make_batches`` would, without reading a frame.

    Raises:
      ValueError: no sequence is long enough for a clip, the crop is too small, or ``fresh`` with imported data.
    """
    if config.fresh is not None and dataset.source.get("renderer") != RENDERER:
        raise ValueError(
            f"--set fresh={config.fresh}: {dataset.path} was not made by the built-in renderer, so there are no new "
            "scenes of it. Leave fresh away, or train on the built-in scenes (no --data)."
        )
    source = disk_source(dataset, "train", ranges=stage.ranges, memory=0)
    cutter(stage)(source, **_cut(dataset, config, stage))


def cutter(stage: Stage) -> Callable:
    """What cuts a stage's clips: those of a recurrent objective follow each other."""
    return successive_clips if isinstance(stage.objective, Recurrent) else clips


def clip_length(stage: Stage, config: Config, longest: int) -> int:
    """Frames per clip, of sequences with ``longest`` frames at most; odd where clips follow each other."""
    length = min(config.clip, longest)
    return length - 1 + length % 2 if isinstance(stage.objective, Recurrent) else length


def _cut(dataset: Dataset, config: Config, stage: Stage) -> dict[str, Any]:
    """How clips are cut, for ``cutter``."""
    width, height = check_crop(config, dataset.info.width, dataset.info.height)
    longest = max(len(dataset.numbers(segment)) for segment in dataset.segments("train"))
    return {"length": clip_length(stage, config, longest), "batch": stage.batch, "crop": (height, width)}


def make_batches(dataset: Dataset, config: Config, stage: Stage, *, prefetch: int = 4):
    """An iterator of clips ``[T, B, ...]`` for a stage: crops that fit the frames, as long as sequences allow.

    With ``config.fresh`` the scenes on disk are the first round, and each further one is rendered while the last is
    trained on. ``prefetch`` batches are held ready.

    Raises:
      ValueError: see ``check_batches``.
    """
    check_batches(dataset, config, stage)
    cut = {**_cut(dataset, config, stage), "prefetch": prefetch}

    def make(number: int):
        source = disk_source(dataset, "train", ranges=stage.ranges) if number == 0 else fresh(number)
        return iter(cutter(stage)(source, **cut, seed=config.seed + number))

    def fresh(number: int) -> CachedSource:
        settings = {**render_settings(config), "ranges": stage.ranges}
        return live_source(train_clips(config, number), dataset.info.width, dataset.info.height, **settings)

    return make(0) if config.fresh is None else Rounds(make, config.fresh)


def initial_variables(stages: list[Stage], dataset: Dataset, config: Config) -> PyTree:
    """Fresh variables of the last stage's method, which holds those of the stages before it."""
    example = jax.tree.map(np.asarray, select_time(first_batch(dataset, config, stages[-1]).frames, 0))
    return stages[-1].method.init(jax.random.key(config.seed), example)


def first_batch(dataset: Dataset, config: Config, stage: Stage) -> Sequence:
    """The first one that ``make_batches`` gives."""
    # Without fresh scenes: the next round would be rendered for nothing.
    return next(make_batches(dataset, dataclasses.replace(config, fresh=None), stage, prefetch=1))


def initial_state(stages: list[Stage], stage: Stage, config: Config, variables: PyTree, batch: Sequence) -> TrainState:
    """What ``stage`` starts with: variables of its own and of the stages before it; a history where clips follow.

    Later stages' variables are not touched (nor saved) by it.
    """
    needed = {name: variables[name] for name in _entries(stages, stage)}
    history = stage.objective.start(batch) if isinstance(stage.objective, Recurrent) else None
    return create_state(
        needed, stage.name, OPTIMIZERS[config.optimizer](), history=history, average=config.average is not None
    )


def make_step(stage: Stage, config: Config) -> Callable:
    """The jitted step of a stage."""
    options = {} if config.average is None else {"average": config.average}
    return make_train_step(
        stage.objective, OPTIMIZERS[config.optimizer](), stage.name, compiler_options=config.compiler_options, **options
    )


def train_stages(
    stages: list[Stage],
    dataset: Dataset,
    config: Config,
    out: Path,
    variables: PyTree,
    watcher: Watcher,
    steps: Mapping[str, Any] | None = None,
) -> tuple[PyTree, dict[str, Any]]:
    """Train all stages in order, from ``variables``; one with a checkpoint at the end of its budget is only restored.

    Args:
      stages: of a variant.
      dataset: with a split to train on.
      config: its settings.
      out: folder of checkpoints and logs.
      variables: the initial ones.
      watcher: told what happens.
      steps: stage -> its step, where it is being compiled already (``Ahead.steps``).

    Returns:
      The variables, and stage -> what ``train`` says of it.
    """
    report = {}
    for stage in stages:
        state = initial_state(stages, stage, config, variables, first_batch(dataset, config, stage))
        validation = None
        if config.validations is not None:
            validation = Validation(Scorer(stage.method, dataset, config), config.validations)
        checkpoints = Checkpoints(out / "checkpoints" / stage.name)
        try:
            kept, report[stage.name] = train(
                (steps or {}).get(stage.name) or make_step(stage, config),
                state,
                make_batches(dataset, config, stage),
                checkpoints,
                out / "train" / f"{stage.name}.jsonl",
                stage.budget,
                functools.partial(learning_rate, peak=stage.learning_rate, decay=stage.decay),
                trained=stage.name,
                validation=validation,
                save_every=config.save_every,
                on_step=functools.partial(watcher.on_step, stage.name),
                on_compile=functools.partial(watcher.on_compile, stage.name),
                on_validation=functools.partial(watcher.on_validation, stage.name),
            )
        finally:
            checkpoints.close()
        variables = {**variables, **kept}
    return variables, report


def restore_stages(
    stages: list[Stage], dataset: Dataset, config: Config, out: Path, variables: PyTree
) -> tuple[PyTree, dict[str, Any]]:
    """The variables of the stages' newest checkpoints, for ``--eval-only``, and how they were trained.

    Args:
      stages: of a variant.
      dataset: that it was trained on.
      config: its settings.
      out: where it was trained.
      variables: the initial ones.

    Returns:
      The variables, and stage -> what ``train`` said of it, without terms.

    Raises:
      ValueError: a stage has no checkpoint, or one that does not fit the settings.
    """
    report = {}
    for stage in stages:
        folder = out / "checkpoints" / stage.name
        if not folder.is_dir() or not os.listdir(folder):
            raise ValueError(
                f"--eval-only: {folder} holds no checkpoint. Train first, or give the --out of a trained run."
            )
        checkpoints = Checkpoints(folder)
        try:
            state = initial_state(stages, stage, config, variables, first_batch(dataset, config, stage))
            state, best, saved = restore_stage(checkpoints, state, stage.name)
        finally:
            checkpoints.close()
        variables = {**variables, **chosen_variables(state, best, stage.name, saved)}
        report[stage.name] = {**read_progress(saved), "steps": int(state.step), "terms": {}}
    return variables, report


def _entries(stages: list[Stage], stage: Stage) -> list[str]:
    """Names of the variables that ``stage`` needs: its own and those of the stages before it."""
    names = [s.name for s in stages]
    return names[: names.index(stage.name) + 1]


def read_losses(out: Path, stage: str) -> list[tuple[int, float]]:
    """Step and loss of every step of a stage that was trained in ``out``; none where its log is gone."""
    path = out / "train" / f"{stage}.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [(line["step"], line["loss"]) for line in lines]
