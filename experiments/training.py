"""Train a variant: its stages in order, each resumable from its newest checkpoint."""

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from essjax.data import CachedSource, Rounds, clips, disk_source
from essjax.data.layout import Dataset
from essjax.frames import select_time
from essjax.generate import RENDERER, live_source
from essjax.train import Checkpoints, create_state, learning_rate, make_train_step, optimizer, train
from essjax.typing import PyTree
from experiments.config import Config
from experiments.datasets import render_settings, train_clips
from experiments.variants.base import Stage

MIN_CROP = 24
OnStep = Callable[[str, int, float, dict[str, float]], None]
"""Called with stage, step, progress in [0, 1] and the terms."""


def make_batches(dataset: Dataset, config: Config, stage: Stage, *, prefetch: int = 4):
    """An iterator of clips ``[T, B, ...]`` for a stage: crops that fit the frames, as long as sequences allow.

    With ``config.fresh`` the scenes on disk are the first round, and each further one is rendered while the last is
    trained on. ``prefetch`` batches are held ready.

    Raises:
      ValueError: no sequence is long enough for a clip, the crop is too small, or ``fresh`` with imported data.
    """
    info = dataset.info
    width, height = (min(a, b) for a, b in zip(config.crop, (info.width, info.height), strict=True))
    if min(width, height) < MIN_CROP:
        raise ValueError(
            f"crop: expected at least {MIN_CROP}x{MIN_CROP} LR pixels (FRNet's coarsest features are an eighth), "
            f"got {width}x{height} from crop {config.crop} of {info.width}x{info.height} frames."
        )
    longest = max(len(dataset.numbers(segment)) for segment in dataset.segments("train"))
    length = min(config.clip, longest)
    cut = {"length": length, "batch": stage.batch, "crop": (height, width), "prefetch": prefetch}

    def make(number: int):
        source = disk_source(dataset, "train", ranges=stage.ranges) if number == 0 else fresh(number)
        return iter(clips(source, **cut, seed=config.seed + number))

    def fresh(number: int) -> CachedSource:
        settings = {**render_settings(config), "ranges": stage.ranges}
        return live_source(train_clips(config, number), info.width, info.height, **settings)

    if config.fresh is None:
        return make(0)
    if dataset.source.get("renderer") != RENDERER:
        raise ValueError(
            f"--set fresh={config.fresh}: {dataset.path} was not made by the built-in renderer, so there are no new "
            "scenes of it. Leave fresh away, or train on the built-in scenes (no --data)."
        )
    return Rounds(make, config.fresh)


def initial_variables(stages: list[Stage], dataset: Dataset, config: Config) -> PyTree:
    """Fresh variables of the last stage's method, which holds those of the stages before it."""
    # Without fresh scenes: the next round would be rendered for nothing.
    batch = next(make_batches(dataset, dataclasses.replace(config, fresh=None), stages[-1], prefetch=1))
    example = jax.tree.map(np.asarray, select_time(batch.frames, 0))
    return stages[-1].method.init(jax.random.key(config.seed), example)


def train_stages(
    stages: list[Stage], dataset: Dataset, config: Config, out: Path, on_step: OnStep
) -> tuple[PyTree, dict[str, Any]]:
    """Train all stages in order; one with a checkpoint at the end of its budget is only restored.

    Returns:
      The variables, and stage -> ``{"steps", "seconds", "terms"}``.
    """
    variables, report = initial_variables(stages, dataset, config), {}
    for stage in stages:
        transform = optimizer()
        # A stage sees only its own method's variables: a later stage's are not touched (nor saved) by an earlier one.
        needed = {name: variables[name] for name in _entries(stages, stage)}
        state = create_state(needed, stage.name, transform)
        checkpoints = Checkpoints(out / "checkpoints" / stage.name)
        try:
            state, report[stage.name] = train(
                make_train_step(stage.objective, transform, stage.name, compiler_options=config.compiler_options),
                state,
                make_batches(dataset, config, stage),
                checkpoints,
                out / "train" / f"{stage.name}.jsonl",
                stage.budget,
                functools.partial(learning_rate, peak=stage.learning_rate, decay=stage.decay),
                save_every=config.save_every,
                on_step=lambda step, progress, terms, name=stage.name: on_step(name, step, progress, terms),
            )
        finally:
            checkpoints.close()
        variables = {**variables, **state.variables}
    return variables, report


def restore_stages(stages: list[Stage], dataset: Dataset, config: Config, out: Path) -> tuple[PyTree, dict[str, Any]]:
    """The variables of the stages' newest checkpoints, for ``--eval-only``, and how they were trained.

    Returns:
      The variables, and stage -> ``{"steps", "seconds", "terms"}`` as ``train_stages`` gave them, without terms.

    Raises:
      ValueError: a stage has no checkpoint, or one that does not fit the settings.
    """
    variables, report = initial_variables(stages, dataset, config), {}
    for stage in stages:
        folder = out / "checkpoints" / stage.name
        if not folder.is_dir() or not os.listdir(folder):
            raise ValueError(
                f"--eval-only: {folder} holds no checkpoint. Train first, or give the --out of a trained run."
            )
        needed = {name: variables[name] for name in _entries(stages, stage)}
        checkpoints = Checkpoints(folder)
        try:
            state, saved = checkpoints.restore(create_state(needed, stage.name, optimizer()))
        finally:
            checkpoints.close()
        variables = {**variables, **state.variables}
        report[stage.name] = {"steps": int(state.step), "seconds": saved["seconds"], "terms": {}}
    return variables, report


def _entries(stages: list[Stage], stage: Stage) -> list[str]:
    """Names of the variables that ``stage`` needs: its own and those of the stages before it."""
    names = [s.name for s in stages]
    return names[: names.index(stage.name) + 1]
