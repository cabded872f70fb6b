"""The type of objectives, and the rollouts of which they are made: every frame as both kinds, or the last alone."""

import dataclasses
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

    In the alternation a frame that is not rendered has one rendered frame to be made of from 1 on, two from 3 on; at 0
    it has none, and is no target.

    Args:
      cut: bool ``[T, ...]``.
    """
    number = jnp.arange(len(cut), dtype=jnp.int32).reshape(-1, *(1,) * (cut.ndim - 1))
    return number - jax.lax.cummax(jnp.where(cut, number, -_LONG_AGO), axis=0)


_LONG_AGO = 1 << 20


def frame_mean(values: Image, weight: Array) -> Array:
    """Mean over frames ``[..., H, W, C]`` that count ``weight`` ``[...]`` each; 0 where none counts."""
    return masked_mean(jnp.mean(values, axis=(-3, -2, -1)), weight)


@dataclasses.dataclass(frozen=True)
class Recurrent:
    """An objective that may carry its history from clip to clip: truncated backpropagation through time.

    Clips then follow each other (``data.successive_clips``): the network learns from histories as long as a shot, at
    the price of short clips; gradients end where a clip begins. Called as a plain ``Objective`` every clip starts anew,
    and the last frame of an even number is left out.

    Attributes:
      start: ``(clip) -> history`` before its frame 0, which is a cut.
      follow: ``(variables, clip, history) -> (terms, statistics, history)``, forgetting at cuts.
    """

    start: Callable[[Sequence], PyTree]
    follow: Callable[[PyTree, Sequence, PyTree], tuple[dict[str, Array], PyTree, PyTree]]

    def __call__(self, variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        """Return the terms of a clip that nothing precedes, and the new statistics."""
        clip = _begun(odd_length(clip))
        return self.follow(variables, clip, self.start(clip))[:2]


class BothKinds(NamedTuple):
    """The results of a clip, unrolled twice.

    Attributes:
      kinds: kind -> what was kept of frames 1 ... T-2, time-major.
      state: the new statistics, see ``Rollout.state``.
      history: of both runs after their last frame, for the clip that begins with this one's last frame.
    """

    kinds: dict[str, PyTree]
    state: PyTree
    history: PyTree


def _two_runs(frames: Frame) -> Frame:
    """Frames 0 ... T-2 and 1 ... T-1 side by side, ``[T-1, 2, B, ...]``; the second run forgets what the first does."""
    length = frames.motion.shape[0]
    if length < 3 or length % 2 == 0:
        raise ValueError(f"clip: expected an odd number of frames >= 3 (SS/ESS pairs from 0 and from 1), got {length}.")
    runs = jax.tree.map(lambda leaf: jnp.stack([leaf[:-1], leaf[1:]], axis=1), frames)
    return dataclasses.replace(runs, cut=runs.cut.at[0, 1].set(frames.cut[0] | frames.cut[1]))


def start_both_kinds(method: Method, clip: Sequence) -> PyTree:
    """Make the history that ``follow_both_kinds`` needs for a clip whose frame 0 is a cut."""
    return method.start(select_time(_two_runs(clip.frames), 0))


def follow_both_kinds(
    method: Method, variables: PyTree, clip: Sequence, keep: Callable[[dict], PyTree], history: PyTree
) -> BothKinds:
    """``both_kinds`` of a clip whose frame 0 is the last frame of the clip before, which left ``history``.

    Each run goes on with the frame that follows its last one: the first with frame 0, the second with frame 1.
    Where frame 0 is a cut both start anew. Raises as ``both_kinds``.
    """
    frames = _two_runs(clip.frames)
    rollout = unroll(method, variables, frames, alternate(0), train=True, keep=keep, history=history)

    def interleave(leaf: Array, first: int) -> Array:
        """Frames 1, 2, ...: from run ``first`` the pair k, then from the other run the pair k + 1 (or k)."""
        odd, even = leaf[:, first], leaf[:, 1 - first]
        # Run 0 renders frames 0, 2, ... and extrapolates 1, 3, ...; run 1 renders 1, 3, ... and extrapolates 2, 4, ...
        even = even[1:] if first == 1 else even[:-1]
        pairs = jnp.stack([odd[:-1], even], axis=1).reshape(-1, *odd.shape[1:])
        return jnp.concatenate([pairs, odd[-1:]])

    ordered = {SS: 1, ESS: 0}  # the run that has frame 1 as this kind
    kinds = {kind: jax.tree.map(partial(interleave, first=run), rollout.aux[kind]) for kind, run in ordered.items()}
    return BothKinds(kinds, rollout.state, rollout.history)


def both_kinds(
    method: Method, variables: PyTree, clip: Sequence, keep: Callable[[dict], PyTree]
) -> tuple[dict[str, PyTree], PyTree]:
    """Unroll ``clip`` twice, the second time from frame 1, side by side in one scan; both alternate SS, ESS, SS, ...

    Where one run renders the other extrapolates, so frames 1 ... T-2 are predicted as both kinds. As ESS, those that
    are cuts are made of nothing: see ``since_cut``.

    Returns:
      kind -> ``keep(aux)`` of frames 1 ... T-2, time-major; and the new statistics, see ``Rollout.state``.

    Raises:
      ValueError: the number of frames is even (SS/ESS pairs start from frames 0 and 1; see ``odd_length``) or below 3.
    """
    clip = _begun(clip)
    return follow_both_kinds(method, variables, clip, keep, start_both_kinds(method, clip))[:2]


def odd_length(clip: Sequence) -> Sequence:
    """``clip`` without its last frame if their number is even: what ``both_kinds`` takes."""
    length = clip.frames.motion.shape[0]
    return clip if length % 2 else select_time(clip, slice(0, length - 1))


def predict_last(method: Method, variables: PyTree, frames: Frame, schedule: Schedule | None = None) -> Prediction:
    """Predict the last frame of a clip (``train=True``), from the history that the schedule gives it.

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
    """Take the images from ``method``: a rollout of it computes what the history needs, and nothing else."""

    def silent(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            return step(variables, history, frame, train=train)[0], Prediction(image=jnp.zeros(()))

        return run

    steps = {"render_step": silent(method.render_step), "extrapolate_step": silent(method.extrapolate_step)}
    return method._replace(parts=None, **steps)
