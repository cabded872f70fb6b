"""The ``essjax`` command and ``generate``: datasets that resume, grow and refuse to be mixed up."""

import dataclasses

import jax
import numpy as np
import pytest

import essjax.builtin
from essjax import cli
from essjax.builtin import Clip, generate, live_source, plan
from essjax.data import clips, read_dataset, read_sequence
from essjax.frames import select_time, validate_sequence
from essjax.scenes import TEST_ONLY_FAMILIES, TRAIN_FAMILIES, Rendering
from tests.data.importing.dumps import truth
from tests.data.importing.test_blender import dump  # noqa: F401 (fixture)
from tests.data.importing.test_presets import write_extranet
from tests.helpers import make_sequence


def run(capsys, *arguments):
    """Exit code and output of a command, line breaks of the terminal's width removed."""
    code = cli.main([str(argument) for argument in arguments])
    return code, " ".join(capsys.readouterr().out.split())


@pytest.fixture
def instant_renderer(monkeypatch):
    """Frames of noise in place of rendered ones; returns the list of (family, seed, frame) that were asked for."""
    calls = []

    def render_frame(scene, index, width, height, *, rendering):
        calls.append((scene.family, scene.seed, index))
        noise = make_sequence(
            scene.seed,
            index + 1,
            1,
            height,
            width,
            scale=rendering.scale,
            native=rendering.native,
            ranges=rendering.ranges,
        )
        frame = select_time(jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), noise), index)
        return dataclasses.replace(frame, steady=frame.valid)

    monkeypatch.setattr(essjax.builtin, "render_frame", render_frame)
    return calls


def test_plan_covers_the_families_of_a_split_with_seeds_of_its_own():
    train, validation, test = (plan(split, 2, 8) for split in ("train", "validation", "test"))
    assert {c.family for c in train} == {c.family for c in validation} == set(TRAIN_FAMILIES)
    assert {c.family for c in test} == set(TRAIN_FAMILIES) | set(TEST_ONLY_FAMILIES)
    assert len(train) == 2 * len(TRAIN_FAMILIES) and len({c.name for c in train + validation + test}) == 40
    seeds = [{(c.family, c.seed) for c in clips_of} for clips_of in (train, validation, test)]
    assert not (seeds[0] & seeds[1] or seeds[0] & seeds[2] or seeds[1] & seeds[2])
    assert plan("train", 1, 8, families=["gloss"], spp=4) == [Clip("train", "gloss", train[0].seed, 8, 4)]
    (rigging,) = plan("test", 1, 8, families=["rigging"])  # in no split, but at its seeds when asked for
    assert rigging.seed == test[0].seed and rigging.name == f"test-rigging-{rigging.seed:04d}"
    assert {c.seed for c in plan("train", 1, 8, start=1)} == {c.seed for c in train} - {train[0].seed}


def test_plan_errors():
    with pytest.raises(ValueError, match=r"families: train has corridor, .*; got 'plaza' .plaza is in the test split"):
        plan("train", 1, 8, families=["plaza"])
    with pytest.raises(ValueError, match=r"got 'rigging' .rigging is in the test split only"):
        plan("validation", 1, 8, families=["rigging"])
    with pytest.raises(ValueError, match="expected at least one sequence, got 0"):
        plan("train", 0, 8)
    with pytest.raises(ValueError, match="split: expected one of train, validation, test"):
        plan("tests", 1, 8)


def test_several_splits_in_one_dataset(tmp_path, instant_renderer):
    wanted = plan("train", 1, 3, families=["gloss", "texture"]) + plan("test", 1, 4, families=["plaza"], native=True)
    seen = []
    dataset = generate(tmp_path, wanted, 8, 6, progress=lambda done, total: seen.append((done, total)))
    assert {split: [(s.first, s.last) for s in segments] for split, segments in dataset.splits.items()} == {
        "train": [(0, 2), (0, 2)],
        "test": [(0, 3)],
    }
    assert seen == [(n + 1, 10) for n in range(10)]
    sequence = read_sequence(dataset, wanted[0].name)
    validate_sequence(sequence, "gloss")
    assert sequence.native is None and read_sequence(dataset, wanted[-1].name).native.motion.shape == (4, 12, 16, 2)
    assert dataset.has_native("test") and not dataset.has_native("train")
    assert sequence.steady is not None and sequence.scale == 2


def test_generate_resumes_at_the_frame_it_was_stopped_at(tmp_path, instant_renderer):
    wanted = plan("train", 1, 3, families=["gloss", "texture"])

    def stop(done, total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path, wanted, 8, 6, progress=stop)
    with pytest.raises(ValueError, match="not found. Expected a finished dataset"):
        read_dataset(tmp_path)
    first = list(instant_renderer)
    generate(tmp_path, wanted, 8, 6)
    assert len(instant_renderer) == len(set(instant_renderer)) == 6 and instant_renderer[:4] == first
    generate(tmp_path, wanted, 8, 6)
    assert len(instant_renderer) == 6


def test_a_dataset_grows_but_does_not_change(tmp_path, instant_renderer):
    gloss = plan("train", 1, 3, families=["gloss"])
    generate(tmp_path, gloss, 8, 6)
    generate(tmp_path, plan("test", 1, 3, families=["plaza"]), 8, 6)
    dataset = generate(tmp_path, plan("train", 2, 3, families=["gloss"]), 8, 6)
    assert {split: len(segments) for split, segments in dataset.splits.items()} == {"train": 2, "test": 1}
    assert len(instant_renderer) == 9
    with pytest.raises(ValueError, match=r"the split train already holds train-gloss-.*, which this request lacks"):
        generate(tmp_path, plan("train", 1, 3, families=["texture"]), 8, 6)
    with pytest.raises(ValueError, match=r"made with width = 8, asked for 10\. Choose another output folder"):
        generate(tmp_path, gloss, 10, 6)
    with pytest.raises(ValueError, match=r"made with ranges = False, asked for True\. Choose another output folder"):
        generate(tmp_path, gloss, 8, 6, rendering=Rendering(ranges=True))
    with pytest.raises(ValueError, match="made with jitter = 'kronecker', asked for 'dlctus'"):
        generate(tmp_path, gloss, 8, 6, rendering=Rendering(jitter="dlctus"))
    with pytest.raises(ValueError, match=r"other settings \(frames: asked 4, found 3\)"):
        generate(tmp_path, plan("train", 2, 4, families=["gloss"]), 8, 6)
    with pytest.raises(ValueError, match="two clips have the same split, family and seed"):
        generate(tmp_path, gloss + gloss, 8, 6)
    assert read_dataset(tmp_path).splits == dataset.splits and len(instant_renderer) == 9


def test_scenes_command_renders_what_the_live_source_renders(tmp_path, capsys):
    """The real renderer: the same frames through the disk (half precision) and straight into memory."""
    code, output = run(
        capsys, "scenes", tmp_path / "out", "--split", "train", "--sequences", "1", "--frames", "3", "--size", "16x10",
        "--families", "corridor", "--spp", "4", "--jitter", "dlctus", "--ranges",
    )  # fmt: skip
    assert code == 0 and "train-corridor-0000" in output and "0-2" in output and "color, base_color" in output
    assert output.endswith("steady; sample ranges")
    dataset = read_dataset(tmp_path / "out")
    disk = read_sequence(dataset, "train-corridor-0000", ranges=True)
    source = live_source(
        plan("train", 1, 3, families=["corridor"], spp=4), 16, 10, rendering=Rendering(ranges=True, jitter="dlctus")
    )
    validate_sequence(source[0], "live")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), disk, source[0])
    assert next(iter(clips(source, length=2, batch=2, crop=(8, 8)))).reference.shape == (2, 2, 16, 16, 3)


def test_import_command_prints_what_it_did(tmp_path, capsys, dump):  # noqa: F811
    code, output = run(
        capsys, "import", dump, tmp_path / "out", "--preset", "blender", "--train", "8:10", "--validation", "11:11",
        "--test", "12:13",
    )  # fmt: skip
    assert code == 0
    for text in (
        "20x12 -> x2",
        "25.0% of pixels, masked",
        "negative colour values │ 6, set to 0",
        "move │ 7",
        "frames │ 6",
    ):
        assert text in output
    splits = read_dataset(tmp_path / "out").splits
    assert splits["validation"] == (("clip", 8, 11, 11),) and splits["test"] == (("clip", 8, 13, 12),)


def test_import_command_of_a_dump_with_a_broken_frame(tmp_path, capsys):
    known = truth(T=12)
    write_extranet(tmp_path / "dump", known, reference=tmp_path / "hr")
    path = tmp_path / "dump" / "TempleMotionVector.0005.exr"
    path.write_bytes(path.read_bytes()[:400])
    arguments = ["import", tmp_path / "dump", tmp_path / "out", "--preset", "extranet", "--reference", tmp_path / "hr"]
    code, output = run(capsys, *arguments)
    assert code == 2 and "sequence Temple, frame 5: " in output and "--skip-broken" in output
    code, output = run(capsys, *arguments, "--skip-broken")
    assert code == 0 and "left out, a cut follows: Temple, frame 5: " in output and "frames │ 11" in output
    assert read_dataset(tmp_path / "out").source["skipped"] == {"Temple": [5]}
    code, output = run(capsys, "import", tmp_path / "dump", tmp_path / "b", "--preset", "generic")
    assert code == 2 and "error: the preset generic needs a recipe" in output


def test_bad_input_prints_one_line(tmp_path, capsys, dump):  # noqa: F811
    out, others = tmp_path / "out", ["--validation", "11:11", "--test", "12:13"]
    for arguments, message in (
        (["scenes", out, "--size", "128"], "error: --size: expected WIDTHxHEIGHT such as 128x72, got '128'."),
        (["scenes", out, "--size", "0x4"], "error: --size: expected WIDTHxHEIGHT such as 128x72, got '0x4'."),
        (["scenes", out, "--families", "gloss,glas"], "got 'glas'."),
        (["import", tmp_path / "nothing", out], "meta.json: not found."),
        (
            ["import", dump, out, "--preset", "maya"],
            "error: preset: expected one of blender, unreal, extranet, arm-nss, arm-gym, stssnet, generic, got",
        ),
        (["import", dump, out, "--train", "9:x"], "error: --train: expected FIRST:LAST such as 8:19, both included,"),
        (["import", dump, out, "--train", "8:12"], "error: splits: validation, test missing. Give train, validation"),
        (
            ["import", dump, out, "--train", "9-12", *others],
            "error: train: there is no sequence '9-12'; there are clip. Frames are given as FIRST:LAST, such as 8:19.",
        ),
        (
            ["import", dump, out, "--train", "8:20", *others],
            "error: train: expected first <= last within the frames 8..13, got 8..20.",
        ),
    ):
        code, output = run(capsys, *arguments)
        assert code == 2 and message in output and "Traceback" not in output


def test_ctrl_c_says_how_to_resume(tmp_path, capsys, instant_renderer, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(essjax.builtin, "render_frame", interrupted)
    code, output = run(capsys, "scenes", tmp_path / "out", "--families", "gloss", "--size", "8x6")
    assert code == 130 and "run the same command again to resume" in output


def test_a_failing_disk_prints_one_line(tmp_path, capsys, dump, monkeypatch):  # noqa: F811
    file = tmp_path / "afile"
    file.touch()
    assert run(capsys, "import", dump, tmp_path / "ds")[0] == 0

    def denied(path, mode):
        return False

    cases = (
        (["import", dump, file], f"error: OUT: expected a folder, but {file} is a file."),
        (["import", dump, file / "out"], f"error: OUT: expected a folder, but {file} is a file."),
        (
            ["check", tmp_path / "ds", "--json", tmp_path / "no" / "x.json"],
            "error: --json: expected a file in a folder",
        ),
        (
            ["check", tmp_path / "ds", "--json", tmp_path],
            "error: --json: expected a file in a folder that is there, got",
        ),
        (
            ["check", tmp_path / "ds", "--pictures", file],
            f"error: --pictures: expected a folder, but {file} is a file.",
        ),
    )
    monkeypatch.setattr(cli, "check_dataset", None)  # all of it before the work
    for arguments, message in cases:
        code, output = run(capsys, *arguments)
        assert code == 2 and message in output and "Traceback" not in output
    monkeypatch.setattr(cli.os, "access", denied)
    code, output = run(capsys, "import", dump, tmp_path / "locked" / "out")
    assert code == 2 and f"OUT: expected a folder that may be written to, got {tmp_path / 'locked'}" in output
    monkeypatch.undo()

    def unreadable(*arguments, **options):
        raise PermissionError(13, "Permission denied", "lr.0008.exr")

    monkeypatch.setattr(cli, "import_dataset", unreadable)
    code, output = run(capsys, "import", dump, tmp_path / "new")
    assert code == 2 and "error: lr.0008.exr: Permission denied. Is it the right path, may it be used" in output
