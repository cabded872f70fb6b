"""The run command end to end, small: two methods beside ExtraSS, one family, a handful of steps."""

import contextlib
import dataclasses
import functools
import io
import json
import re

import jax
import numpy as np
import pytest

from essjax import methods
from essjax.deploy import count_parameters
from experiments import compare, comparison, datasets, run, variants
from experiments.members import settings_of


class Finished(tuple):
    """Folder, exit code and overrides of a run, and what it printed."""

    def __new__(cls, values, printed):
        found = super().__new__(cls, values)
        found.printed = printed
        return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run."""
    out = tmp_path_factory.mktemp("run") / "out"
    patch = pytest.MonkeyPatch()
    patch.setattr(variants, "BASELINES", ("extrass-w", "bilinear"))
    patch.setattr(datasets, "plan", functools.partial(datasets.plan, families=["carousel"]))
    overrides = [
        "data.test_frames=7",
        "data.train_frames=5",
        "data.test_spp=4",
        "stages.steps=2",
        "data.size=[32,24]",
        "stages.crop=[32,24]",
    ]
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = run.main(["--preset", "smoke", "--out", str(out), "--set", *overrides])
    yield Finished((out, code, overrides), output.getvalue())
    patch.undo()


def test_metrics_json(finished):
    out, code, overrides = finished
    assert code == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["schema"] == 1 and metrics["variant"] == "extrass" and metrics["preset"] == "smoke"
    assert metrics["environment"]["steps"] == {"frnet": 2, "extrassnet": 2}
    assert metrics["overrides"] == overrides
    settings = metrics["configs"]["extrass"]
    assert settings["data"]["size"] == [32, 24] and settings["method"]["width"] == 8
    assert settings["stages"]["frnet"]["loss"] == {"feature_weight": 0.001}
    assert {"commit", "device", "versions", "seed"} <= set(metrics["environment"])
    phases = {"data", "compilation", "training", "validation", "tuning", "evaluation", "report", "total"}
    assert set(metrics["seconds"]) == phases and metrics["seconds"]["compilation"] >= 0
    assert {stage: found["steps"] for stage, found in metrics["training"].items()} == metrics["environment"]["steps"]
    assert metrics["dead"] == [] and sum("made only 2 steps" in text for text in metrics["warnings"]) == 2
    validated = {stage: [list(entry) for entry in found["validated"]] for stage, found in metrics["training"].items()}
    assert validated == {"frnet": 3 * [["step", "ess"]], "extrassnet": 3 * [["step", "ess", "ss"]]}
    means = {(r["method"], r["frames"], r["resolution"]): r for r in metrics["rows"] if r["sequence"] == "mean"}
    assert set(means) == {
        ("extrass", "ss", "hr"), ("extrass", "ess", "hr"), ("bilinear", "ss", "hr"),
        ("extrass-w", "ess", "lr"), ("extrass-e", "ess", "lr"),
    }  # fmt: skip
    assert all(np.isfinite(row["psnr"]) and 5 < row["psnr"] < 60 for row in means.values())


def test_the_weights_file_gives_what_was_trained(finished):
    out, _, _ = finished
    (path,) = (out / "weights").iterdir()
    method, variables = methods.load(path)
    assert path.name == "extrass.safetensors" and method.info.name == "extrass"
    assert dict(method.recipe.arguments)["width"] == 8
    costs = json.loads((out / "metrics.json").read_text())["costs"]["extrass"]
    assert count_parameters(variables) == costs["parameters"]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(variables))
    assert f"weights: {out / 'weights'}" in finished.printed


def test_the_report_shows_every_method(finished):
    out, _, _ = finished
    page = (out / "report" / "index.html").read_text()
    assert all(name in page for name in ("extrass", "extrass-w", "extrass-e", "bilinear"))
    for figure in ("frnet: loss", "frnet: validation, dB", "extrassnet: loss", "extrassnet: validation, dB"):
        assert f"<figcaption>{figure}</figcaption>" in page
    assert list((out / "report" / "sheets").glob("*.png"))


def test_report_and_output_say_how_long_it_trained(finished):
    out, _, _ = finished
    page, printed = (out / "report" / "index.html").read_text(), finished.printed
    for text in (page, printed):
        assert "Warning: frnet made only 2 steps: too few to learn much" in text
        line = r"Training: frnet 2 steps in \d+ s \(waited \d+ s to be compiled\), kept as it was at step \d, "
        assert re.search(line + r"the best of 2 validations \(ESS [\d.]+ dB\); extrassnet 2 steps", text)
    for phase in (
        "data: 100 % 3 sequences",
        "train frnet: (compiling|100 % step 2)",  # compiled while the data rendered, or waited for
        "train extrassnet: 100 % step 2",
        "evaluation: 100 %",
    ):
        assert re.search(rf"^ *\d+:\d\d {phase}", printed, re.MULTILINE), phase


def test_the_log_has_a_line_per_step(finished):
    out, _, _ = finished
    lines = [json.loads(line) for line in (out / "train" / "extrassnet.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2] and "l1_ess" in lines[0]


def test_a_finished_folder_is_not_overwritten(finished, capsys):
    out, _, overrides = finished
    assert run.main(["--preset", "smoke", "--out", str(out), "--set", *overrides]) == 2
    assert "already holds a run. Continue it with --resume" in capsys.readouterr().out.replace("\n", " ")
    assert run.main(["--preset", "smoke", "--out", str(out), "--resume", "--set", *overrides, "method.width=6"]) == 2
    assert "method.width was 8, now 6" in capsys.readouterr().out.replace("\n", " ")


def test_eval_only_gives_the_same_numbers(finished):
    out, _, overrides = finished
    before = json.loads((out / "metrics.json").read_text())
    assert run.main(["--preset", "smoke", "--out", str(out), "--eval-only", "--set", *overrides]) == 0
    after = json.loads((out / "metrics.json").read_text())
    assert after["rows"] == before["rows"] and after["configs"] == before["configs"]
    assert after["environment"]["steps"] == before["environment"]["steps"]
    assert after["seconds"]["training"] == before["seconds"]["training"]  # of the training, not of reading it


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variant", "extras"], "unknown variant 'extras'; choose one of extrass"),
        (["--preset", "fast"], "unknown preset 'fast'; choose one of smoke"),
        (["--set", "widht=3"], "unknown setting 'widht'; the top level has seed"),
        (["--eval-only"], "holds no run"),
        (["--data", "nowhere"], "nowhere/dataset.json: not found"),
    ],
)
def test_bad_arguments_are_one_line(arguments, message, tmp_path, capsys):
    assert run.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().out.replace("\n", " ")


def test_a_crop_that_is_too_small(finished, tmp_path, capsys):
    out, _, _ = finished
    settings = ["stages.crop=[32,16]", "stages.steps=1"]
    arguments = ["--preset", "smoke", "--data", str(out / "scenes"), "--out", str(tmp_path / "out"), "--set", *settings]
    assert run.main(arguments) == 2
    assert "crop: expected at least 24x24 LR pixels" in capsys.readouterr().out.replace("\n", " ")
    assert not (tmp_path / "out").exists()  # what was refused does not stand in the way
    assert run.main([*arguments[:2], *arguments[4:]]) == 2  # the built-in scenes: before they are rendered
    assert "got 32x16 from crop (32, 16) of 48x28 frames" in capsys.readouterr().out.replace("\n", " ")
    assert not (tmp_path / "out").exists()


def test_list_names_all_variants(capsys):
    assert run.main(["--list"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in variants.VARIANTS)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("extrass", ""),
        ("taau-half", ""),
        ("taau", "gets every frame rendered: twice the input"),
        ("taa", "gets every frame rendered at native resolution: eight times the input"),
        ("nsrr", "gets every frame rendered: twice the input"),
        ("extranet+taa", "gets rendered frames at native resolution: four times the input"),
        ("bsr", "+1 frame of latency: it interpolates; frames without a later one are not scored"),
    ],
)
def test_rows_that_are_not_on_equal_terms(name, reason):
    method = variants.VARIANTS[name].method(settings_of(name, "smoke"))
    assert comparison.unequal(method.info, 4) == reason


def test_compare_shares_one_training_between_variants_that_differ_in_their_steps(finished, tmp_path, monkeypatch):
    """A twin of ``extrass-e`` with its weights: one training, two rows with the same numbers; the extra row is kept."""
    scenes, _, overrides = finished
    twin = dataclasses.replace(variants.VARIANTS["extrass-e"], weights="extrass-e")
    monkeypatch.setitem(variants.VARIANTS, "twin", dataclasses.replace(twin, stages={}, presets={}))
    monkeypatch.setattr(variants, "BASELINES", ("extrass-w",))
    out = tmp_path / "out"
    arguments = [
        "--variants",
        "extrass-e, twin",
        "--preset",
        "smoke",
        "--data",
        str(scenes / "scenes"),
        "--out",
        str(out),
    ]
    assert compare.main([*arguments, "--set", *overrides]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["environment"]["steps"] == {"frnet": 2} and metrics["variant"] == "extrass-e, twin"
    rows = {row["method"]: row["psnr"] for row in metrics["rows"] if row["sequence"] == "mean"}
    assert set(rows) == {"extrass-w", "extrass-e", "twin"} and rows["twin"] == rows["extrass-e"]
    assert [path.name for path in (out / "variants").iterdir()] == ["extrass-e"]
    assert compare.main([*arguments, "--set", *overrides, "--eval-only"]) == 0


@pytest.mark.parametrize(
    ("names", "message"), [("", "expected names separated by commas"), ("warp,wrap", "unknown variant 'wrap'")]
)
def test_compare_names_what_is_wrong(names, message, tmp_path, capsys):
    assert compare.main(["--variants", names, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().out.replace("\n", " ")
