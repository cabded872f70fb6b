"""The summary of an evaluation: means per sequence and over sequences; clips that are read one at a time."""

import dataclasses
import gc
import weakref

import jax
import numpy as np
import pytest

from essjax import methods
from essjax.data import write_dataset, write_sequence
from essjax.frames import Prediction
from experiments import evaluate as module
from experiments.evaluate import Clips, Runner, _summarise, evaluate, load_clip
from tests.helpers import make_sequence


def _entry(kind, psnr, non_finite=0):
    values = {"psnr": psnr, "psnr_foreground": psnr, "psnr_reference": None}
    return {"kind": kind, "resolution": "hr", **values, "non_finite": non_finite}


def test_a_frame_that_is_not_finite_leaves_no_mean_that_looks_better():
    curves = {
        "broken": {"a": [_entry("ss", None, 1), _entry("ss", 33.0), _entry("ess", 30.0)], "b": [_entry("ss", 31.0)]},
        "sound": {"a": [_entry("ss", 20.0), _entry("ss", 30.0)]},
    }
    rows = {(row["method"], row["sequence"], row["frames"]): row for row in _summarise(curves)}
    for sequence in ("a", "mean"):
        row = rows["broken", sequence, "ss"]
        assert row["psnr"] is None and row["psnr_foreground"] is None and row["non_finite"] == 1
    assert rows["broken", "b", "ss"]["psnr"] == 31.0 and rows["broken", "mean", "ess"]["psnr_foreground"] == 30.0
    assert rows["sound", "mean", "ss"]["psnr_foreground"] == pytest.approx(25.0)
    assert rows["sound", "mean", "ss"]["psnr_reference"] is None  # absent, not spoiled


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("clips")
    for number in range(3):
        made = make_sequence(number, 4, 1, 12, 16, native=True)
        write_sequence(root, f"s{number}", jax.tree.map(lambda leaf: np.array(leaf[:, 0]), made))
    return write_dataset(root, {"test": ["s0", "s1", "s2"]})


@pytest.fixture
def reads(monkeypatch):
    """Name of each clip that is read, and how many of those read before it are still in memory then."""
    found, alive = [], []

    def read(dataset, segment, **options):
        gc.collect()
        found.append((segment.sequence, sum(reference() is not None for reference in alive)))
        sequence = original(dataset, segment, **options)
        alive.append(weakref.ref(sequence.reference))
        return sequence

    original = module.read_segment
    monkeypatch.setattr(module, "read_segment", read)
    return found


def assert_same_clip(a, b):
    assert jax.tree.structure(a.sequence) == jax.tree.structure(b.sequence)
    jax.tree.map(np.testing.assert_array_equal, a.sequence, b.sequence)
    np.testing.assert_array_equal(a.holes, b.holes)
    assert (a.name, a.numbers, a.scored, a.exact_holes) == (b.name, b.numbers, b.scored, b.exact_holes)


def test_clips_are_read_when_asked_for_and_kept_within_the_bound(dataset, reads):
    whole = [load_clip(dataset, segment, 1) for segment in dataset.segments("test")]
    size = sum(leaf.nbytes for leaf in jax.tree.leaves((whole[0].sequence, whole[0].holes)))
    reads.clear()
    clips = Clips(dataset, "test", 1, memory=2 * size)
    assert len(clips) == 3 and not reads
    for clip, expected in zip(clips, whole, strict=True):
        assert_same_clip(clip, expected)
    list(clips)
    assert [name for name, _ in reads] == ["s0", "s1", "s2", "s2"]
    outlines = [clips.outline(n) for n in range(3)]
    assert len(reads) == 4
    for outline, expected in zip(outlines, whole, strict=True):
        np.testing.assert_array_equal(outline.sequence.reference, expected.sequence.reference[:1])
        assert outline.sequence.reference.base is None  # a view would hold the whole clip
        np.testing.assert_array_equal(outline.holes, expected.holes)


def test_equal_pictures_score_alike_whatever_the_schedule(tmp_path):
    """One method is given every frame, one every other frame; what the second shows in between is its own affair."""
    made = make_sequence(5, 8, 1, 12, 16)
    cut = np.arange(8) == 0
    frames = dataclasses.replace(made.frames, cut=jax.numpy.asarray(cut)[:, None])
    made = dataclasses.replace(made, frames=frames, valid=jax.numpy.ones_like(made.frames.gbuffers.depth))
    write_sequence(tmp_path, "s", jax.tree.map(lambda leaf: np.array(leaf[:, 0]), made))
    dataset = write_dataset(tmp_path, {"test": ["s"]})
    clips = [load_clip(dataset, dataset.segments("test")[0], 2)]
    half = methods.jau()
    whole = half._replace(info=half.info._replace(renders_all=True))
    dark = half._replace(
        extrapolate_step=lambda variables, history, frame, *, train=False: (
            history,
            Prediction(image=0 * history.inner["image"]),
        )
    )
    found = evaluate({name: Runner(m, {}) for name, m in (("whole", whole), ("half", half), ("dark", dark))}, clips)
    rows = [row for row in found["rows"] if row["sequence"] == "mean"]
    assert [row["frame_count"] for row in rows] == [1, 1, 1] and rows[0]["tpsnr"] > 5 and rows[0]["warped_error"] > 0
    for name in ("psnr", "tpsnr", "warped_error", "warped_error_reference", "psnr_foreground"):
        assert rows[0][name] == rows[1][name] == rows[2][name]
    assert rows[0]["temporal_error"] is not None and rows[1]["temporal_error"] is None


def test_an_estimated_mask_has_no_history_at_a_cut():
    frames = jax.tree.map(lambda leaf: leaf[:, 0], make_sequence(2, 3, 1, 12, 16).frames)
    still = dataclasses.replace(frames, gbuffers=jax.tree.map(lambda leaf: leaf.at[2].set(leaf[1]), frames.gbuffers))
    still = dataclasses.replace(still, motion=0 * still.motion, jitter=0 * still.jitter)
    shares = [
        float(module.estimated_valid(dataclasses.replace(still, cut=still.cut.at[2].set(cut)))[2].mean())
        for cut in (False, True)
    ]
    assert shares == [1.0, 0.0]


def test_native_frames_are_read_on_request(dataset):
    assert Clips(dataset, "test", 1, native=False)[0].sequence.native is None
    assert Clips(dataset, "test", 1)[0].sequence.native is not None


def test_an_evaluation_holds_one_clip_and_gives_the_same_numbers(dataset, reads):
    """The oracle: all clips in a list."""
    runners = {"bilinear": Runner(methods.bilinear(), {})}
    expected = evaluate(runners, [load_clip(dataset, segment, 1) for segment in dataset.segments("test")])
    reads.clear()
    found = evaluate(runners, Clips(dataset, "test", 1, memory=0))
    assert [name for name, _ in reads] == ["s0", "s1", "s2"]
    assert max(alive for _, alive in reads) == 0
    assert found["rows"] == expected["rows"] and found["curves"] == expected["curves"]
    assert len(found["pictures"]) == len(expected["pictures"]) > 0
    for a, b in zip(found["pictures"], expected["pictures"], strict=True):
        assert {k: a[k] for k in ("sequence", "frame", "kind")} == {k: b[k] for k in ("sequence", "frame", "kind")}
        jax.tree.map(np.testing.assert_array_equal, (a["images"], a["previous"]), (b["images"], b["previous"]))
