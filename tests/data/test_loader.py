"""The loader: aligned, cuts where they are, the same for the same seed, resumable."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

from essjax.data import (
    CachedSource,
    Segment,
    clips,
    crop,
    disk_source,
    exr,
    read_segment,
    write_dataset,
    write_sequence,
)
from essjax.data import loader as module
from essjax.data.loader import windows
from essjax.frames import check_shapes, select_time
from tests.helpers import make_sequence

H, W, T = 8, 12, 9


def coordinates(number: int, cuts=(0,), H=H, W=W, T=T, output=None):
    """A sequence in which every colour says where it is: (x, y, 100 * sequence + frame), in LR pixels."""
    base = jax.tree.map(lambda leaf: np.array(leaf[:, 0]), make_sequence(number, T, 1, H, W))

    def grid(height, width):
        y, x = np.mgrid[:height, :width].astype(np.float32)
        frame = np.arange(T, dtype=np.float32)[:, None, None] + 100 * number
        return np.stack(np.broadcast_arrays(x * W / width, y * H / height, frame), axis=-1).astype(np.float32)

    cut = np.isin(np.arange(T), cuts)
    frames = dataclasses.replace(base.frames, color=grid(H, W), cut=cut)
    return dataclasses.replace(base, frames=frames, reference=grid(*(output or (2 * H, 2 * W))))


def take(iterable, count):
    return list(itertools.islice(iterable, count))


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_shapes_are_time_major_batches():
    source = [coordinates(0), coordinates(1)]
    clip = next(iter(clips(source, length=4, batch=3, crop=(5, 6))))
    check_shapes(clip.frames)
    assert clip.frames.color.shape == (4, 3, 5, 6, 3) and clip.reference.shape == (4, 3, 10, 12, 3)
    assert clip.frames.jitter.shape == (4, 3, 2) and clip.frames.camera.camera_to_world.shape == (4, 3, 4, 4)
    assert clip.valid.shape == (4, 3, 5, 6, 1) and clip.native is None
    assert {leaf.dtype for leaf in jax.tree.leaves(clip)} == {np.dtype(t) for t in (np.float32, np.int32, bool)}
    np.testing.assert_array_equal(clip.frames.cut, np.tile([[True], [False], [False], [False]], (1, 3)))


def test_crops_and_flips_stay_aligned_with_the_reference():
    """Both hold their coordinates: 2x2 blocks of the reference must average to those of the LR pixel + 1/4."""
    source = [coordinates(0), coordinates(1)]
    corners, directions = set(), set()
    for clip in take(clips(source, length=3, batch=4, crop=(5, 7), seed=5), 12):
        blocks = clip.reference.reshape(3, 4, 5, 2, 7, 2, 3).mean(axis=(3, 5))
        np.testing.assert_allclose(
            blocks - clip.frames.color, np.broadcast_to([0.25, 0.25, 0], blocks.shape), atol=1e-6
        )
        steps = np.diff(clip.frames.color[..., 2], axis=0)
        np.testing.assert_array_equal(steps, np.ones_like(steps))
        for b in range(4):
            x, y = clip.frames.color[0, b, :, :, 0], clip.frames.color[0, b, :, :, 1]
            corners.add((x.min(), y.min()))
            directions.add((x[0, 1] - x[0, 0], y[1, 0] - y[0, 0]))
    assert len(corners) > 10 and directions == {(1, 1), (-1, 1), (1, -1), (-1, -1)}


def test_without_flips_and_crop_clips_are_windows_of_the_source():
    source = [coordinates(0)]
    for clip in take(clips(source, length=4, batch=2, flips=False), 5):
        for b in range(2):
            start = int(clip.frames.color[0, b, 0, 0, 2])
            np.testing.assert_array_equal(clip.frames.motion[:, b], source[0].frames.motion[start : start + 4])
            np.testing.assert_array_equal(clip.reference[:, b], source[0].reference[start : start + 4])
            np.testing.assert_array_equal(clip.valid[1:, b], source[0].valid[start + 1 : start + 4])
            np.testing.assert_array_equal(clip.valid[0, b], source[0].valid[start] if start == 0 else 0)
    assert not source[0].frames.cut[1:].any() and source[0].valid[3].any()  # the source is not touched


def test_cuts_stay_where_they_are():
    """Cuts at 0 and 4 of 9 frames: every window of three is a clip, which also begins with a cut."""
    source = [coordinates(0, cuts=(0, 4))]
    assert windows(source, 3) == [(0, start) for start in range(7)]
    for clip in take(clips(source, length=3, batch=1, flips=False, epochs=1), 7):
        start = int(clip.frames.color[0, 0, 0, 0, 2])
        np.testing.assert_array_equal(clip.frames.cut[:, 0], [True, start == 3, start == 2])


def test_every_epoch_shows_every_window_once_in_another_order():
    source = [coordinates(0), coordinates(1)]
    starts = [int(c.frames.color[0, 0, 0, 0, 2]) for c in clips(source, length=6, batch=1, flips=False, epochs=2)]
    everything = [100 * s + t for s in range(2) for t in range(4)]
    assert sorted(starts[:8]) == sorted(starts[8:]) == everything
    assert starts[:8] != starts[8:]


def test_the_same_seed_gives_the_same_batches_whatever_the_threads():
    source = [coordinates(0), coordinates(1)]
    settings = {"length": 3, "batch": 2, "crop": (4, 5)}
    one = take(clips(source, seed=7, threads=1, prefetch=1, **settings), 6)
    assert_same(one, take(clips(source, seed=7, threads=4, prefetch=8, **settings), 6))
    other = take(clips(source, seed=8, **settings), 6)
    assert any(not np.array_equal(a.frames.color, b.frames.color) for a, b in zip(one, other, strict=True))


def test_a_resumed_iterator_continues_exactly():
    source = [coordinates(0), coordinates(1)]
    make = lambda: iter(clips(source, length=3, batch=2, crop=(4, 5), seed=1))
    iterator = make()
    take(iterator, 3)
    state = iterator.get_state()
    expected = take(iterator, 5)
    resumed = make()
    resumed.set_state(state)
    assert_same(take(resumed, 5), expected)


@pytest.fixture(scope="module")
def on_disk(tmp_path_factory):
    """Two whole sequences, and one with a cut of which the first two frames belong to another split."""
    root = tmp_path_factory.mktemp("clips")
    for number in range(3):
        full = jax.tree.map(
            lambda leaf: np.array(leaf[:, 0]), make_sequence(number, T, 1, H, W, native=True, ranges=True)
        )
        cut = np.isin(np.arange(T), (0, 5) if number == 2 else (0,))
        full = dataclasses.replace(full, frames=dataclasses.replace(full.frames, cut=cut))
        write_sequence(root, f"s{number}", full)
    return write_dataset(root, {"train": ["s0", "s1", Segment("s2", 2, 8, 2)], "test": [Segment("s2", 0, 1, 0)]})


def in_memory(dataset, **options):
    return [read_segment(dataset, segment, **options) for segment in dataset.segments("train")]


def frame_bytes(dataset):
    whole = dataclasses.replace(in_memory(dataset, native=False)[0], native=None)
    return sum(leaf.nbytes for leaf in jax.tree.leaves(whole)) // T


@pytest.fixture
def reads(monkeypatch):
    """Names and numbers of the frames that are read from here on."""
    found = []

    def read(root, info, record, **options):
        found.append((info.name, record["number"]))
        return original(root, info, record, **options)

    original = module.read_frame
    monkeypatch.setattr(module, "read_frame", read)
    return found


def assert_identical(a, b):
    """Also in structure and type, and NaN and -0 are no exception."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()


@pytest.mark.parametrize("memory", [0, None])
def test_a_window_is_a_slice_of_the_whole(on_disk, memory):
    """The oracle is ``read_segment``, which knows nothing of windows."""
    options = {"native": True, "ranges": True}
    source = disk_source(on_disk, "train", memory=memory, **options)
    for index, whole in enumerate(in_memory(on_disk, **options)):
        assert_identical(source[index], whole)
        np.testing.assert_array_equal(source.cuts(index), whole.frames.cut)
        for start, length in ((0, 1), (0, 4), (2, 3), (3, 4)):
            window = select_time(whole, slice(start, start + length))
            assert_identical(source.window(index, start, length), window)
            assert_identical(source.window(index, start, length, (1, 2, 5, 7)), crop(window, 1, 2, 5, 7))
    with pytest.raises(IndexError):
        source[3]


@pytest.mark.parametrize("frames", [0, 7, None])
@pytest.mark.parametrize("size", [(4, 5), None])
def test_batches_from_disk_are_those_of_sequences_in_memory(on_disk, frames, size):
    memory = None if frames is None else frames * frame_bytes(on_disk)
    settings = {"length": 3, "batch": 2, "crop": size, "seed": 3}
    expected = take(clips(in_memory(on_disk), **settings), 22)  # more than two epochs of 7 + 7 + 5 windows
    disk = lambda: iter(clips(disk_source(on_disk, "train", memory=memory), **settings))
    iterator = disk()
    for batch in expected[:12]:
        assert_identical(next(iterator), batch)
    resumed = disk()
    resumed.set_state(iterator.get_state())
    for batch in expected[12:]:
        assert_identical(next(resumed), batch)


def test_a_clip_reads_its_own_frames_and_each_frame_once(on_disk, reads):
    source = disk_source(on_disk, "train")
    batches = clips(source, length=3, batch=1, epochs=1, threads=1)
    assert windows(source, 3) == windows(in_memory(on_disk), 3) and not reads
    source.window(1, 4, 3)
    source.window(1, 5, 3)
    assert sorted(reads) == [("s1", 4), ("s1", 5), ("s1", 6), ("s1", 7)]
    assert len(list(batches)) == 7 + 7 + 5  # the third has frames 2 to 8
    assert len(set(reads)) == len(reads) == 9 + 9 + 7


def test_memory_is_bounded(on_disk, reads):
    """Room for seven frames and a byte: the first seven stay, the others are read again."""
    source = disk_source(on_disk, "train", memory=7 * frame_bytes(on_disk) + 1)
    list(source)
    assert source._kept.size == 7 * frame_bytes(on_disk)
    reads.clear()
    list(source)
    assert len(reads) == 9 + 9 + 7 - 7


def test_native_frames_are_not_read_for_clips(on_disk, monkeypatch):
    opened = []
    original = exr.read
    monkeypatch.setattr(exr, "read", lambda path, *rest: opened.append(path.name) or original(path, *rest))
    assert next(iter(clips(disk_source(on_disk, "train"), length=3, batch=2))).native is None
    assert opened and {name.split(".")[0] for name in opened} == {"lr", "hr"}


def test_a_damaged_frame_is_named_when_its_clip_is_taken(tmp_path):
    write_sequence(tmp_path, "a", coordinates(0))
    dataset = write_dataset(tmp_path, {"train": ["a"]})
    (tmp_path / "a" / "hr.0004.exr").unlink()
    batches = clips(disk_source(dataset, "train"), length=3, batch=1, epochs=1)
    with pytest.raises(ValueError, match=r"sequence a, frame 4: .*hr\.0004\.exr: expected an EXR file, found nothing"):
        list(batches)


def test_sequences_with_and_without_cameras_do_not_go_together(tmp_path):
    bare = coordinates(1)
    write_sequence(tmp_path, "a", coordinates(0))
    write_sequence(tmp_path, "b", dataclasses.replace(bare, frames=dataclasses.replace(bare.frames, camera=None)))
    dataset = write_dataset(tmp_path, {"train": ["a", "b"]})
    with pytest.raises(ValueError, match="sequence 1 has another scale or other buffers"):
        clips(disk_source(dataset, "train"), length=2, batch=1)
    with pytest.raises(ValueError, match="a crop of 13x4 does not fit into sequence 0 of 12x8"):
        clips(disk_source(dataset, "train"), length=2, batch=1, crop=(4, 13))


def test_crops_at_a_ratio_that_is_not_whole_begin_where_the_reference_has_a_pixel():
    source = [coordinates(0, output=(12, 18))]
    for clip in take(clips(source, length=2, batch=4, crop=(4, 6), flips=False), 4):
        assert clip.frames.color.shape[2:] == (4, 6, 3) and clip.reference.shape[2:] == (6, 9, 3)
        np.testing.assert_array_equal(clip.reference[:, :, ::3, ::3], clip.frames.color[:, :, ::2, ::2])
    whole = next(iter(clips([coordinates(0, output=(11, 17))], length=2, batch=1, flips=False)))
    assert whole.reference.shape == (2, 1, 11, 17, 3)


def test_crops_that_have_no_whole_reference_are_refused():
    with pytest.raises(ValueError, match="references of 18x12: expected a crop of multiples of 2x2, .* got 6x5"):
        clips([coordinates(0, output=(12, 18))], length=2, batch=1, crop=(5, 6))
    with pytest.raises(ValueError, match="references of 17x11: crops need a ratio with denominators of at most 8"):
        clips([coordinates(0, output=(11, 17))], length=2, batch=1, crop=(4, 6))
    with pytest.raises(ValueError, match=r"crop: 6x4 at \(1, 0\) .* no whole number of pixels of a reference of 18x12"):
        crop(coordinates(0, output=(12, 18)), 0, 1, 4, 6)


def test_sequences_with_and_without_exposure_do_not_go_together(tmp_path):
    bare = coordinates(1)
    write_sequence(tmp_path, "a", coordinates(0))
    write_sequence(tmp_path, "b", dataclasses.replace(bare, frames=dataclasses.replace(bare.frames, exposure=None)))
    dataset = write_dataset(tmp_path, {"train": ["a", "b"]})
    with pytest.raises(ValueError, match="sequence 1 .* or only one of them has cameras or an exposure"):
        clips(disk_source(dataset, "train"), length=2, batch=1)


def test_one_batch_held_ready_is_no_reason_for_a_warning(caplog):
    assert next(iter(clips([coordinates(0)], length=2, batch=1, prefetch=1))) and not caplog.records


def test_a_cached_source_makes_each_sequence_once():
    calls = []
    source = CachedSource([lambda n=n: calls.append(n) or coordinates(n) for n in range(2)])
    assert len(source) == 2 and calls == []
    assert source[1] is source[1]
    assert calls == [1] and [s.frames.color[0, 0, 0, 2] for s in source] == [0, 100]


def test_errors():
    source = [coordinates(0, cuts=(0, 4))]
    with pytest.raises(ValueError, match="no 10 frames in a row in 1 sequences .the longest has 9"):
        clips(source, length=10, batch=1)
    with pytest.raises(ValueError, match="a crop of 13x4 does not fit into sequence 0 of 12x8"):
        clips(source, length=2, batch=1, crop=(4, 13))
    with pytest.raises(ValueError, match=r"expected length >= 1 and batch >= 1, got 2 and 0"):
        clips(source, length=2, batch=0)
    with pytest.raises(ValueError, match="sequence 1 has another size than sequence 0. Give a crop"):
        clips([coordinates(0), coordinates(1, H=9)], length=2, batch=1)
    assert next(iter(clips([coordinates(0), coordinates(1, H=9)], length=2, batch=1, crop=(4, 4))))
    bare = dataclasses.replace(coordinates(1), valid=None)
    with pytest.raises(ValueError, match="sequence 1 has another scale or other buffers"):
        clips([coordinates(0), bare], length=2, batch=1)
    with pytest.raises(ValueError, match=r"expected sequences \[T, H, W, C\], got motion \(5, 2, 12, 18, 2\)"):
        clips([make_sequence()], length=2, batch=1)
