"""How well ``warp.hole_mask``, which every method uses, finds the holes that the renderer knows exactly."""

import collections.abc
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.classes import class_scores, confusion
from experiments.evaluate import Clip, estimated_valid


def mask_scores(clips: collections.abc.Sequence[Clip]) -> dict[str, dict[str, Any]]:
    """Score the class "hole" in the scored frames, each against the frame before, over LR pixels.

    Args:
      clips: the test sequences; one is in use at a time.

    Returns:
      "all" (of all pixels together) and each sequence -> ``{"recall", "precision", "iou", "share"}``: the share of the
      exact holes that are marked, the share of the marked pixels that are holes, and the share of pixels that are
      holes; None where there is nothing to divide by. Empty where holes are estimated: they are the mask's own.
    """
    counts = {}
    for index in range(len(clips)):  # not over the clips themselves: one would be held while the next is read
        clip = clips[index]
        if clip.exact_holes:
            marked = 1.0 - np.asarray(estimated_valid(clip.sequence.frames))
            counts[clip.name] = confusion(marked[clip.scored], clip.holes[clip.scored], 2)
    if not counts:
        return {}
    counts = {"all": np.sum(list(counts.values()), axis=0), **counts}
    return {name: class_scores(matrix, ("valid", "hole"))["hole"] for name, matrix in counts.items()}


def mask_remark(scores: Mapping[str, Mapping[str, Any]]) -> str:
    """One line for the reader of the table."""
    part = lambda found, name: "–" if found[name] is None else f"{100 * found[name]:.0f} %"
    found = scores["all"]
    return (
        f"The methods' hole mask (from G-buffers) marks {part(found, 'recall')} of the holes (recall), and "
        f"{part(found, 'precision')} of what it marks are holes (precision); of each sequence: metrics.json."
    )
