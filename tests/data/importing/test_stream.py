"""Frames stream through threads: order, broken frames, interruptions, memory; which files are frames; splits."""

import dataclasses
import json
import threading
import time

import jax
import numpy as np
import pytest

from essjax.data import import_dataset, read_dataset, read_sequence
from essjax.data.importing.files import find_frames
from essjax.data.importing.splits import fit_segments, split_segments
from essjax.data.importing.stream import Converted, open_clip, write_clip
from essjax.frames import select_time
from tests.data.importing.dumps import imported, truth
from tests.data.importing.test_presets import write_extranet


@dataclasses.dataclass(frozen=True)
class FakeClip:
    """Frames of ``known``, later ones sooner than earlier ones; ``alive`` counts those that are converted."""

    known: object
    name: str = "a"
    source: dict = dataclasses.field(default_factory=dict)
    broken: tuple = ()
    alive: list = dataclasses.field(default_factory=list)

    @property
    def numbers(self):
        return tuple(range(len(self.known.frames.cut)))

    def files(self, number):
        return []

    def said(self, number):
        return ""

    def convert(self, number):
        self.alive.append(number)
        time.sleep(0.02 if number % 2 == 0 else 0.0)
        if number in self.broken:
            raise ValueError(f"lr.{number:04d}.exr: the file is truncated.")
        at = select_time(self.known, number)
        return Converted(at.frames, at.reference, {"negative": number})


def test_frames_are_listed_in_order_whatever_thread_is_first(tmp_path):
    known = truth(T=9)
    done = []
    written = write_clip(open_clip(tmp_path, FakeClip(known)), workers=4, on_frames=done.append)
    assert written.info.numbers == tuple(range(9)) and not written.skipped and sum(done) == 9
    assert [record["notes"]["negative"] for record in written.info.frames] == list(range(9))


def test_only_a_few_frames_are_in_memory(tmp_path):
    """The first frame waits: meanwhile no more than twice as many as there are threads may be begun."""
    known, release = truth(T=12), threading.Event()

    @dataclasses.dataclass(frozen=True)
    class Slow(FakeClip):
        def convert(self, number):
            if number == 0:
                release.wait(5)
            return super().convert(number)

    clip = Slow(known)
    thread = threading.Thread(target=write_clip, args=(open_clip(tmp_path, clip),), kwargs={"workers": 2})
    thread.start()
    time.sleep(0.4)
    assert sorted(clip.alive) == [1, 2, 3]
    release.set()
    thread.join()
    assert sorted(clip.alive) == list(range(12))


def test_a_broken_frame_stops_the_import_and_leaves_nothing_half_written(tmp_path):
    clip = FakeClip(truth(T=8), broken=(3,))
    with pytest.raises(
        ValueError, match=r"sequence a, frame 3: lr\.0003\.exr: the file is truncated\. \(--skip-broken"
    ):
        write_clip(open_clip(tmp_path, clip), workers=3)
    listed = [r["number"] for r in json.loads((tmp_path / "a" / "sequence.json").read_text())["frames"]]
    assert listed == [0, 1, 2]
    assert sorted(p.name for p in (tmp_path / "a").glob("*.exr")) == [
        f"{k}.000{n}.exr" for k in ("hr", "lr") for n in range(3)
    ]
    assert not list(tmp_path.rglob("*.tmp"))
    whole = write_clip(open_clip(tmp_path, FakeClip(truth(T=8))), workers=3)
    assert whole.info.numbers == tuple(range(8)) and whole.info.complete


def test_broken_frames_are_left_out_and_a_cut_follows(tmp_path):
    written = write_clip(open_clip(tmp_path, FakeClip(truth(T=8), broken=(0, 3, 4))), skip_broken=True)
    assert written.info.numbers == (1, 2, 5, 6, 7)
    assert [record["cut"] for record in written.info.frames] == [True, False, True, False, False]
    assert list(written.skipped) == [0, 3, 4] and "truncated" in written.skipped[3]
    with pytest.raises(ValueError, match=r"sequence b: all frames are broken\. The first: lr\.0000\.exr"):
        write_clip(open_clip(tmp_path, FakeClip(truth(T=2), name="b", broken=(0, 1))), skip_broken=True)


def test_a_frame_of_another_size_is_broken_too(tmp_path):
    known, other = truth(T=3), truth(T=3, W=20)

    @dataclasses.dataclass(frozen=True)
    class Odd(FakeClip):
        def convert(self, number):
            return FakeClip(other if number == 1 else known).convert(number)

    written = write_clip(open_clip(tmp_path, Odd(known)), skip_broken=True)
    assert written.info.numbers == (0, 2) and "width changes from 24 to 20" in written.skipped[1]
    assert not list((tmp_path / "a").glob("*.0001.exr"))


def test_an_interrupted_import_goes_on_and_gives_the_same_dataset(tmp_path):
    write_extranet(tmp_path / "dump", truth(T=12), leave_out=("BaseColor",))
    path = tmp_path / "dump" / "TempleSceneDepth.0003.exr"
    path.write_bytes(path.read_bytes()[:300])

    def stop(done, total):
        if done == 6:
            raise KeyboardInterrupt

    run = lambda out, **options: import_dataset(
        tmp_path / "dump", tmp_path / out, "extranet", skip_broken=True, **options
    )
    with pytest.raises(KeyboardInterrupt):
        run("a", on_frame=stop)
    with pytest.raises(ValueError, match=r"dataset\.json: not found"):
        read_dataset(tmp_path / "a")
    before = (tmp_path / "a" / "Temple" / "lr.0002.exr").stat().st_mtime_ns
    resumed, fresh = run("a"), run("b")
    assert (tmp_path / "a" / "Temple" / "lr.0002.exr").stat().st_mtime_ns == before
    assert resumed.totals == fresh.totals and resumed.dataset.splits == fresh.dataset.splits
    jax.tree.map(np.testing.assert_array_equal, imported(resumed, "Temple"), imported(fresh, "Temple"))
    assert resumed.skipped == fresh.skipped and "SceneDepth.0003.exr" in fresh.skipped["Temple"][3]
    assert run("a").skipped == fresh.skipped
    assert fresh.dataset.source["skipped"] == {"Temple": [3]}
    np.testing.assert_array_equal(np.flatnonzero(imported(fresh, "Temple").frames.cut), [0, 2])
    assert fresh.dataset.splits["train"] == (("Temple", 1, 7, 1),)


def test_broken_and_missing_files_are_named(tmp_path):
    write_extranet(tmp_path / "dump", truth(T=3))
    (tmp_path / "dump" / "TempleNoV.0002.exr").unlink()
    run = lambda out: import_dataset(tmp_path / "dump", tmp_path / out, "extranet")
    with pytest.raises(ValueError, match=r"1 of the images are missing, the first is .*TempleNoV\.0002\.exr\. Dump or"):
        run("a")
    report = import_dataset(tmp_path / "dump", tmp_path / "b", "extranet", skip_broken=True)
    assert report.sequence.numbers == (1, 3)
    write_extranet(tmp_path / "dump", truth(T=3, W=20), leave_out=("BaseColor",))  # all but one in another size
    with pytest.raises(
        ValueError,
        match=r"frame 1: .*BaseColor\.0001\.exr, channel R: expected 20x14 as the others \(or larger, with the same",
    ):
        run("c")


def test_a_broken_first_frame_does_not_decide_which_buffers_there_are(tmp_path):
    write_extranet(tmp_path / "dump", truth(T=3), leave_out=("Specular",))
    path = tmp_path / "dump" / "TempleRoughness.0001.exr"
    path.write_bytes(path.read_bytes()[:200])
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "extranet", skip_broken=True)
    assert report.sequence.numbers == (2, 3)
    assert "roughness" in report.sequence.channels and "specular" not in report.sequence.channels
    for path in (tmp_path / "dump").glob("*PreTonemap*"):
        path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"sequence 'Temple': no frame can be read\. The first: .*Color\.0001\.exr"):
        import_dataset(tmp_path / "dump", tmp_path / "b", "extranet", skip_broken=True)


def test_several_scenes_are_split_by_sequence(tmp_path):
    for seed, scene in enumerate(("Bunker", "Docks", "Temple", "Wood")):
        write_extranet(tmp_path / "dump", truth(T=2, seed=seed), scene)
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "extranet")
    names = {split: [segment.sequence for segment in part] for split, part in report.dataset.splits.items()}
    assert names == {"train": ["Bunker", "Docks"], "validation": ["Temple"], "test": ["Wood"]}
    assert read_sequence(report.dataset, "Docks").frames.motion.shape[0] == 2
    with pytest.raises(ValueError, match="name: the dump has 4 sequences, which keep their names"):
        import_dataset(tmp_path / "dump", tmp_path / "other", "extranet", name="all")


def test_which_files_are_frames(tmp_path):
    for name in ("a.0009.exr", "a.0010.exr", "b-2.0001.exr", "b-2.0001.exr.tmp", "readme.txt", "c.exr"):
        (tmp_path / name).touch()
    assert find_frames(tmp_path, "{sequence}.{frame}.exr") == {"a": {9: "0009", 10: "0010"}, "b-2": {1: "0001"}}
    (tmp_path / "x2" / "color" / "s1").mkdir(parents=True)
    (tmp_path / "x2" / "color" / "s1" / "7.exr").touch()
    assert find_frames(tmp_path, "x2/color/{sequence}/{frame}.exr") == {"s1": {7: "7"}}
    with pytest.raises(
        ValueError, match=r"expected files named big\.\{frame\}\.exr, found none \(there is a\.0009\.exr,"
    ):
        find_frames(tmp_path, "big.{frame}.exr")
    (tmp_path / "a.9.exr").touch()
    with pytest.raises(ValueError, match="frame 9 is there twice"):
        find_frames(tmp_path, "{sequence}.{frame}.exr")
    with pytest.raises(ValueError, match=r"nowhere: expected files named .* found none \(there is nothing\)"):
        find_frames(tmp_path / "nowhere", "{frame}.exr")


def test_splits_fit_what_was_written():
    clips = {"a": range(1, 11), "b": range(1, 11)}
    segments = split_segments(clips, {"train": (1, 6), "validation": (7, 7), "test": (8, 10)})
    assert segments["validation"] == [("a", 1, 7, 7), ("b", 1, 7, 7)]
    fitted = fit_segments(segments, {"a": (2, 3, 6, 9), "b": (1, 2)})
    assert fitted == {"train": [("a", 2, 6, 2), ("b", 1, 2, 1)], "test": [("a", 2, 9, 9)]}
    with pytest.raises(
        ValueError, match=r"test: there is no sequence 'c'; there are a, b\. Frames are given as FIRST:"
    ):
        split_segments(clips, {"train": ["a"], "validation": ["b"], "test": ["c"]})
    assert split_segments({"a": range(3)}, None) == {"test": [("a", 0, 2, 0)]}


def test_splits_share_no_frame_and_are_all_given():
    clips = {name: range(12) for name in "abc"}
    names = {"train": ["a"], "validation": ["b"], "test": ["c"]}
    assert split_segments(clips, names) == {split: [(name[0], 0, 11, 0)] for split, name in names.items()}
    with pytest.raises(
        ValueError, match=r"splits: validation, test missing\. Give train, validation and test, or none"
    ):
        split_segments(clips, {"train": (0, 5)})
    with pytest.raises(
        ValueError, match=r"splits: train and validation share the frames 5\.\.8 of a\. A frame that is"
    ):
        split_segments(clips, {"train": (0, 9), "validation": (5, 8), "test": (10, 11)})
    with pytest.raises(ValueError, match=r"splits: train and test share the frames 0\.\.11 of b"):
        split_segments(clips, {**names, "train": ["a", "b"], "validation": ["c"], "test": ["b"]})
