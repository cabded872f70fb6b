"""The type of objectives, and the rollouts of which they are made: every frame in every phase, or the last alone."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.frames import Frame, Prediction, Sequence, select_time, without_color
from essjax.interfaces import Method, Step
from essjax.losses import masked_mean
from essjax.rollout import ESS, SS, Schedule, alternate, unroll
from essjax.typing import Array, Callable, Image, PyTree

Objective = Callable[[PyTree, Sequence], tuple[dict[str, Array], PyTree]]
"""``(variables, clip) -> (weighted terms, new BatchNorm statistics by entry)``; the loss is the sum of the terms."""


def _begun(clip: Sequence) -> Sequence:
    """``clip`` with a cut at frame 0: nothing precedes it."""
    cut = jnp.asarray(clip.frames.cut).at[0].set(True)
    return dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, cut=cut))


def since_cut(cut: Array) -> Array:
    """How many frames ago the last cut was, int32 ``[T, ...]``: 0 at a cut, far more than T before the first one.

    A frame that was rendered d frames ago has that one to be made of from d on, the one ``period`` before it too from
    d + period on; before d it has none, and is no target.

    Args:
      cut: bool ``[T, ...]``.
    """
    number = jnp.arange(len(cut), dtype=jnp.int32).reshape(-1, *(1,) * (cut.ndim - 1))
    return number - jax.lax.cummax(jnp.where(cut, number, -_LONG_AGO), axis=0)


_LONG_AGO = 1 << 20


def frame_mean(values: Image, weight: Array) -> Array:
    """Mean over frames ``[..., H, W, C]`` that count ``weight`` ``[...]`` each; 0 where none counts."""
    return masked_mean(jnp.mean(values, axis=(-3, -2, -1)), weight)


def mean_of(values: Iterable[Array]) -> Array:
    """Mean of several terms."""
    values = list(values)
    return sum(values[1:], start=values[0]) / len(values)


def by_kind(terms: list[dict[str, Array]]) -> dict[str, Array]:
    """Name the terms of phases, by distance from 0 on, by kind: "l1" becomes "l1_ss" and "l1_ess", a mean."""
    kinds = (SS, terms[:1]), (ESS, terms[1:])
    return {f"{name}_{kind}": mean_of(each[name] for each in part) for kind, part in kinds for name in part[0]}


@dataclasses.dataclass(frozen=True)
class Recurrent:
    """An objective that may carry its history from clip to clip: truncated backpropagation through time.

    Clips then follow each other (``data.successive_clips``): the network learns from histories as long as a shot, at
    the price of short clips; gradients end where a clip begins. Called as a plain ``Objective`` every clip starts anew,
    and the last frames of a number that does not fit are left out.

    Attributes:
      start: ``(clip) -> history`` before its frame 0, which is a cut.
      follow: ``(variables, clip, history) -> (terms, statistics, history)``, forgetting at cuts.
      period: one frame in so many is rendered.
    """

    start: Callable[[Sequence], PyTree]
    follow: Callable[[PyTree, Sequence, PyTree], tuple[dict[str, Array], PyTree, PyTree]]
    period: int = 2

    def __call__(self, variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        """Return the terms of a clip that nothing precedes, and the new statistics."""
        clip = _begun(whole_periods(clip, period=self.period))
        return self.follow(variables, clip, self.start(clip))[:2]


class Phase(NamedTuple):
    """A clip's frames as they are predicted ``distance`` frames after the last rendered one.

    Attributes:
      distance: 0 where they are rendered themselves.
      frames: which of the clip's they are.
      kept: what was kept of them, time-major.
    """

    distance: int
    frames: slice
    kept: PyTree

    @property
    def kind(self) -> str:
        """Rendered or extrapolated."""
        return ESS if self.distance else SS


class Phases(NamedTuple):
    """The results of a clip in every phase.

    Attributes:
      phases: by distance, from 0 on.
      state: the new statistics, see ``Rollout.state``.
      history: of all runs after their last frame, for the clip that begins with the frame after the first run's.
    """

    phases: list[Phase]
    state: PyTree
    history: PyTree


def fitting_length(length: int, period: int) -> int:
    """Return how many frames of ``length`` all ``period`` runs can share: a whole number of periods each, 0 if none.

    Run r takes frames r ... r + n - 1, n a multiple of the period: n + period - 1 frames in all.
    """
    taken = (length - period + 1) // period * period
    return taken + period - 1 if taken > 0 else 0


def whole_periods(clip: Sequence, *, period: int = 2) -> Sequence:
    """``clip`` without the last frames that ``every_phase`` has no use for.

    Raises:
      ValueError: it is too short.
    """
    length = clip.frames.motion.shape[0]
    fitting = fitting_length(length, period)
    if not fitting:
        raise ValueError(
            f"clip: expected at least {2 * period - 1} frames (each in every phase of a period of {period}), got "
            f"{length}."
        )
    return clip if fitting == length else select_time(clip, slice(0, fitting))


def _runs(frames: Frame, period: int) -> Frame:
    """Make ``period`` runs side by side, ``[n, period, B, ...]``, each a frame later; all forget at the same cuts."""
    length = frames.motion.shape[0]
    if length != fitting_length(length, period):
        raise ValueError(
            f"clip: expected {period - 1} frames and a multiple of {period} (one frame in {period} is rendered), got "
            f"{length}."
        )
    count = length - period + 1
    runs = jax.tree.map(lambda leaf: jnp.stack([leaf[r : r + count] for r in range(period)], axis=1), frames)
    cut = runs.cut
    for r in range(1, period):
        cut = cut.at[0, r].set(jnp.any(frames.cut[: r + 1], axis=0))
    return dataclasses.replace(runs, cut=cut)


def start_every_phase(method: Method, clip: Sequence, *, period: int = 2) -> PyTree:
    """Make the history that ``follow_every_phase`` needs for a clip whose frame 0 is a cut."""
    return method.start(select_time(_runs(clip.frames, period), 0))


def follow_every_phase(
    method: Method,
    variables: PyTree,
    clip: Sequence,
    keep: Callable[[dict], PyTree],
    history: PyTree,
    *,
    period: int = 2,
) -> Phases:
    """``every_phase`` of a clip that begins ``period - 1`` frames before the end of the clip that left ``history``.

    Each run goes on with the frame that follows its last one: the first with frame 0, the second with frame 1, ...
    Where frame 0 is a cut all start anew. Raises as ``every_phase``.
    """
    frames = _runs(clip.frames, period)
    rollout = unroll(method, variables, frames, alternate(period=period), train=True, keep=keep, history=history)
    count = frames.motion.shape[0]

    def at(leaf: Array, distance: int) -> Array:
        """Frames ``distance`` ... of the clip: run r renders its frames r, r + period, ..."""
        per_period = leaf.reshape(count // period, -1, *leaf.shape[1:])
        return per_period[:, max(distance - 1, 0)].reshape(count, *leaf.shape[2:])

    phases = [
        Phase(d, slice(d, d + count), jax.tree.map(partial(at, distance=d), rollout.aux[ESS if d else SS]))
        for d in range(period)
    ]
    return Phases(phases, rollout.state, rollout.history)


def every_phase(
    method: Method, variables: PyTree, clip: Sequence, keep: Callable[[dict], PyTree], *, period: int = 2
) -> tuple[list[Phase], PyTree]:
    """Unroll ``clip`` in ``period`` runs side by side in one scan, each from a frame later; each begins with SS.

    So frames are predicted in every phase: rendered, and extrapolated 1 ... period - 1 frames after the last rendered
    one, each from the history that the schedule gives it at inference. As ESS, those closer to a cut are made of
    nothing: see ``since_cut``.

    Returns:
      The phases, and the new statistics, see ``Rollout.state``.

    Raises:
      ValueError: the number of frames does not fit the period, see ``whole_periods``.
    """
    clip = _begun(clip)
    history = start_every_phase(method, clip, period=period)
    return follow_every_phase(method, variables, clip, keep, history, period=period)[:2]


def predict_last(method: Method, variables: PyTree, frames: Frame, schedule: Schedule | None = None) -> Prediction:
    """Predict the last frame of a clip (``train=True``), from the history that the schedule gives it.

    For losses on that frame alone. Of the steps before it only what the history needs is computed and differentiated.

    Args:
      method: the two steps.
      variables: its variables.
      frames: ``[T, ...]``, T >= 2.
      schedule: of the clip; None: every other frame is rendered, the last is extrapolated.

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
    """Take the images from ``method``: a rollout of it computes what the history needs, and nothing else."""

    def silent(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            return step(variables, history, frame, train=train)[0], Prediction(image=jnp.zeros(()))

        return run

    steps = {"render_step": silent(method.render_step), "extrapolate_step": silent(method.extrapolate_step)}
    return method._replace(parts=None, **steps)
