"""Where results go, what is refused before anything is trained, and messages that come out as they were meant."""

import re
import shlex
from pathlib import Path

import pytest

from essjax.data.layout import Dataset, Segment, SequenceInfo
from experiments import compare, run
from experiments.checks import check_scored
from experiments.comparison import _read_settings
from experiments.members import settings_of
from experiments.request import check_folder, default_folder

README = Path(__file__).resolve().parents[2] / "README.md"


def printed(capsys):
    """The output without line breaks, which the console adds."""
    return capsys.readouterr().out.replace("\n", " ")


def test_the_folder_has_the_name_of_the_data():
    assert default_folder("extrass", "quick", None) == Path("runs/extrass-quick")
    assert default_folder("compare", "smoke", "clips/mydata/") == Path("runs/compare-smoke-mydata")
    assert default_folder("extrass", "quick", ".") == Path(f"runs/extrass-quick-{Path.cwd().name}")


def test_commands_of_the_readme_do_not_share_a_folder():
    folders = {}
    for command, text in re.findall(r"python -m experiments\.(run|compare) ([^\n#`]*)", README.read_text()):
        options = {"run": run, "compare": compare}[command].parse(shlex.split(text))
        if options.resume or options.eval_only or options.list or getattr(options, "profile", False):
            continue
        name = options.variant if command == "run" else "compare"
        out = Path(options.out) if options.out else default_folder(name, options.preset, options.data)
        settings = (command, getattr(options, "variants", ""), options.data, tuple(options.overrides))
        assert folders.setdefault(out, settings) == settings, out
    assert len(folders) == 8


def test_looking_at_a_folder_writes_nothing(tmp_path):
    check_folder(tmp_path / "new", {"variant": "extrass"}, resume=False, eval_only=False)
    assert not list(tmp_path.iterdir())


def test_data_that_is_not_there_does_not_lock_the_folder(tmp_path, capsys):
    for _ in range(2):
        assert run.main(["--preset", "smoke", "--data", str(tmp_path / "typo"), "--out", str(tmp_path / "out")]) == 2
        assert "typo/dataset.json: not found" in printed(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "data.size=[x]"], "--set data.size: expected [width,height], got '[x]'"),
        (["--data", "/nowhere/[take1]"], "/nowhere/[take1]/dataset.json: not found"),
        (["--data", "/nowhere/[/x]"], "/nowhere/[/x]/dataset.json: not found"),
    ],
)
def test_brackets_are_printed_as_they_are(arguments, message, tmp_path, capsys):
    assert run.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in printed(capsys)


def test_a_file_in_the_way_of_the_folder(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        assert run.main(["--preset", "smoke", "--data", "nowhere", "--out", str(out)]) == 2
        assert f"{out}: expected a folder, but {tmp_path / 'file'} is a file. Choose" in printed(capsys)


def test_errors_of_the_disk_are_one_line(tmp_path, capsys):
    def full(console):
        raise OSError(28, "No space left on device", "runs/[a]/metrics.tmp")

    assert run.guarded(full) == 2
    assert "Error: [Errno 28] No space left on device: 'runs/[a]/metrics.tmp'" in printed(capsys)


def test_damaged_records_are_named(tmp_path):
    (tmp_path / "run.json").write_text('{"variant": "ext')
    with pytest.raises(ValueError, match=r"run\.json: expected JSON, cannot read it"):
        check_folder(tmp_path, {"variant": "extrass"}, resume=True, eval_only=False)
    (tmp_path / "tuning.json").write_text('{"taau": {"alp\n')
    with pytest.raises(ValueError, match=r"tuning\.json: expected JSON, cannot read it"):
        _read_settings(tmp_path / "tuning.json")


def dataset(cuts, score_from=0):
    """A dataset of sequences with cuts at the given frames, all of them for test and validation; nothing on disk."""
    infos = {}
    for name, at in cuts.items():
        frames = tuple({"number": n, "cut": n in at} for n in range(8))
        infos[name] = SequenceInfo(name, 32, 24, 2, ("color",), False, {}, frames=frames, complete=True)
    segments = tuple(Segment(name, 0, 7, score_from) for name in infos)
    return Dataset(Path("clips"), {}, infos, {"validation": segments, "test": segments})


@pytest.mark.parametrize(
    ("cuts", "score_from", "overrides", "message"),
    [
        ({"a": [0], "b": [0, 4]}, 0, ["evaluation.warmup=4"], "split test: expected frames .*, got none in b: all are"),
        (
            {"a": [0], "b": []},
            0,
            ["evaluation.warmup=20"],
            r"none in a, b: all are among the 20 that .* --set evaluation.warmup=N\.",
        ),
        ({"a": [0]}, 7, ["evaluation.tune=true", "evaluation.warmup=8"], "split validation: expected frames to score"),
        (
            {"a": [0]},
            7,
            ["training.validations=1", "evaluation.warmup=8"],
            "split validation: expected frames to score",
        ),
        ({"a": [], "b": [0, 4]}, 0, ["evaluation.warmup=3"], ""),
        ({"a": [0, 3]}, 7, ["evaluation.warmup=4"], ""),  # the last frame alone
        ({"a": [0, 3]}, 7, ["evaluation.warmup=5"], "split test"),
    ],
)
def test_data_of_which_nothing_would_be_scored(cuts, score_from, overrides, message):
    settings = settings_of("warp", "smoke", ["training.validations=null", *overrides])
    if not message:
        check_scored(dataset(cuts, score_from), settings)
        return
    with pytest.raises(ValueError, match=message):
        check_scored(dataset(cuts, score_from), settings)
