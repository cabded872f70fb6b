"""The training loop: a budget in steps or seconds, checkpoints, exact resumption, a stop on signals and on NaN.

The clock counts training: a step with the wait for its batch, but neither compilation nor validation nor saving.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax.files import atomic, naming
from essjax.stopping import finishing
from essjax.train.checkpoint import Checkpoints
from essjax.train.state import TrainState, averaged
from essjax.typing import PyTree


class NonFiniteLoss(RuntimeError):
    """A loss or gradient was NaN or infinite; the batch is saved, the last checkpoint is from before it."""


class Validation(NamedTuple):
    """How good the weights are on held-out data, several times in a stage; the best are kept.

    Attributes:
      score: variables -> kind of frame -> PSNR, dB; the mean over kinds counts.
      times: how often after the start, equally apart in the budget; the last time is at its end.
    """

    score: Callable[[PyTree], dict[str, float]]
    times: int


class Budget(NamedTuple):
    """When a stage ends: after ``steps``, or after ``seconds`` of training in all runs together; None = no limit.

    A limit of 0 is used up before the first step.
    """

    steps: int | None
    seconds: float | None

    def progress(self, step: int, seconds: float) -> float:
        """Fraction that is used up, in [0, 1]. With a limit in steps alone it does not depend on the machine."""
        limits = ((step, self.steps), (seconds, self.seconds))
        used = [spent / limit if limit > 0 else 1.0 for spent, limit in limits if limit is not None]
        if not used:
            raise ValueError("budget: expected a limit in steps or in seconds, got neither.")
        return min(max(used), 1.0)


def train(
    steps: Mapping[str, Callable],
    state: TrainState,
    batches: Iterator,
    checkpoints: Checkpoints,
    log_path: Path,
    budget: Budget,
    schedule: Callable[[int, float], float],
    *,
    trained: str,
    validation: Validation | None = None,
    save_every: float = 30.0,
    on_step: Callable[[int, float, dict[str, float]], None] = lambda step, progress, terms: None,
    on_compile: Callable[[], None] = lambda: None,
    on_validation: Callable[[int, float, dict[str, float]], None] = lambda step, progress, scores: None,
) -> tuple[PyTree, dict[str, Any]]:
    """Run a stage to the end of its budget, from its newest checkpoint if there is one.

    Args:
      steps: task -> its step, from ``make_train_step``, or what its ``lower(...).compile()`` gave for these shapes; it
        is compiled when its first batch comes, which the clock does not count.
      state: the state at step 0; the checkpoint's replaces it.
      batches: of task and batch, a ``data.Mixed``: ``next``, ``get_state``, ``set_state``.
      checkpoints: where the state is kept.
      log_path: JSON lines, one per step; cut back to the checkpoint's step when a run resumes.
      budget: when to end.
      schedule: learning rate of step and progress in [0, 1].
      trained: the entry of the variables that is trained.
      validation: which weights are kept; None: the last.
      save_every: seconds between checkpoints.
      on_step: called with step, progress and the terms of that step.
      on_compile: called before the step is compiled, if it has to be.
      on_validation: called before each validation with step, progress and nothing, and after it with its scores.

    Returns:
      The variables that were best in validation, averaged where the state holds an average, and a summary of all runs
      together: ``steps``; ``seconds`` of training; ``compile_seconds`` and ``validation_seconds``; ``still``, how many
      steps up to the last had a gradient of exactly zero; ``validated``, step and scores of each validation, the first
      of the start, which is not kept; ``terms`` of the last step.

    Raises:
      Interrupted: a signal came, see ``essjax.stopping``; everything is saved.
      NonFiniteLoss: names the terms; the batch is in ``log_path``'s folder.
    """
    steps = dict(steps)
    spent, best = read_progress({}), state.variables[trained]
    if checkpoints.latest() is not None:
        state, best, saved = restore_stage(checkpoints, state, trained)
        spent = read_progress(saved)
        batches.set_state(saved["batches"])  # type: ignore[attr-defined]
    best = jax.tree.map(np.asarray, best)  # the step donates its state
    step, terms = int(state.step), {}
    _truncate(log_path, step)
    last_save = time.monotonic()
    saved = lambda: f"stopped at step {step}; the state is saved. Run the same command with --resume."
    with finishing(saved) as section, naming(log_path), log_path.open("a") as log:

        def save():
            log.flush()
            so_far = {**spent, "batches": batches.get_state()}  # type: ignore[attr-defined]
            checkpoints.save(step, {"state": state, "best": best}, so_far)

        def progress() -> float:
            return budget.progress(step, spent["seconds"])

        def validate(validation: Validation) -> None:
            nonlocal best
            on_validation(step, progress(), {})
            began, candidate = time.monotonic(), averaged(state, trained)
            scores = validation.score(candidate)
            spent["validated"].append({"step": step, **scores})
            if best_validation(spent["validated"]) == len(spent["validated"]) - 1:
                best = jax.tree.map(np.asarray, candidate[trained])
            spent["validation_seconds"] += time.monotonic() - began
            on_validation(step, progress(), scores)

        if validation and not spent["validated"] and progress() < 1.0:
            with section.at_rest():
                validate(validation)
        while progress() < 1.0 and not section.asked:
            began = time.monotonic()
            (task, batch), rate = next(batches), schedule(step, progress())
            if hasattr(steps[task], "lower"):
                waited = time.monotonic() - began
                on_compile()
                began = time.monotonic()
                with section.at_rest():
                    steps[task] = steps[task].lower(state, batch, rate).compile()
                spent["compile_seconds"] += time.monotonic() - began
                began = time.monotonic() - waited
            state, terms = steps[task](state, batch, rate)
            terms = {name: float(value) for name, value in jax.device_get(terms).items()}
            step, spent["seconds"] = step + 1, spent["seconds"] + time.monotonic() - began
            if not all(np.isfinite(value) for value in terms.values()):
                _raise_non_finite(step, terms, batch, log_path.parent)
            spent["still"] = 0 if terms["gradient_norm"] else spent["still"] + 1
            log.write(json.dumps({"step": step, "seconds": round(spent["seconds"], 2), **terms}) + "\n")
            on_step(step, progress(), terms)
            if validation and int(progress() * validation.times) >= len(spent["validated"]):
                validate(validation)
            if time.monotonic() - last_save > save_every:
                save()
                last_save = time.monotonic()
        save()
    return chosen_variables(state, best, trained, spent), {"steps": step, **spent, "terms": terms}


def restore_stage(
    checkpoints: Checkpoints, state: TrainState, trained: str
) -> tuple[TrainState, PyTree, dict[str, Any]]:
    """Restore the newest checkpoint of a stage that starts with ``state``: its state, best entry so far, progress."""
    found, saved = checkpoints.restore({"state": state, "best": state.variables[trained]})
    return found["state"], found["best"], saved


def chosen_variables(state: TrainState, best: PyTree, trained: str, progress: dict[str, Any]) -> PyTree:
    """Choose what a stage ends with: the best of its validations, without any the last (averaged) variables."""
    if len(progress.get("validated", ())) > 1:  # not the start alone
        return {**state.variables, trained: jax.tree.map(jnp.asarray, best)}
    return averaged(state, trained)


def mean_score(scores: dict[str, float]) -> float:
    """Average the PSNR of one validation over kinds; minus infinity where it is not finite."""
    value = float(np.mean([value for name, value in scores.items() if name != "step"]))
    return value if np.isfinite(value) else -np.inf


def best_validation(validated: list[dict[str, float]]) -> int:
    """Index of the best ``mean_score`` after the start; of equally good ones the last."""
    return max(range(len(validated)), key=lambda n: (n > 0, mean_score(validated[n]), n))


def read_progress(saved: dict[str, Any]) -> dict[str, Any]:
    """Read what a checkpoint's progress says of the stage so far, see ``train``; nothing where it is absent."""
    nothing = {"seconds": 0.0, "compile_seconds": 0.0, "validation_seconds": 0.0, "still": 0, "validated": []}
    return {name: saved.get(name, value) for name, value in nothing.items()}


def _raise_non_finite(step: int, terms: dict[str, float], batch: Any, folder: Path) -> None:
    names = [name for name, value in terms.items() if not np.isfinite(value) and name != "loss"] or ["loss"]
    path = folder / f"non_finite_batch_{step}.npz"
    leaves, _ = jax.tree_util.tree_flatten_with_path(batch)
    arrays: dict[str, Any] = {jax.tree_util.keystr(key).strip("."): np.asarray(leaf) for key, leaf in leaves}
    np.savez_compressed(path, **arrays)
    raise NonFiniteLoss(
        f"step {step}: not finite: {', '.join(names)}. The batch is in {path}; the last checkpoint is from before it. "
        "Check the data (NaN, negative or huge radiance) or lower the learning rate."
    )


def _truncate(path: Path, step: int) -> None:
    """Drop log lines that came after the checkpoint: the resumed run writes them again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        lines = path.read_text().splitlines()[:step]
        with atomic(path) as temporary:
            temporary.write_text("".join(line + "\n" for line in lines))
