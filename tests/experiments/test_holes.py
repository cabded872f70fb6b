"""Precision and recall of the hole mask against exact holes, counted over the scored frames."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.evaluate import Clip, estimated_valid
from experiments.holes import mask_remark, mask_scores
from tests.helpers import make_sequence

T, H, W = 5, 7, 10


def clip(name, seed, *, exact=True):
    sequence = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(seed, T, 1, H, W))
    holes = (np.random.default_rng(seed).random((T, H, W, 1)) < 0.3).astype(np.float32)
    return Clip(name, sequence, tuple(range(T)), [2, 4], holes, exact)


def test_the_share_that_is_found_and_the_share_that_is_right():
    clips = [clip("a", 0), clip("b", 1)]
    scores = mask_scores(clips)
    assert list(scores) == ["all", "a", "b"]
    both, marks, truths = 0, 0, 0
    for each in clips:
        marked = np.asarray(estimated_valid(each.sequence.frames))[[2, 4]] == 0
        truth = each.holes[[2, 4]] == 1
        assert 0 < (marked & truth).sum() < marked.sum() < marked.size
        found = scores[each.name]
        assert found["recall"] == pytest.approx((marked & truth).sum() / truth.sum())
        assert found["precision"] == pytest.approx((marked & truth).sum() / marked.sum())
        assert found["share"] == pytest.approx(truth.mean())
        both, marks, truths = both + (marked & truth).sum(), marks + marked.sum(), truths + truth.sum()
    assert scores["all"]["recall"] == pytest.approx(both / truths) != scores["a"]["recall"]
    assert scores["all"]["precision"] == pytest.approx(both / marks)


def test_what_the_reader_is_told():
    scores = {"recall": 0.553, "precision": None, "iou": 0.5, "share": 0.1}
    assert mask_remark({"all": scores, "a": {}}) == (
        "The methods' hole mask (from G-buffers) marks 55 % of the holes (recall), and – of what it marks are holes "
        "(precision); of each sequence: metrics.json."
    )


def test_estimated_holes_are_the_masks_own():
    assert mask_scores([clip("a", 0, exact=False)]) == {}
    marked = clip("a", 0)
    marked = dataclasses.replace(marked, holes=1.0 - np.asarray(estimated_valid(marked.sequence.frames)))
    assert mask_scores([marked])["all"]["recall"] == mask_scores([marked])["all"]["precision"] == 1.0
