"""What objectives are, and the rollouts behind them: every frame as both kinds, or the last frame alone."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

from essjax.frames import Frame, Prediction, Sequence, select_time, without_color
from essjax.interfaces import Method, Step
from essjax.rollout import ESS, SS, Schedule, alternate, unroll
from essjax.typing import Array, Callable, PyTree

Objective = Callable[[PyTree, Sequence], tuple[dict[str, Array], PyTree]]
"""``(variables, clip) -> (weighted terms, new BatchNorm statistics by entry)``; the loss is the sum of the terms."""


def both_kinds(
    method: Method, variables: PyTree, clip: Sequence, keep: Callable[[dict], PyTree]
) -> tuple[dict[str, PyTree], PyTree]:
    """Unroll ``clip`` twice, the second time from frame 1, side by side in one scan; both alternate SS, ESS, SS, ...

    Where one run renders the other extrapolates, so frames 1 ... T-2 are predicted as both kinds.

    Returns:
      kind -> ``keep(aux)`` of frames 1 ... T-2, time-major; and the new statistics, see ``Rollout.state``.

    Raises:
      ValueError: the number of frames is even (SS/ESS pairs start from frames 0 and 1; see ``odd_length``) or below 3.
    """
    length = clip.frames.motion.shape[0]
    if length < 3 or length % 2 == 0:
        raise ValueError(f"clip: expected an odd number of frames >= 3 (SS/ESS pairs from 0 and from 1), got {length}.")
    runs = jax.tree.map(lambda leaf: jnp.stack([leaf[:-1], leaf[1:]], axis=1), clip.frames)
    runs = dataclasses.replace(runs, cut=runs.cut.at[0].set(True))
    rollout = unroll(method, variables, runs, alternate(0), train=True, keep=keep)

    def interleave(leaf: Array, first: int) -> Array:
        """Frames 1, 2, ...: from run ``first`` the pair k, then from the other run the pair k + 1 (or k)."""
        odd, even = leaf[:, first], leaf[:, 1 - first]
        # Run 0 renders frames 0, 2, ... and extrapolates 1, 3, ...; run 1 renders 1, 3, ... and extrapolates 2, 4, ...
        even = even[1:] if first == 1 else even[:-1]
        pairs = jnp.stack([odd[:-1], even], axis=1).reshape(-1, *odd.shape[1:])
        return jnp.concatenate([pairs, odd[-1:]])

    ordered = {SS: 1, ESS: 0}  # the run that has frame 1 as this kind
    kinds = {kind: jax.tree.map(partial(interleave, first=run), rollout.aux[kind]) for kind, run in ordered.items()}
    return kinds, rollout.state


def odd_length(clip: Sequence) -> Sequence:
    """``clip`` without its last frame if their number is even: what ``both_kinds`` takes."""
    length = clip.frames.motion.shape[0]
    return clip if length % 2 else select_time(clip, slice(0, length - 1))


def predict_last(method: Method, variables: PyTree, frames: Frame, schedule: Schedule | None = None) -> Prediction:
    """What the step of the last frame of a clip returns (``train=True``), from the history that the schedule gives it.

    For losses on that frame alone. Of the steps before it only what the history needs is computed and differentiated.

    Args:
      method: the two steps.
      variables: its variables.
      frames: ``[T, ...]``, T >= 2.
      schedule: of the clip; None: the alternation that extrapolates the last frame.

    Raises:
      ValueError: there are fewer than two frames.
    """
    length = frames.motion.shape[0]
    if length < 2:
        raise ValueError(f"clip: expected at least 2 frames, the last to predict and one before it, got {length}.")
    schedule = alternate(length % 2) if schedule is None else schedule
    before: Frame = select_time(frames, slice(0, length - 1))
    history = unroll(_unseen(method), variables, before, schedule).history
    last: Frame = select_time(frames, length - 1)
    if schedule.kinds(length)[-1] == SS:
        return method.render_step(variables, history, last, train=True)[1]
    return method.extrapolate_step(variables, history, without_color(last), train=True)[1]


def _unseen(method: Method) -> Method:
    """``method`` without images: a rollout of it computes what the history needs, and nothing else."""

    def silent(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            return step(variables, history, frame, train=train)[0], Prediction(image=jnp.zeros(()))

        return run

    steps = {"render_step": silent(method.render_step), "extrapolate_step": silent(method.extrapolate_step)}
    return method._replace(**steps)
