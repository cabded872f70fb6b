"""How a classifier's classes compare with the automatic labels: counts per class, and maps for the report."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax.frames import Frame, SampleRanges
from essjax.interfaces import Method
from essjax.labels import ALIASING, GHOSTING, Thresholds, label_sequence
from essjax.rollout import SS, every, unroll
from essjax.typing import PyTree
from experiments.evaluate import Clip

QUESTIONS = {"ghosting": GHOSTING, "aliasing": ALIASING}


class ClassMaps(NamedTuple):
    """The classes of one frame.

    Attributes:
      sequence: its name.
      frame: original number.
      reference: exposed ``[H, W, 3]``.
      predicted: question -> index ``[H, W]``.
      automatic: the same of the labels.
    """

    sequence: str
    frame: int
    reference: np.ndarray
    predicted: dict[str, np.ndarray]
    automatic: dict[str, np.ndarray]


def evaluate_classes(
    method: Method, variables: PyTree, clips: Sequence[Clip], thresholds: Thresholds, options: dict | None = None
) -> tuple[dict[str, Any], list[ClassMaps]]:
    """Compare the classes of all scored frames with their labels.

    Args:
      method: ``classifier``.
      variables: its trained variables.
      clips: test sequences with sample ranges.
      thresholds: of the labels.
      options: for ``jax.jit``.

    Returns:
      question -> ``{"accuracy", class -> {"iou", "precision", "recall", "share"}}`` over all pixels of all sequences,
      under "all", and of each sequence under its name; and per sequence the maps of the frame with most ghosting.
    """

    @functools.partial(jax.jit, compiler_options=options)
    def run(variables: PyTree, frames: Frame, ranges: SampleRanges) -> tuple[dict, dict]:
        def keep(aux: dict) -> dict:
            return {name: jnp.argmax(aux[name], axis=-1) for name in QUESTIONS} | {"exposure": aux["exposure"]}

        batch = jax.tree.map(lambda leaf: leaf[:, None], frames)
        kept = unroll(method, variables, batch, every(), keep=keep).aux[SS]
        kept = {name: values[:, 0] for name, values in kept.items()}
        labels = label_sequence(ranges, frames.cut, at=thresholds, exposure=kept.pop("exposure"))
        return kept, {name: getattr(labels, name)[..., 0] for name in QUESTIONS}

    counts: dict[str, dict[str, np.ndarray]] = {}
    maps = []
    for clip in clips:
        if clip.sequence.ranges is None:
            continue
        predicted, automatic = jax.device_get(run(variables, clip.sequence.frames, clip.sequence.ranges))
        at = clip.scored
        counts[clip.name] = {
            name: confusion(predicted[name][at], automatic[name][at], len(names)) for name, names in QUESTIONS.items()
        }
        if at:
            n = max(at, key=lambda n: (automatic["ghosting"][n] < 2).mean())
            chosen = [{name: classes[name][n] for name in QUESTIONS} for classes in (predicted, automatic)]
            maps.append(ClassMaps(clip.name, clip.numbers[n], clip.exposure[n] * clip.sequence.reference[n], *chosen))
    return _scores(counts), maps


def confusion(predicted: np.ndarray, automatic: np.ndarray, count: int) -> np.ndarray:
    """How many pixels of label i (row) were predicted as class k (column), ``[count, count]``."""
    pairs = automatic.astype(np.int64).ravel() * count + predicted.astype(np.int64).ravel()
    return np.bincount(pairs, minlength=count**2).reshape(count, count)


def class_scores(matrix: np.ndarray, names: Sequence[str]) -> dict[str, Any]:
    """IoU, precision, recall (None where there is nothing to divide by) and share of each class, and the accuracy."""
    total = max(int(matrix.sum()), 1)
    scores: dict[str, Any] = {"accuracy": float(np.trace(matrix)) / total}
    for k, name in enumerate(names):
        hit, labelled, predicted = (int(n) for n in (matrix[k, k], matrix[k].sum(), matrix[:, k].sum()))
        parts = {"iou": labelled + predicted - hit, "precision": predicted, "recall": labelled}
        scores[name] = {part: hit / whole if whole else None for part, whole in parts.items()}
        scores[name]["share"] = labelled / total
    return scores


def _scores(counts: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Any]:
    if not counts:
        return {}
    whole = {name: np.sum([matrices[name] for matrices in counts.values()], axis=0) for name in QUESTIONS}
    return {
        where: {name: class_scores(matrices[name], names) for name, names in QUESTIONS.items()}
        for where, matrices in {"all": whole, **counts}.items()
    }


def class_remark(name: str, scores: Mapping[str, Any]) -> str:
    """One line for the reader of the table."""
    parts = []
    for question, names in QUESTIONS.items():
        found = scores["all"][question]
        each = ", ".join(f"{n} {'–' if found[n]['iou'] is None else format(found[n]['iou'], '.2f')}" for n in names)
        parts.append(f"{question} {each} (accuracy {100 * found['accuracy']:.0f} %)")
    return (
        f"{name}: intersection over union of its classes with the automatic labels on the test frames: "
        f"{'; '.join(parts)}. Maps: report/labels-*.png."
    )
