"""The dataset folder: round trips, resuming, and errors that say which frame of which sequence is wrong."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from essjax.data import (
    Segment,
    SequenceWriter,
    disk_source,
    exr,
    read_dataset,
    read_segment,
    read_sequence,
    write_dataset,
    write_sequence,
)
from essjax.frames import select_time, validate_sequence
from tests.helpers import make_sequence


def sequence(seed=0, T=5, H=6, W=9, **options):
    """One sequence without a batch axis, NumPy leaves."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(seed, T, 1, H, W, **options))


def assert_close(actual, expected):
    """Equal up to half precision; infinities, ids and flags exactly."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2**-11, atol=1e-6), actual, expected)
    for name in ("depth", "world_position", "stencil"):
        np.testing.assert_array_equal(getattr(actual.frames.gbuffers, name), getattr(expected.frames.gbuffers, name))
    np.testing.assert_array_equal(actual.frames.motion, expected.frames.motion)


def write_frames(writer, source, numbers, first):
    for number in numbers:
        writer.write(number, select_time(source, number - first))


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("scale", [2, 3])
def test_round_trip(tmp_path, native, scale):
    written = sequence(scale=scale, native=native)
    write_sequence(tmp_path, "a", written, first=8, source={"seed": 1})
    dataset = write_dataset(tmp_path, {"train": ["a"]}, source={"made": "by hand"})
    assert read_dataset(tmp_path) == dataset
    assert dataset.info.scale == scale and dataset.info.source == {"seed": 1} and dataset.info.native == native
    back = read_sequence(dataset, "a")
    assert_close(back, written)
    validate_sequence(back, "a")
    assert {leaf.dtype for leaf in jax.tree.leaves(back)} == {np.dtype(t) for t in (np.float32, np.int32, bool)}
    assert read_sequence(dataset, "a", native=False).native is None


def test_ranges_come_back_on_request(tmp_path):
    written = sequence(ranges=True)
    write_sequence(tmp_path, "a", written, first=8)
    dataset = write_dataset(tmp_path, {"train": ["a"]})
    assert dataset.info.ranges and read_dataset(tmp_path).info.ranges
    assert read_sequence(dataset, "a").ranges is None
    back = disk_source(dataset, "train", ranges=True)[0]
    assert_close(back, written)
    for name in ("depth_min", "depth_max", "motion"):
        np.testing.assert_array_equal(getattr(back.ranges, name), getattr(written.ranges, name))
    (tmp_path / "a" / "ranges.0009.exr").unlink()
    with pytest.raises(ValueError, match=r"sequence a, frame 9: .*ranges\.0009\.exr: expected an EXR file"):
        read_sequence(dataset, "a", ranges=True)


def test_without_ranges_there_are_none(tmp_path):
    write_sequence(tmp_path, "a", sequence())
    path = tmp_path / "a" / "sequence.json"
    content = json.loads(path.read_text())
    assert content.pop("ranges") is False
    path.write_text(json.dumps(content))  # as written before there were ranges
    assert read_sequence(write_dataset(tmp_path, {"train": ["a"]}), "a", ranges=True).ranges is None
    writer = SequenceWriter(tmp_path, "b")
    write_frames(writer, sequence(ranges=True), [0], 0)
    with pytest.raises(ValueError, match="sequence b, frame 1: ranges changes from True to False"):
        write_frames(writer, sequence(), [1], 0)


def test_absent_buffers_stay_absent(tmp_path):
    full = sequence()
    gbuffers = dataclasses.replace(full.frames.gbuffers, specular=None, n_dot_v=None)
    reactive = np.full_like(full.frames.gbuffers.roughness, 0.25)
    frames = dataclasses.replace(full.frames, gbuffers=gbuffers, camera=None, reactive=reactive)
    bare = dataclasses.replace(full, frames=frames, valid=None, steady=full.valid)
    write_sequence(tmp_path, "a", bare)
    assert_close(read_sequence(write_dataset(tmp_path, {"train": ["a"]}), "a"), bare)


def test_a_range_of_frames_keeps_original_numbers_and_starts_with_a_cut(tmp_path):
    written = sequence(T=6)
    write_sequence(tmp_path, "a", written, first=8)
    dataset = write_dataset(tmp_path, {"test": [Segment("a", 9, 12, 11)]})
    segment = dataset.segments("test")[0]
    back = read_segment(dataset, segment)
    np.testing.assert_array_equal(back.frames.motion, written.frames.motion[1:5])
    np.testing.assert_array_equal(back.frames.cut, [True, False, False, False])
    np.testing.assert_array_equal(back.valid[1:], written.valid[2:5])
    assert not back.valid[0].any()
    assert dataset.numbers(segment) == (9, 10, 11, 12)
    np.testing.assert_array_equal(dataset.scored(segment), [False, False, True, True])
    with pytest.raises(ValueError, match=r"sequence a: expected a range within the frames 8\.\.13, got 7\.\.9"):
        read_sequence(dataset, "a", (7, 9))
    with pytest.raises(ValueError, match="no sequence 'b'; there are a"):
        read_sequence(dataset, "b")
    with pytest.raises(ValueError, match="no split 'train'; this dataset has test"):
        dataset.segments("train")


def test_an_interrupted_sequence_resumes_and_keeps_complete_frames(tmp_path):
    """The second writer has different pixels: frames 3 and 4 must be the first writer's, 5 and 6 the second's."""
    first, second = sequence(0, T=4), sequence(1, T=4)
    source = {"seed": 1, "size": (9, 6)}
    write_frames(SequenceWriter(tmp_path, "a", source=source), first, [3, 4], 3)
    with pytest.raises(ValueError, match="sequence a is unfinished .2 frames so far.*it resumes"):
        write_dataset(tmp_path, {"train": ["a"]})
    writer = SequenceWriter(tmp_path, "a", source=source)
    assert [n in writer for n in (3, 4, 5)] == [True, True, False] and not writer.complete
    write_frames(writer, first, [3, 4], 3)
    with pytest.raises(ValueError, match=r"a: frame 4 is there already, with other content\. Choose another name or"):
        write_frames(writer, second, [4], 3)
    write_frames(writer, second, [5, 6], 3)
    writer.finish()
    assert SequenceWriter(tmp_path, "a", source=source).complete
    back = read_sequence(write_dataset(tmp_path, {"train": ["a"]}), "a")
    np.testing.assert_array_equal(back.frames.motion[:2], first.frames.motion[:2])
    np.testing.assert_array_equal(back.frames.motion[2:], second.frames.motion[2:])


def test_a_write_that_dies_between_two_images_leaves_the_frame_incomplete(tmp_path, monkeypatch):
    source = sequence(T=2)
    writer = SequenceWriter(tmp_path, "a")
    write_frames(writer, source, [0], 0)
    real = exr.write

    def dies_at_reference(path, channels, **options):
        if path.name == "hr.0001.exr":
            raise KeyboardInterrupt
        return real(path, channels, **options)

    monkeypatch.setattr(exr, "write", dies_at_reference)
    with pytest.raises(KeyboardInterrupt):
        write_frames(writer, source, [1], 0)
    monkeypatch.undo()
    resumed = SequenceWriter(tmp_path, "a")
    assert 0 in resumed and 1 not in resumed
    write_frames(resumed, source, [0, 1], 0)
    resumed.finish()
    assert_close(read_sequence(write_dataset(tmp_path, {"train": ["a"]}), "a"), source)
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".tmp")]


def test_other_settings_do_not_resume(tmp_path):
    write_sequence(tmp_path, "a", sequence(), source={"seed": 1, "spp": 16})
    with pytest.raises(
        ValueError, match=r"made with other settings \(spp: asked 64, found 16\).*another output folder"
    ):
        SequenceWriter(tmp_path, "a", source={"seed": 1, "spp": 64})


def test_a_sequence_that_is_there_does_not_change(tmp_path):
    written = sequence(T=4)
    info = write_sequence(tmp_path, "a", written, first=8)
    assert write_sequence(tmp_path, "a", written, first=8) == info
    negated = dataclasses.replace(written, frames=dataclasses.replace(written.frames, motion=-written.frames.motion))
    with pytest.raises(ValueError, match=r"a: frame 8 is there already, with other content\. Choose another name"):
        write_sequence(tmp_path, "a", negated, first=8)
    with pytest.raises(ValueError, match=r"holds frame 8, which is not among the frames 9\.\.12 to write"):
        write_sequence(tmp_path, "a", written, first=9)
    longer = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf[1:2]]), written)
    assert write_sequence(tmp_path, "a", longer, first=8).numbers == (8, 9, 10, 11, 12)
    path = tmp_path / "a" / "sequence.json"  # as written before frames said what they were made from
    content = json.loads(path.read_text())
    for record in content["frames"]:
        del record["made_from"]
    del content["skipped"]
    path.write_text(json.dumps(content))
    dataset = write_dataset(tmp_path, {"train": ["a"]})
    assert_close(read_sequence(dataset, "a"), longer)
    assert write_sequence(tmp_path, "a", longer, first=8).numbers == (8, 9, 10, 11, 12)


def test_images_of_others_are_neither_overwritten_nor_deleted(tmp_path):
    (tmp_path / "a").mkdir()
    theirs = tmp_path / "a" / "hr.0001.exr"
    theirs.write_bytes(b"a render")
    with pytest.raises(
        ValueError, match=r"found images without a sequence\.json \(hr\.0001\.exr, \.\.\.\), which would be"
    ):
        write_sequence(tmp_path, "a", sequence())
    assert theirs.read_bytes() == b"a render"
    writer = SequenceWriter(tmp_path, "b")
    write_frames(writer, sequence(), [0], 0)
    late = theirs.rename(tmp_path / "b" / "hr.0001.exr")
    writer.discard(1)
    assert late.exists()


def test_a_writer_that_dies_in_its_first_frame_leaves_a_folder_of_its_own(tmp_path, monkeypatch):
    def dies(*arguments, **options):
        (tmp_path / "a" / "lr.0000.exr").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(exr, "write", dies)
    with pytest.raises(KeyboardInterrupt):
        write_sequence(tmp_path, "a", sequence())
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"sequence a is unfinished \(0 frames so far\)"):
        write_dataset(tmp_path, {"train": ["a"]})
    assert write_sequence(tmp_path, "a", sequence()).complete


def test_frames_must_follow_each_other(tmp_path):
    source = sequence(T=3)
    writer = SequenceWriter(tmp_path, "a")
    write_frames(writer, source, [0], 0)
    at = select_time(source, 2)
    with pytest.raises(ValueError, match="sequence a: expected frame 1 next, got 2"):
        writer.write(2, at)
    cut = dataclasses.replace(at, frames=dataclasses.replace(at.frames, cut=np.asarray(True)))
    with pytest.raises(ValueError, match="frame 2: channels changes from"):
        writer.write(2, dataclasses.replace(cut, valid=None))
    writer.write(2, cut)
    assert writer.finish().numbers == (0, 2)


def without_exposure(source):
    native = None if source.native is None else dataclasses.replace(source.native, exposure=None)
    return dataclasses.replace(source, frames=dataclasses.replace(source.frames, exposure=None), native=native)


def test_an_exposure_that_is_not_recorded_is_none_again(tmp_path):
    written = without_exposure(sequence(native=True))
    write_sequence(tmp_path, "a", written)
    record = json.loads((tmp_path / "a" / "sequence.json").read_text())["frames"][0]
    assert record["exposure"] is None
    dataset = write_dataset(tmp_path, {"train": ["a"]})
    assert_close(read_sequence(dataset, "a"), written)
    window = disk_source(dataset, "train", native=True).window(0, 1, 2)
    assert window.frames.exposure is None and window.native.exposure is None


def test_all_frames_of_a_sequence_have_an_exposure_or_none(tmp_path):
    known = sequence(T=2)
    unknown = without_exposure(known)
    for name, first, second, message in (
        ("a", known, unknown, "sequence a, frame 1: exposure: frame 0 has one, this one has none; all frames"),
        ("b", unknown, known, "sequence b, frame 1: exposure: frame 0 has none, this one has one; all frames"),
    ):
        writer = SequenceWriter(tmp_path, name)
        write_frames(writer, first, [0], 0)
        with pytest.raises(ValueError, match=message):
            write_frames(writer, second, [1], 0)
        write_frames(writer, first, [1], 0)
        writer.finish()
    path = tmp_path / "a" / "sequence.json"
    content = json.loads(path.read_text())
    content["frames"][1]["exposure"] = None
    path.write_text(json.dumps(content))
    with pytest.raises(
        ValueError, match=r"a/sequence\.json: exposure: expected a value for all frames, or null for all"
    ):
        write_dataset(tmp_path, {"train": ["a"]})


def test_invalid_content_is_refused_with_names(tmp_path):
    at = select_time(sequence(), 0)
    writer = SequenceWriter(tmp_path, "a")
    write = lambda reference, **frame: writer.write(  # noqa: E731
        7, dataclasses.replace(at, frames=dataclasses.replace(at.frames, **frame), reference=reference)
    )
    motion = at.frames.motion.copy()
    motion[2, 3, 0] = np.nan
    with pytest.raises(ValueError, match=r"sequence a, frame 7, channel motion: expected finite values, got nan"):
        write(at.reference, motion=motion)
    with pytest.raises(
        ValueError, match=r"reference: expected \[H, W, 3\], at least 6 and 9 as the frames, got \(12, 5, 3\)"
    ):
        write(at.reference[:, :5])
    with pytest.raises(ValueError, match=r"sequence a, frame 7, reference: expected finite radiance >= 0, got -1\."):
        write(at.reference - 1.0 - at.reference)
    for bad in (np.inf, np.nan):
        reference = at.reference.copy()
        reference[0, 1, 2] = bad
        match = rf"frame 7, reference: expected finite radiance >= 0, got {bad}\. 1 of {reference.size} values are"
        with pytest.raises(ValueError, match=match):
            write(reference)
    with pytest.raises(ValueError, match="frame 7 needs the buffers color"):
        write(at.reference, color=None)
    with pytest.raises(ValueError, match="expected at least one frame before finish"):
        writer.finish()
    with pytest.raises(ValueError, match="expected a plain folder name, got 'a/b'"):
        SequenceWriter(tmp_path, "a/b")
    with pytest.raises(ValueError, match=r"sequence a: expected leaves \[T, H, W, C\] without a batch axis"):
        write_sequence(tmp_path, "a", make_sequence())
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def dataset_on_disk(tmp_path):
    write_sequence(tmp_path, "a", sequence(), first=8)
    return write_dataset(tmp_path, {"train": ["a"]})


def test_damaged_images_name_dataset_sequence_and_frame(dataset_on_disk):
    root = dataset_on_disk.path
    where = rf"dataset {root}, sequence a, frame 9: .*lr\.0009\.exr"
    path = root / "a" / "lr.0009.exr"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=rf"{where}.*damaged"):
        read_sequence(dataset_on_disk, "a")
    path.write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(ValueError, match=rf"{where}: this is a Git LFS pointer"):
        read_sequence(dataset_on_disk, "a")
    path.unlink()
    with pytest.raises(ValueError, match=rf"{where}: expected an EXR file, found nothing"):
        read_sequence(dataset_on_disk, "a")
    channels = {name: np.zeros((6, 9)) for name in ("color.R", "color.G", "color.B", "depth.Z")}
    exr.write(path, channels)
    with pytest.raises(ValueError, match=rf"{where}: expected the channels base_color\.B, .*motion\.X"):
        read_sequence(dataset_on_disk, "a")
    assert read_sequence(dataset_on_disk, "a", (10, 12)).frames.motion.shape[0] == 3


def test_images_of_the_wrong_size_are_named(dataset_on_disk):
    path = dataset_on_disk.path / "a" / "hr.0010.exr"
    exr.write(path, {name: np.zeros((6, 9)) for name in "RGB"})
    with pytest.raises(ValueError, match=r"frame 10: .*hr\.0010\.exr, channel [RGB]: expected 18x12 .* got 9x6"):
        read_sequence(dataset_on_disk, "a")


def test_damaged_metadata_is_named(dataset_on_disk):
    root = dataset_on_disk.path
    sequence_json, dataset_json = root / "a" / "sequence.json", root / "dataset.json"
    content = json.loads(sequence_json.read_text())
    del content["frames"][1]["jitter"]
    sequence_json.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"sequence\.json, record 1, frame 9: the field jitter is missing"):
        read_dataset(root)
    content["frames"][1]["jitter"] = [0.0, 0.0]
    content["frames"][2]["camera"]["fov"] = 1.0
    sequence_json.write_text(json.dumps(content))
    with pytest.raises(
        ValueError, match=r"record 2, frame 10: camera: expected camera_to_world .*, focal and center .* or null, got {"
    ):
        read_dataset(root)
    del content["frames"][1]["number"]
    sequence_json.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"sequence\.json, record 1: the field number is missing"):
        read_dataset(root)
    sequence_json.write_text(json.dumps({**content, "frames": 3}))
    with pytest.raises(ValueError, match=r"sequence\.json: frames: expected a list, got 3"):
        read_dataset(root)
    sequence_json.write_text(json.dumps({"schema": 1}))
    with pytest.raises(ValueError, match=r"sequence\.json: the fields name, width, .* are missing"):
        read_dataset(root)
    sequence_json.write_text(json.dumps({"schema": 2}))
    with pytest.raises(ValueError, match=r"sequence\.json: expected schema 1, found 2"):
        read_dataset(root)
    sequence_json.write_text("{")
    with pytest.raises(ValueError, match=r"sequence\.json: expected JSON, cannot read it"):
        read_dataset(root)
    sequence_json.unlink()
    with pytest.raises(ValueError, match=r"sequence\.json: not found"):
        read_dataset(root)
    dataset_json.write_text(json.dumps({"schema": 1, "sequences": ["a"], "source": {}}))
    with pytest.raises(ValueError, match=r"dataset\.json: the field splits is missing"):
        read_dataset(root)
    dataset_json.write_text("[]")
    with pytest.raises(ValueError, match="expected a JSON object, found a list"):
        read_dataset(root)
    dataset_json.unlink()
    with pytest.raises(ValueError, match=r"dataset\.json: not found\. .*essjax scenes"):
        read_dataset(root)


def test_sequences_of_one_dataset_must_agree(tmp_path):
    write_sequence(tmp_path, "a", sequence())
    write_sequence(tmp_path, "b", sequence(W=10))
    with pytest.raises(ValueError, match="must agree in width: a has 9, b has 10"):
        write_dataset(tmp_path, {"train": ["a", "b"]})
    with pytest.raises(ValueError, match=r"split test, sequence a: expected first <= score_from <= last within the "):
        write_dataset(tmp_path, {"test": [Segment("a", 0, 9, 2)]})
    with pytest.raises(ValueError, match=r"b/sequence\.json: not found|c/sequence\.json: not found"):
        write_dataset(tmp_path, {"train": ["c"]})
    with pytest.raises(ValueError, match="expected at least one sequence"):
        write_dataset(tmp_path, {})
