"""Objective of DLCTUS: the last frames of a clip, with backpropagation through all of it (thesis 002 section 4.3)."""

import jax.numpy as jnp

from essjax.color import expose, reinhard
from essjax.frames import Sequence, select_time
from essjax.interfaces import Method, expand_flag
from essjax.losses import spatio_temporal
from essjax.rollout import SS, every, unroll
from essjax.train.objectives.common import Objective
from essjax.typing import Array, PyTree
from essjax.warp import backward_warp, upsample_motion


def dlctus_objective(method: Method, *, targets: int = 5, theta: float | None = None) -> Objective:
    """L1 (eq 7) or the spatio-temporal loss (eq 54, 55) over the last frames of a clip, on x / (1 + x).

    Earlier frames only make the history: loss at a few late frames was found to be enough, and it looks at histories
    that are as old as they get.

    Args:
      method: ``dlctus``.
      targets: number of frames with a loss; all but the first of a shorter clip (that one is the JAU frame).
      theta: share of the temporal term, in [0, 1]; None: plain L1. The previous frame's error is brought here with the
        motion, bilinearly; what that gets wrong stays in, as in the thesis. A cut has plain L1: nothing is before it.
    """

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        length = clip.frames.motion.shape[0]
        if length < 2:
            raise ValueError(f"clip: expected at least 2 frames, got {length}.")
        last = slice(max(length - targets, 1), length)
        keep = lambda aux: {name: aux[name] for name in ("encoded", "exposure")}  # noqa: E731
        rollout = unroll(method, variables, clip.frames, every(), train=True, keep=keep)
        shown = select_time(rollout.aux[SS], slice(last.start - 1, length))
        error = shown["encoded"] - reinhard(expose(clip.reference[last.start - 1 :], shown["exposure"]))
        if theta is None:
            return {"l1": jnp.mean(jnp.abs(error[1:]))}, rollout.state
        frames = select_time(clip.frames, last)
        motion = upsample_motion(frames.motion, clip.size, jitter=frames.jitter)
        before = jnp.where(expand_flag(frames.cut, error.ndim), 0.0, backward_warp(error[:-1], motion))
        loss = spatio_temporal(error[1:], before, theta=theta)
        return {"spatio_temporal": jnp.mean(loss)}, rollout.state

    return objective
