"""Whether training did anything: too few steps, a dead network, and what to tell the user about it."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from essjax.color import display, expose
from essjax.rollout import alternate, every
from essjax.train import best_validation, mean_score
from essjax.typing import PyTree
from experiments.evaluate import Clip, Runner

FEW_STEPS = 100
"""A stage that made fewer has learned little: its learning rate warms up over the first 20."""
STILL_STEPS = 10
"""So many steps in a row whose gradient is exactly zero are no accident."""
SAME_DECIBEL = 1e-4
SAME_IMAGE = 1e-6
"""After x/(1+x) and sRGB: the rounding of float32."""
FRAMES = 8


def training_note(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """How long each stage trained; nothing if none did.

    Args:
      reports: stage -> what ``essjax.train.train`` says of it.
    """
    parts = [
        f"{stage} {_steps(found['steps'])} in {found['seconds']:.0f} s (waited {found['compile_seconds']:.0f} s to be "
        f"compiled){_validations(found['validated'])}"
        for stage, found in reports.items()
    ]
    return [f"Training: {'; '.join(parts)}."] if parts else []


def _validations(validated: Sequence[Mapping[str, float]]) -> str:
    if len(validated) < 2:  # not even after the start
        return ""
    best = validated[best_validation(list(validated))]
    scores = ", ".join(f"{kind.upper()} {value:.2f} dB" for kind, value in best.items() if kind != "step")
    return f", kept as it was at step {best['step']}, the best of {len(validated) - 1} validations ({scores})"


def no_gain(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Warn of each stage whose best validation is below that of its start."""
    messages = []
    for stage, found in reports.items():
        validated = list(found["validated"])
        if len(validated) < 2:
            continue
        before, after = (mean_score(validated[n]) for n in (0, best_validation(validated)))
        if after < before - SAME_DECIBEL:
            messages.append(
                f"{stage}: on the validation frames it is at {after:.2f} dB, at its start it was at {before:.2f} dB: "
                "this training did harm. Give it more steps or a smaller learning rate."
            )
    return messages


def has_few_steps(reports: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether a stage ended too soon to have learned much."""
    return any(found["steps"] < FEW_STEPS for found in reports.values())


def few_steps(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Warn of each stage that ended too soon to have learned much."""
    return [
        f"{stage} made only {_steps(found['steps'])}: too few to learn much, so its numbers say little. Give it more "
        f"with --set {stage.split('/')[-1]}.seconds=N (or .steps=N), or a faster or less busy machine."
        for stage, found in reports.items()
        if has_few_steps({stage: found})
    ]


def _steps(count: int) -> str:
    return f"{count} step{'' if count == 1 else 's'}"


def is_still(still: int, steps: int) -> bool:
    """Whether the last ``still`` of ``steps`` steps, all without a gradient, say that nothing is learned any more."""
    return 0 < min(STILL_STEPS, steps) <= still


def still_stages(reports: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Name each stage whose gradient is exactly zero."""
    return [
        f"{stage}: the gradient is exactly zero since step {found['steps'] - found['still'] + 1} of {found['steps']}."
        for stage, found in reports.items()
        if is_still(found["still"], found["steps"])
    ]


def same_rows(rows: Sequence[Mapping[str, Any]], owners: Mapping[str, str | None]) -> list[str]:
    """Name each trained method whose row is that of another method in every sequence and kind.

    Args:
      rows: of ``metrics.json``.
      owners: method -> the variant that it has its weights from, whose methods may agree; None for a heuristic and
        where ``few_steps`` has warned already.
    """
    scores: dict[str, dict[tuple, float]] = {name: {} for name in owners}
    for row in rows:
        if row["method"] in scores and row.get("psnr") is not None:
            scores[row["method"]][row["sequence"], row["frames"], row["resolution"]] = row["psnr"]
    messages = []
    for name, owner in owners.items():
        for other, ours in scores.items():
            if owner is None or owner == owners[other] or (owners[other] and other < name) or not scores[name]:
                continue
            if all(abs(value - ours.get(key, np.inf)) < SAME_DECIBEL for key, value in scores[name].items()):
                messages.append(f"{name}: its row is that of {other}, so its network adds nothing.")
    return messages


def unchanged(name: str, runner: Runner, initial: PyTree, clip: Clip) -> list[str]:
    """Say if a trained method shows what it showed before training.

    Args:
      name: of the method.
      runner: with its trained variables.
      initial: the variables before training.
      clip: its first frames are run.
    """
    sequence = jax.tree.map(lambda leaf: leaf[:FRAMES], clip.sequence)
    untrained = copy.copy(runner)  # what is compiled serves both
    untrained.variables = {entry: initial[entry] for entry in runner.variables}
    schedule = every() if runner.method.info.renders_all else alternate(0)
    exposure = clip.exposure[:FRAMES]
    now, before = (np.asarray(display(expose(run(sequence, schedule), exposure))) for run in (runner, untrained))
    if not np.max(np.abs(now - before)) <= SAME_IMAGE:  # nor NaN
        return []
    return [f"{name}: it shows the same as before training."]
