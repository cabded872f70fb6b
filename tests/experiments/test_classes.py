"""Classes against labels: counts by hand, which frames are compared, and the pictures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from essjax.data import read_dataset, write_dataset, write_sequence
from essjax.exposure import exposed
from essjax.frames import Prediction
from essjax.interfaces import Method, MethodInfo
from essjax.labels import ALIASING, GHOSTING, Thresholds, label_sequence
from experiments import datasets
from experiments.classes import QUESTIONS, class_remark, class_scores, confusion, evaluate_classes
from experiments.evaluate import Clip
from experiments.members import settings_of
from experiments.report.classes import COLORS, class_picture, write_class_sheet
from experiments.variants import VARIANTS
from experiments.variants.classifier import thresholds
from tests.helpers import make_sequence

T, H, W = 5, 4, 6
AT = Thresholds(ghosting_depth=0.3, opening=2)


def test_scores_by_hand():
    automatic = np.array([0, 0, 0, 1, 2, 2, 2, 2])
    predicted = np.array([0, 0, 2, 2, 2, 2, 0, 2])
    matrix = confusion(predicted, automatic, 3)
    np.testing.assert_array_equal(matrix, [[2, 0, 1], [0, 0, 1], [1, 0, 3]])
    scores = class_scores(matrix, GHOSTING)
    assert scores["accuracy"] == pytest.approx(5 / 8)
    assert scores["visibility"] == pytest.approx({"iou": 2 / 4, "precision": 2 / 3, "recall": 2 / 3, "share": 3 / 8})
    assert scores["shading"] == {"iou": 0.0, "precision": None, "recall": 0.0, "share": 1 / 8}
    assert scores["none"]["iou"] == pytest.approx(3 / 6)
    assert class_scores(np.zeros((3, 3), int), GHOSTING)["shading"]["iou"] is None


def clip(name, seed):
    sequence = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(seed, T, 1, H, W, ranges=True))
    return Clip(name, sequence, tuple(range(8, 8 + T)), [2, 3, 4], 1.0 - sequence.valid, True)


def oracle(shift):
    """A method that knows the ghosting labels (its variables, by frame) and calls everything geometry aliasing."""

    def step(variables, history, frame, *, train=False):
        shape = (1, 2 * H, 2 * W)
        ghosting = jax.nn.one_hot((variables[history] + shift) % 3, 3)[None]
        aliasing = jnp.broadcast_to(jnp.array([0.8, 0.1, 0.1]), (*shape, 3))
        aux = {"ghosting": ghosting, "aliasing": aliasing}
        return history + 1, Prediction(image=jnp.zeros((*shape, 3)), aux=aux)

    info = MethodInfo("oracle", 2, renders_all=True)
    return exposed(Method(lambda key, example: {}, lambda example: jnp.zeros((), jnp.int32), step, step, info))


def test_scored_frames_are_compared():
    clips = [clip("a", 0)]
    sequence = clips[0].sequence
    labels = jax.device_get(label_sequence(sequence.ranges, jnp.asarray(sequence.frames.cut), at=AT))
    known = jnp.asarray(labels.ghosting[..., 0])
    scores, maps = evaluate_classes(oracle(0), known, clips, AT)
    assert set(scores) == {"all", "a"} and scores["all"] == scores["a"]
    assert scores["all"]["ghosting"]["accuracy"] == 1.0
    geometry = (labels.aliasing[2:] == ALIASING.index("geometry")).mean()
    assert scores["all"]["aliasing"]["geometry"]["iou"] == pytest.approx(geometry)
    wrong, _ = evaluate_classes(oracle(1), known, clips, AT)
    assert wrong["all"]["ghosting"]["accuracy"] == 0.0
    (found,) = maps
    shares = [(labels.ghosting[n] < 2).mean() for n in (2, 3, 4)]
    assert found.frame == 10 + int(np.argmax(shares))
    np.testing.assert_array_equal(found.automatic["ghosting"], labels.ghosting[found.frame - 8, ..., 0])
    remark = class_remark("oracle", scores)
    assert "ghosting visibility 1.00" in remark and "(accuracy 100 %)" in remark
    bare = dataclasses.replace(clips[0], sequence=dataclasses.replace(sequence, ranges=None))
    assert evaluate_classes(oracle(0), known, [bare], AT) == ({}, [])


def test_what_the_variant_finds_for_a_run(tmp_path):
    """Scores, a remark and a picture, by the thresholds of the run's size; nothing of data without ranges."""
    clips = [clip("a", 0)]
    settings = settings_of("classifier", "smoke", [f"data.size=[{W},{H}]"])
    frames = clips[0].sequence.frames
    labels = label_sequence(clips[0].sequence.ranges, jnp.asarray(frames.cut), at=thresholds(settings))
    known, inspect = jnp.asarray(labels.ghosting[..., 0]), VARIANTS["classifier"].inspect
    found = inspect(oracle(0), known, clips, settings, tmp_path / "report")
    assert found.scores["all"]["ghosting"]["accuracy"] == 1.0 and found.remark.startswith("classifier: intersection")
    assert len(list((tmp_path / "report").glob("labels-a-frame-*.png"))) == 1
    bare = dataclasses.replace(clips[0], sequence=dataclasses.replace(clips[0].sequence, ranges=None))
    assert inspect(oracle(0), known, [bare], settings, tmp_path) is None


def test_pictures(tmp_path):
    reference = np.full((4, 6, 3), 0.5, np.float32)
    classes = np.full((4, 6), 2)
    classes[1, 2], classes[3, 5] = 0, 1
    picture = class_picture(reference, classes, GHOSTING)
    assert tuple(picture[1, 2]) == COLORS["visibility"] and tuple(picture[3, 5]) == COLORS["shading"]
    assert len(set(picture[0, 0].tolist())) == 1 and picture[0, 0, 0] < 128
    maps = dict.fromkeys(QUESTIONS, classes)
    path = write_class_sheet(tmp_path / "report", "test-gloss-1, frame 7", reference, maps, maps, QUESTIONS)
    assert path == tmp_path / "report" / "labels-test-gloss-1-frame-7.png" and Image.open(path).size[0] > 900


def test_only_clips_that_something_reads_have_native_frames(tmp_path, monkeypatch):
    """Tuning and the test read them; training never does (``tests/data/test_loader.py``)."""
    asked = []
    monkeypatch.setattr(datasets, "generate", lambda out, clips, *size, **settings: asked.extend(clips))
    with pytest.raises(AttributeError):  # there is no dataset
        datasets.prepare(settings_of("warp", "quick"), None, tmp_path, lambda n, total: None)
    assert {(clip.split, clip.native) for clip in asked} == {("train", False), ("validation", True), ("test", True)}


def test_data_without_ranges_or_native_frames_is_refused_before_training(tmp_path):
    sequence = jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(0, T, 1, H, W))
    write_sequence(tmp_path, "a", sequence)
    write_dataset(tmp_path, {split: ["a"] for split in ("train", "validation", "test")})
    prepare = lambda **needs: datasets.prepare(  # noqa: E731
        settings_of("warp", "smoke"), read_dataset(tmp_path), tmp_path, lambda n, total: None, **needs
    )
    assert not prepare().info.ranges
    for need in ("ranges", "native"):
        with pytest.raises(ValueError, match=f"not have. Render the scenes with --{need}; imported frames have none"):
            prepare(**{need: True})
