"""Clips that follow each other: no gap, one crop per shot, cuts where a walk begins, resumable, the same for a seed."""

import dataclasses
import itertools

import numpy as np
import pytest

from essjax.data import successive_clips, write_dataset, write_sequence
from essjax.data.loader import disk_source
from tests.data.test_loader import assert_same, coordinates, take

SETTINGS = {"length": 3, "batch": 2, "crop": (4, 5), "seed": 3}


def walks(source, count, **settings):
    """Slot -> its walks; each the numbers of its frames window by window, with where the first pixel lies."""
    found = [[] for _ in range(settings["batch"])]
    for clip in take(successive_clips(source, **settings), count):
        for slot, walk in enumerate(found):
            color = clip.frames.color[:, slot, 0, 0]
            if clip.frames.cut[0, slot]:
                walk.append([])
            walk[-1].append((color[:, 2].astype(int).tolist(), tuple(color[0, :2])))
            assert not clip.frames.cut[1:, slot].any()
    return found


def test_each_clip_goes_on_where_the_one_before_ended_in_the_same_crop():
    """9 frames: clips of 3 begin at 0, 2, 4, 6 and end with the sequence; two sequences in turn."""
    for slot in walks([coordinates(0), coordinates(1)], 24, **SETTINGS):
        for number, walk in enumerate(slot[:-1]):
            firsts = [frames[0] for frames, _ in walk]
            assert all(frames == [first, first + 1, first + 2] for first, (frames, _) in zip(firsts, walk, strict=True))
            assert firsts == list(range(firsts[0], firsts[0] + 2 * len(walk), 2))
            assert firsts[-1] % 100 == 6 and (number == 0 or len(walk) == 4)
            assert len({place for _, place in walk}) == 1  # one crop, one flip
        sequences = [walk[0][0][0] // 100 for walk in slot]
        assert all(set(sequences[n : n + 2]) == {0, 1} for n in range(0, len(sequences) - 1, 2))
        assert len({walk[0][1] for walk in slot}) > 2  # another crop for another walk


def test_frames_left_over_are_spread_over_beginning_and_end():
    """9 frames in clips of 4: two in a row take 7, so they begin at 0, 1 or 2."""
    slots = walks([coordinates(0)], 60, length=4, batch=1, seed=1)
    assert {walk[0][0][0] for walk in slots[0][1:]} == {0, 1, 2}
    assert {len(walk) for walk in slots[0][1:-1]} == {2}


def test_slots_do_not_begin_anew_in_the_same_steps():
    slots = walks([coordinates(n) for n in range(3)], 4, **{**SETTINGS, "batch": 6})
    assert len({len(slot[0]) for slot in slots}) > 1


def test_a_walk_stays_within_its_shot():
    """Cuts at 0, 4 and 6 of 9 frames: clips of 3 fit into frames 0 to 3 and 6 to 8, not into 4 and 5."""
    slots = walks([coordinates(0, cuts=(0, 4, 6))], 30, length=3, batch=1)
    assert {tuple(frames) for walk in slots[0] for frames, _ in walk} == {(0, 1, 2), (1, 2, 3), (6, 7, 8)}


def test_what_comes_after_is_valid_and_what_begins_is_a_hole():
    """``valid`` of a first frame: 0 where the walk begins inside a shot, untouched where it goes on."""
    source = [coordinates(0)]
    for clip in take(successive_clips(source, length=3, batch=1, flips=False), 8):
        first = int(clip.frames.color[0, 0, 0, 0, 2])
        expected = source[0].valid[first] * (not clip.frames.cut[0, 0] or first == 0)
        np.testing.assert_array_equal(clip.valid[0, 0], expected)
        np.testing.assert_array_equal(clip.valid[1:, 0], source[0].valid[first + 1 : first + 3])


def test_the_same_seed_gives_the_same_clips_and_a_resumed_iterator_continues():
    source = [coordinates(0), coordinates(1)]
    expected = take(successive_clips(source, threads=1, prefetch=1, **SETTINGS), 9)
    iterator = iter(successive_clips(source, threads=4, prefetch=8, **SETTINGS))
    assert_same(list(itertools.islice(iterator, 5)), expected[:5])
    resumed = iter(successive_clips(source, **SETTINGS))
    resumed.set_state(iterator.get_state())
    assert_same(take(resumed, 4), expected[5:])
    other = take(successive_clips(source, **{**SETTINGS, "seed": 4}), 9)
    assert any(not np.array_equal(a.frames.color, b.frames.color) for a, b in zip(expected, other, strict=True))


def test_from_disk_the_clips_are_those_from_memory(tmp_path):
    full = [dataclasses.replace(coordinates(n), native=None) for n in range(2)]
    for number, sequence in enumerate(full):
        write_sequence(tmp_path, f"s{number}", sequence)
    dataset = write_dataset(tmp_path, {"train": ["s0", "s1"]})
    source = disk_source(dataset, "train")
    assert_same(
        take(successive_clips(source, **SETTINGS), 6),
        take(successive_clips([source[0], source[1]], **SETTINGS), 6),
    )


def test_what_cannot_be_cut_is_refused():
    with pytest.raises(ValueError, match=r"expected length > 1 \(the overlap\) and batch >= 1, got 1 and 2"):
        successive_clips([coordinates(0)], length=1, batch=2)
    with pytest.raises(ValueError, match=r"no 6 consecutive frames .* in 1 sequences \(the longest shot has 5 frames"):
        successive_clips([coordinates(0, cuts=(0, 4))], length=6, batch=1)
    with pytest.raises(ValueError, match="does not fit into sequence 0"):
        successive_clips([coordinates(0)], length=3, batch=1, crop=(9, 5))
