"""Train a variant: its stages in order, each resumable from its newest checkpoint."""

import contextlib
import dataclasses
import functools
import itertools
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import grain
import jax
import numpy as np

from essjax.builtin import RENDERER, live_source
from essjax.data import CachedSource, Mixed, Rounds, Source, clips, disk_source, successive_clips, without_buffers
from essjax.data.layout import Dataset
from essjax.frames import Sequence, select_time
from essjax.sizes import Scale, crop_steps, output_size, ratios
from essjax.train import (
    OPTIMIZERS,
    Checkpoints,
    Recurrent,
    TrainState,
    Validation,
    chosen_variables,
    create_state,
    fitting_length,
    learning_rate,
    make_train_step,
    read_progress,
    restore_stage,
    train,
)
from essjax.typing import PyTree
from experiments.datasets import rendering_of, train_clips
from experiments.members import Member
from experiments.settings import Settings, StageSettings, with_data
from experiments.validation import Scorer
from experiments.variants import Stage, Task

MIN_CROP = 24


class Watcher:
    """Listener to a training; this one listens to nothing."""

    def on_compile(self, stage: str) -> None:
        """Hear that the step of ``stage`` is about to be compiled, or waited for."""

    def on_step(self, stage: str, step: int, progress: float, terms: dict[str, float]) -> None:
        """Hear that a step is done; progress in [0, 1]."""

    def on_validation(self, stage: str, step: int, progress: float, scores: dict[str, float]) -> None:
        """Hear that a validation begins (no scores), or is done."""


def check_crop(settings: StageSettings, width: int, height: int, scale: Scale) -> tuple[int, int]:
    """Width and height of the crops that are cut out of frames of ``width`` x ``height``, of a reference by ``scale``.

    A square in output pixels becomes a multiple of the ratio's denominators.

    Raises:
      ValueError: they are too small.
    """
    wanted = settings.crop
    if not isinstance(wanted, tuple):
        output = output_size(scale, (height, width))
        sides = [int(wanted // ratio) for ratio in ratios((height, width), output)]
        down, across = crop_steps((height, width), output) or (1, 1)
        wanted = sides[0] - sides[0] % across, sides[1] - sides[1] % down
    crop = min(wanted[0], width), min(wanted[1], height)
    if min(crop) < MIN_CROP:
        raise ValueError(
            f"crop: expected at least {MIN_CROP}x{MIN_CROP} LR pixels (FRNet's coarsest features are an eighth), "
            f"got {crop[0]}x{crop[1]} from crop {settings.crop} of {width}x{height} frames."
        )
    return crop


def check_batches(dataset: Dataset, settings: Settings, stage: Stage) -> None:
    """Refuse what ``make_batches`` would, without reading a frame.

    Raises:
      ValueError: no sequence is long enough for a clip, the crop is too small, or ``fresh`` with imported data.
    """
    if settings.data.fresh is not None and dataset.source.get("renderer") != RENDERER:
        raise ValueError(
            f"--set data.fresh={settings.data.fresh}: {dataset.path} was not made by the built-in renderer, so there "
            "are no new scenes of it. Leave fresh away, or train on the built-in scenes (no --data)."
        )
    source = disk_source(dataset, "train", ranges=stage.ranges, memory=0)
    for task in stage.tasks.values():
        _clips(source, dataset, stage, task)


def batch_lead(stage: Stage, task: Task, longest: int) -> tuple[int, int]:
    """Frames per clip and clips per batch, of sequences with ``longest`` frames at most.

    The settings are for rate 1:2. Where a clip is unrolled in every phase of another, the runs are as long, rounded up
    to whole periods, and a batch has fewer clips, so that the number of runs stays about the same. Else a clip has as
    many periods.

    Raises:
      ValueError: no sequence is long enough.
    """
    clip, batch, period = stage.settings.clip, stage.settings.batch, task.period
    if not task.recurrent:
        return min(-(-clip * period // 2), longest), batch
    wanted = -(-(clip - 1) // period) * period + period - 1
    length = fitting_length(min(wanted, longest), period)
    if not length:
        raise ValueError(
            f"training.rates: expected sequences of at least {2 * period - 1} frames to train 1:{period}, got "
            f"{longest} frames at most. Use longer ones, or leave that rate out."
        )
    return length, max(round(2 * batch / period), 1)


def _clips(source: Source, dataset: Dataset, stage: Stage, task: Task, **options: Any) -> grain.IterDataset:
    """Cut clips for a task out of ``source``; those of a recurrent objective follow each other."""
    width, height = check_crop(stage.settings, dataset.info.width, dataset.info.height, dataset.info.scale)
    longest = max(len(dataset.numbers(segment)) for segment in dataset.segments("train"))
    length, batch = batch_lead(stage, task, longest)
    options |= {"length": length, "batch": batch, "crop": (height, width)}
    found = successive_clips(source, overlap=task.period - 1, **options) if task.recurrent else clips(source, **options)
    return found.map(functools.partial(lacking, task.without)) if task.without else found


def lacking(names: tuple[str, ...], clip: Sequence) -> Sequence:
    """``clip`` without those G-buffers."""
    return dataclasses.replace(clip, frames=without_buffers(clip.frames, names))


def make_batches(dataset: Dataset, settings: Settings, stage: Stage, *, prefetch: int = 4):
    """Iterate over tasks and clips ``[T, B, ...]`` for a stage: crops that fit the frames, as long as sequences allow.

    With ``data.fresh`` the scenes on disk are the first round, and each further one is rendered while the last is
    trained on. ``prefetch`` batches are held ready.

    Raises:
      ValueError: see ``check_batches``.
    """
    check_batches(dataset, settings, stage)

    def make(number: int) -> Mixed:
        source = disk_source(dataset, "train", ranges=stage.ranges) if number == 0 else fresh(number)
        options = {"seed": settings.seed + number, "prefetch": prefetch}
        parts = {name: iter(_clips(source, dataset, stage, task, **options)) for name, task in stage.tasks.items()}
        return Mixed(parts, seed=settings.seed + number)

    def fresh(number: int) -> CachedSource:
        rendering, clips = rendering_of(settings, ranges=stage.ranges), train_clips(settings, number)
        return live_source(clips, dataset.info.width, dataset.info.height, rendering=rendering)

    return make(0) if settings.data.fresh is None else Rounds(make, settings.data.fresh)


def initial_variables(member: Member, dataset: Dataset) -> PyTree:
    """Fresh variables of the last stage's method, which holds those of the stages before it."""
    last = member.stages[-1]
    batch = next(iter(first_batches(dataset, member.settings, last).values()))
    example = jax.tree.map(np.asarray, select_time(batch.frames, 0))
    return last.method.init(jax.random.key(member.settings.seed), example)


def first_batches(dataset: Dataset, settings: Settings, stage: Stage) -> dict[str, Sequence]:
    """Return the first one of each task that ``make_batches`` gives."""
    # Without fresh scenes: the next round would be rendered for nothing.
    batches = make_batches(dataset, with_data(settings, fresh=None), stage, prefetch=1)
    return dict(itertools.islice(batches, len(stage.tasks)))


def initial_state(member: Member, stage: Stage, variables: PyTree, batches: Mapping[str, Sequence]) -> TrainState:
    """Make what ``stage`` starts with: variables of its own and of the stages before it; histories where clips follow.

    Later stages' variables are not touched (nor saved) by it.
    """
    names = [each.name for each in member.stages]
    needed = {name: variables[name] for name in names[: names.index(stage.name) + 1]}
    history = {
        name: task.objective.start(batches[name])
        for name, task in stage.tasks.items()
        if isinstance(task.objective, Recurrent)
    }
    training = member.settings.training
    optimizer, average = OPTIMIZERS[training.optimizer](), training.average is not None
    return create_state(needed, stage.name, optimizer, history=history, average=average)


def make_steps(stage: Stage, settings: Settings) -> dict[str, Callable]:
    """Make the jitted steps of a stage, one for each task."""
    training, options = settings.training, {"compiler_options": settings.compiler_options}
    if training.average is not None:
        options["average"] = training.average
    optimizer = OPTIMIZERS[training.optimizer]()
    return {
        name: make_train_step(task.objective, optimizer, stage.name, task=name, **options)
        for name, task in stage.tasks.items()
    }


def train_member(
    member: Member, dataset: Dataset, variables: PyTree, watcher: Watcher, steps: Mapping[str, Any] | None = None
) -> tuple[PyTree, dict[str, Any]]:
    """Train all stages in order, from ``variables``; one with a checkpoint at the end of its budget is only restored.

    Args:
      member: its stages are trained, in its folder.
      dataset: with a split to train on.
      variables: the initial ones.
      watcher: told what happens.
      steps: stage -> its steps, where they are being compiled already (``Ahead.steps``).

    Returns:
      The variables, and stage -> what ``train`` says of it.
    """
    report, settings = {}, member.settings
    for stage in member.stages:
        state = initial_state(member, stage, variables, first_batches(dataset, settings, stage))
        validation = None
        if settings.training.validations is not None:
            validation = Validation(Scorer(stage.method, dataset, settings), settings.training.validations)
        checkpoints = Checkpoints(member.folder / "checkpoints" / stage.name)
        try:
            kept, report[stage.name] = train(
                (steps or {}).get(stage.name) or make_steps(stage, settings),
                state,
                make_batches(dataset, settings, stage),
                checkpoints,
                member.folder / "train" / f"{stage.name}.jsonl",
                stage.budget,
                functools.partial(learning_rate, peak=stage.settings.learning_rate, decay=stage.decay),
                trained=stage.name,
                validation=validation,
                save_every=settings.training.save_every,
                on_step=functools.partial(watcher.on_step, stage.name),
                on_compile=functools.partial(watcher.on_compile, stage.name),
                on_validation=functools.partial(watcher.on_validation, stage.name),
            )
        finally:
            checkpoints.close()
        variables = {**variables, **kept}
    return variables, report


def restore_member(member: Member, dataset: Dataset, variables: PyTree) -> tuple[PyTree, dict[str, Any]]:
    """Restore the variables of the stages' newest checkpoints, for ``--eval-only``, and how they were trained.

    Args:
      member: that was trained in its folder.
      dataset: that it was trained on.
      variables: the initial ones.

    Returns:
      The variables, and stage -> what ``train`` said of it, without terms.

    Raises:
      ValueError: a stage has no checkpoint, or one that does not fit the settings.
    """
    report = {}
    for stage in member.stages:
        folder = member.folder / "checkpoints" / stage.name
        if not folder.is_dir() or not os.listdir(folder):
            raise ValueError(
                f"--eval-only: {folder} holds no checkpoint. Train first, or give the --out of a trained run."
            )
        checkpoints = Checkpoints(folder)
        try:
            state = initial_state(member, stage, variables, first_batches(dataset, member.settings, stage))
            state, best, saved = restore_stage(checkpoints, state, stage.name)
        finally:
            checkpoints.close()
        variables = {**variables, **chosen_variables(state, best, stage.name, saved)}
        report[stage.name] = {**read_progress(saved), "steps": int(state.step), "terms": {}}
    return variables, report


def read_losses(out: Path, stage: str) -> list[tuple[int, float]]:
    """Step and loss of every step of a stage that was trained in ``out``; none where its log is gone."""
    path = out / "train" / f"{stage}.jsonl"
    lines = path.read_text(errors="replace").splitlines() if path.exists() else []
    found = []
    for line in lines:
        with contextlib.suppress(ValueError, KeyError, TypeError):  # a killed run leaves half a line
            entry = json.loads(line)
            found.append((entry["step"], entry["loss"]))
    return found
