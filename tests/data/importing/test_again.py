"""Importing again, into a folder that holds something: the same, more of it, something else, or somebody's renders."""

import dataclasses
import json
import os

import numpy as np
import pytest

from essjax.data import exr, import_dataset, read_dataset, read_sequence
from essjax.data.importing.stream import open_clip, write_clip
from tests.data.importing.dumps import OUR_RULES, rgb, truth, write
from tests.data.importing.test_blender import FIRST, LAST, write_dump
from tests.data.importing.test_presets import write_extranet
from tests.data.importing.test_stream import FakeClip

RECIPE = """
[files]
frame = "{sequence}/beauty.{frame}.exr"
reference = "{sequence}/final.{frame}.exr"
metadata = "{sequence}/shot.json"
[channels]
color = ["R", "G", "B"]
depth = ["Z"]
motion = ["X", "Y"]
reference = ["R", "G", "B"]
[jitter]
source = "metadata"
"""
RECIPE += OUR_RULES


def write_shot(folder, known, numbers=None, files=("beauty", "final")):
    """One sequence for ``RECIPE``; ``numbers``: of the frames."""
    frames = known.frames
    numbers = range(len(frames.cut)) if numbers is None else numbers
    for t, n in enumerate(numbers):
        planes = {"Z": frames.gbuffers.depth[t][..., 0], "X": frames.motion[t][..., 0], "Y": frames.motion[t][..., 1]}
        write(folder / f"{files[0]}.{n:04d}.exr", {**rgb(frames.color[t]), **planes})
        write(folder / f"{files[1]}.{n:04d}.exr", rgb(known.reference[t]))
    jitters = {str(n): {"jitter": frames.jitter[t].tolist()} for t, n in enumerate(numbers)}
    (folder / "shot.json").write_text(json.dumps({"frames": jitters}))


def interrupt(run, after):
    """An import that is interrupted after so many frames."""

    def stop(done, total):
        if done == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(on_frame=stop)


@pytest.fixture
def run(tmp_path):
    """Imports the folder ``dump`` into ``out``; ``recipe``: pairs of texts to exchange in ``RECIPE``."""

    def call(source="dump", out="out", recipe=(), **options):
        text = RECIPE
        for old, new in recipe:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "my.toml").write_text(text)
        return import_dataset(tmp_path / source, tmp_path / out, "generic", recipe=tmp_path / "my.toml", **options)

    return call


def content(folder):
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


def test_renders_in_the_output_folder_are_left_alone(tmp_path, run):
    blender = write_dump(tmp_path / "clip")
    last = blender / f"hr.{LAST:04d}.exr"
    last.write_bytes(last.read_bytes()[:300])
    write_shot(tmp_path / "dump" / "shot", truth(T=3), files=("lr", "hr"))
    write_shot(tmp_path / "plain" / "shot", truth(T=3))
    names = (("beauty", "lr"), ("final", "hr"))
    before = content(tmp_path)
    with pytest.raises(
        ValueError, match=r"clip: the dump is there, nothing is written into it\. Choose another output"
    ):
        import_dataset(blender, tmp_path, "blender", skip_broken=True)
    with pytest.raises(ValueError, match=r"shot: the dump is there"):
        run(out="dump", recipe=names)
    (tmp_path / "link").symlink_to(tmp_path / "dump")
    with pytest.raises(ValueError, match=r"shot: the dump is there"):
        run(out="link", recipe=names)
    (tmp_path / "link").unlink()
    with pytest.raises(ValueError, match=r"shot: expected a new folder .* images without a sequence\.json \(lr\.0000"):
        run(source="plain", out="dump")
    (tmp_path / "my.toml").unlink()
    assert content(tmp_path) == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["X", "Y"]', '["Y", "X"]', r"channels\.motion: asked \['Y', 'X'\], found \['X', 'Y'\]"),
        ("[jitter]", "[world]\nscale = 2\n[jitter]", r"world\.scale: asked 2\.0, found 1\.0"),
        ("final.", "./final.", r"files\.reference: asked '.*\./final.*', found"),
    ],
)
def test_another_recipe_is_refused(tmp_path, run, old, new, message):
    write_shot(tmp_path / "dump" / "shot", truth(T=3))
    run()
    before = content(tmp_path / "out")
    with pytest.raises(
        ValueError, match=rf"made with other settings \({message}.*\)\. Choose another output folder, or"
    ):
        run(recipe=[(old, new)])
    assert content(tmp_path / "out") == before
    run()  # the same again: nothing to do
    assert content(tmp_path / "out" / "shot") == {p: c for p, c in before.items() if p.parent.name == "shot"}


def test_an_interrupted_import_does_not_go_on_with_another_recipe_or_dump(tmp_path, run):
    write_shot(tmp_path / "dump" / "shot", truth(T=6))
    write_shot(tmp_path / "other" / "shot", truth(T=6, seed=1))

    interrupt(run, 3)
    with pytest.raises(ValueError, match=r"\(motion\.y: asked 'up', found 'down'\)"):
        run(recipe=[('y = "down"', 'y = "up"')])
    with pytest.raises(ValueError, match=r"\(folder: asked '.*/other', found '.*/dump'\)"):
        run(source="other")
    assert run().sequence.numbers == tuple(range(6))


def test_changed_files_and_metadata_are_refused(tmp_path, run):
    shot = tmp_path / "dump" / "shot"
    write_shot(shot, truth(T=4))
    run()
    metadata = (shot / "shot.json").read_text()
    records = json.loads(metadata)
    records["frames"]["2"]["jitter"][0] *= -1
    (shot / "shot.json").write_text(json.dumps(records))
    with pytest.raises(
        ValueError, match=r"frame 2 was changed since the import before: its files or its metadata\. An"
    ):
        run()
    (shot / "shot.json").write_text(metadata)
    run()
    os.utime(shot / "final.0001.exr", (1, 1))
    with pytest.raises(ValueError, match=r"frame 1 was changed since .* delete that folder, or choose another output"):
        run()
    (shot / "beauty.0000.exr").unlink()
    with pytest.raises(ValueError, match=r"frame 0 was imported before, and is not there any more"):
        run()


def test_changed_blender_metadata_is_refused_and_new_frames_are_added(tmp_path):
    run = lambda: import_dataset(tmp_path / "clip", tmp_path / "out", "blender")
    dump = write_dump(tmp_path / "clip", numbers=range(FIRST, LAST))
    assert run().sequence.numbers == tuple(range(FIRST, LAST))
    meta = json.loads((dump / "meta.json").read_text())
    write_dump(tmp_path / "longer")
    for kind in ("lr", "hr"):
        (tmp_path / "longer" / f"{kind}.{LAST:04d}.exr").rename(dump / f"{kind}.{LAST:04d}.exr")
    (tmp_path / "longer" / "meta.json").rename(dump / "meta.json")
    report = run()
    assert report.sequence.numbers == tuple(range(FIRST, LAST + 1)) and not report.skipped
    assert not read_sequence(report.dataset, "clip").frames.cut[1:].any()
    meta["frames"]["9"]["jitter"][1] *= -1
    (dump / "meta.json").write_text(json.dumps(meta | {"frames": meta["frames"]}))
    with pytest.raises(ValueError, match=rf"frame {LAST} was imported before|frame 9 was changed since"):
        run()


def test_broken_frames_keep_their_reason_and_repaired_ones_are_not_ignored(tmp_path, run):
    shot = tmp_path / "dump" / "shot"
    known = truth(T=8)
    write_shot(shot, known)
    whole = {n: (shot / f"final.{n:04d}.exr").read_bytes() for n in (2, 7)}
    for n in whole:
        (shot / f"final.{n:04d}.exr").write_bytes(whole[n][:300])
    report = run(skip_broken=True)
    assert list(report.skipped["shot"]) == [2, 7] and "final.0002.exr" in report.skipped["shot"][2]
    assert run(skip_broken=True).skipped == report.skipped
    (shot / "final.0007.exr").write_bytes(whole[7])  # behind the last one: it is added
    report = run(skip_broken=True)
    assert list(report.skipped["shot"]) == [2] and report.sequence.numbers == (0, 1, 3, 4, 5, 6, 7)
    np.testing.assert_array_equal(read_sequence(report.dataset, "shot").frames.cut, [1, 0, 1, 0, 0, 0, 0])
    assert read_dataset(tmp_path / "out").source["skipped"] == {"shot": [2]}
    (shot / "final.0002.exr").write_bytes(whole[2])
    with pytest.raises(
        ValueError, match=r"frame 2, left out as broken \(.*final\.0002\.exr.*\), was changed since the"
    ):
        run(skip_broken=True)


def test_a_clip_that_grows_in_a_dataset_may_be_interrupted(tmp_path, run):
    shot, known = tmp_path / "dump" / "shot", truth(T=8)
    write_shot(shot, known)
    for n in range(3, 8):
        for path in shot.glob(f"*.{n:04d}.exr"):
            path.rename(tmp_path / path.name)
    assert run().sequence.numbers == (0, 1, 2)
    for path in tmp_path.glob("*.exr"):
        path.rename(shot / path.name)

    interrupt(run, 5)
    with pytest.raises(ValueError, match=r"sequence shot is unfinished \(5 frames so far\)\. Run the command that"):
        read_dataset(tmp_path / "out")
    report = run()
    assert report.sequence.numbers == tuple(range(8)) and not report.skipped
    np.testing.assert_array_equal(read_sequence(report.dataset, "shot").frames.motion, known.frames.motion)


def test_frames_between_are_refused(tmp_path, run):
    shot = tmp_path / "dump" / "shot"
    write_shot(shot, truth(T=4), numbers=[0, 1, 3, 4])
    with pytest.raises(ValueError, match=r"sequence shot: frame 2 is missing \(gaps in all: 1\)"):
        run()
    assert not (tmp_path / "out").exists()
    report = run(skip_broken=True)
    assert report.skipped == {"shot": {2: "frame 2 is missing"}}
    write_shot(shot, truth(T=1, seed=3), numbers=[2], files=("beauty", "final"))
    with pytest.raises(ValueError, match=r"frame \d was (not there at|changed since) the import before"):
        run()


def test_clips_of_several_imports_make_one_dataset(tmp_path):
    run = lambda dump, **options: import_dataset(tmp_path / dump, tmp_path / "out", "blender", **options)
    for name in ("a", "b", "c"):
        write_dump(tmp_path / name, numbers=range(FIRST, FIRST + 3), leave_out=("roughness.X",) if name == "c" else ())
    run("a")
    report = run("b")
    assert list(report.dataset.sequences) == ["a", "b"] and report.imported == ("b",)
    assert report.sequence.name == "b" and report.totals["pixels"] == 3 * 20 * 12
    assert report.dataset.splits == {"test": (("a", 8, 10, 8), ("b", 8, 10, 8))}
    before = content(tmp_path / "out")
    with pytest.raises(
        ValueError, match=r"all sequences must agree in channels: a has .*roughness.*, c has .*different"
    ):
        run("c")
    write_extranet(tmp_path / "d", truth(T=2))
    with pytest.raises(ValueError, match="expected a dataset of the preset extranet, found one of the preset blender"):
        import_dataset(tmp_path / "d", tmp_path / "out", "extranet")
    assert content(tmp_path / "out") == before
    run("a", name="c")
    chosen = {"train": ["a"], "validation": ["b"], "test": ["c"]}
    assert run("a", splits=chosen).dataset.splits["validation"] == (("b", 8, 10, 8),)
    with pytest.raises(
        ValueError, match=r"the splits of this dataset were chosen \(--train \['a'\], .*give train, valid"
    ):
        run("b", name="d")
    report = run("b", name="d", splits={**chosen, "test": ["c", "d"]})
    assert [segment.sequence for segment in report.dataset.splits["test"]] == ["c", "d"]


def test_sequences_of_different_size_are_refused_before_anything_is_written(tmp_path, run):
    write_shot(tmp_path / "dump" / "a", truth(T=2))
    write_shot(tmp_path / "dump" / "b", truth(T=2, W=20))
    with pytest.raises(
        ValueError, match=r"must agree in width: a has 24, b has 20\. Put them into different datasets: "
    ):
        run()
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_not_a_broken_frame(tmp_path, monkeypatch):
    real = exr.write

    def full(path, channels, **options):
        if path.name == "hr.0003.exr":
            raise ValueError(f"{path}: cannot write the file. Is the folder there, the disk full?")
        return real(path, channels, **options)

    monkeypatch.setattr(exr, "write", full)
    clip = FakeClip(truth(T=6))
    with pytest.raises(
        ValueError, match=r"hr\.0003\.exr: cannot write the file\. Is the folder there, the disk full\?$"
    ):
        write_clip(open_clip(tmp_path, clip), skip_broken=True, workers=2)
    assert not list(tmp_path.rglob("*.0003.exr"))
    monkeypatch.undo()
    written = write_clip(open_clip(tmp_path, clip), skip_broken=True, workers=2)
    assert written.info.numbers == tuple(range(6)) and not written.skipped


def test_an_odd_first_frame_does_not_make_the_others_broken(tmp_path):
    known, odd = truth(T=5), truth(T=5, W=20)

    @dataclasses.dataclass(frozen=True)
    class Clip(FakeClip):
        def convert(self, number):
            return FakeClip(odd if number == 0 else known).convert(number)

    message = (
        r"4 frames are not like the 1 at the beginning: .*width changes from 20 to 24.*Remove or replace the wrong"
    )
    for _ in range(2):
        with pytest.raises(ValueError, match=message):
            write_clip(open_clip(tmp_path, Clip(known)), skip_broken=True)
