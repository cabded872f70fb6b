import json

import pytest

from experiments import benchmarks_page, import_benchmark


def test_the_page_is_current():
    assert benchmarks_page.PAGE.read_text() == benchmarks_page.current(), "run python -m experiments.benchmarks_page"


def run(folder, psnr, **changes):
    """A ``metrics.json`` with one row, of the given PSNR."""
    row = {"method": "jau", "frames": "ss", "resolution": "hr", "psnr": psnr, "ssim": 0.71239, "tpsnr": None}
    environment = {"commit": "abc", "device": "cpu", "seed": changes.pop("seed", 0), "steps": {"a": 3}}
    environment |= {"device": changes.pop("device", "cpu"), "versions": {"jax": changes.pop("jax", "1"), "python": "3"}}
    metrics = {
        "schema": 1, "variant": "extrass", "preset": "quick", "dataset": "d", "environment": environment,
        "seconds": {"data": 2.0}, "rows": [{**row, "sequence": "mean"}, {**row, "sequence": "one"}], **changes,
    }  # fmt: skip
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder / "metrics.json"


def test_a_result_becomes_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    kept = json.loads(benchmarks_page.keep("one", [run(tmp_path / "run", 23.456)]).read_text())
    assert [r["sequence"] for r in kept["rows"]] == ["mean"]
    assert "| jau | SS | 23.46 | 0.712 |" in benchmarks_page.current() and "seed 0;" in benchmarks_page.current()
    with pytest.raises(ValueError, match="expected schema 1, got 2"):
        benchmarks_page.keep("two", [run(tmp_path / "newer", 1.0, schema=2)])


def test_runs_with_several_seeds_become_mean_and_range(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    paths = [run(tmp_path / str(seed), psnr, seed=seed) for seed, psnr in enumerate((23.0, 24.0, 23.2))]
    row = json.loads(benchmarks_page.keep("three", paths).read_text())["rows"][0]
    assert row["psnr"] == pytest.approx(23.4) and row["psnr_range"] == pytest.approx(0.5)
    assert row["ssim_range"] == 0 and "tpsnr_range" not in row
    text = benchmarks_page.current()
    assert "| jau | SS | 23.40 ± 0.50 | 0.712 |" in text
    assert "seeds 0, 1, 2; steps: a 3; a 3; a 3." in text and "Commit abc;" in text
    with pytest.raises(ValueError, match="expected the dataset of .* 'd', got 'other'"):
        benchmarks_page.keep("mixed", [paths[0], run(tmp_path / "other", 1.0, dataset="other")])


def test_the_pace_of_the_training_is_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    made = [
        {"seconds": 50.0, "steps": steps, "compile_seconds": waited, "still": 0}
        for steps, waited in ((100, 20), (200, 0))
    ]
    idle = {"seconds": 0.0, "steps": 0, "compile_seconds": 0.0}
    paths = [
        run(tmp_path / str(seed), 23.0, seed=seed, training={"frnet": found, "idle": idle})
        for seed, found in enumerate(made)
    ]
    benchmarks_page.keep("one", paths[:1])
    text = benchmarks_page.current()
    assert "Pace: frnet 2.00 steps per second (waited 20 s for its compilation).\n" in text
    benchmarks_page.keep("one", paths)
    assert "Pace: frnet 3.00 steps per second (waited 10 s for its compilation).\n" in benchmarks_page.current()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "expected runs of different seeds, got the seeds 0, 0"),
        ({"seed": 1, "device": "H100"}, "expected the device of .*, 'cpu', got 'H100'"),
        ({"seed": 1, "jax": "2"}, "expected the versions of .*, {'jax': '1', .*, got {'jax': '2'"),
        ({"seed": 1, "configs": {"extrass": {"width": 24, "seed": 1}}}, "expected the settings of .*'width': 16"),
    ],
)
def test_runs_that_differ_in_more_than_the_seed_are_not_merged(tmp_path, monkeypatch, changes, message):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    configs = {"extrass": {"width": 16, "seed": 0}}
    paths = [run(tmp_path / "a", 23.0, configs=configs), run(tmp_path / "b", 24.0, **{"configs": configs, **changes})]
    with pytest.raises(ValueError, match=message):
        benchmarks_page.keep("mixed", paths)
    assert not (tmp_path / "mixed.json").exists()


def test_settings_stand_beside_the_preset_but_for_the_seed(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    paths = [
        run(tmp_path / str(seed), 23.0, seed=seed, overrides=[f"seed={seed}", "width=24"],
            configs={"extrass": {"width": 24, "seed": seed}})
        for seed in (0, 1)
    ]  # fmt: skip
    benchmarks_page.keep("two", paths)
    assert "`--variant extrass --preset quick --set width=24`; d." in benchmarks_page.current()


def test_tables_are_kept_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    environment = {"commit": "abc", "device": "cpu", "seed": 0, "steps": {"a/b": 3}, "versions": {"jax": "1"}}
    run = {"tables": ["extrass-2"], "settings": ["scale=2"], "dataset": "d", "environment": environment, "seconds": {}}
    ours = {
        label: {"PSNR": value}
        for label, value in zip(("ExtraNet", "IFRNet", "Ours-W", "Ours-E"), (3, 2, 4, 5), strict=True)
    }
    content = {"schema": 1, "kind": "tables", "preset": "quick", "runs": [run], "tables": {"extrass-2": ours}}
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "tables.json").write_text(json.dumps(content))
    benchmarks_page.keep("tables", [tmp_path / "in" / "tables.json"])
    text = benchmarks_page.current()
    assert "| Ours-E (`extrass-e`) | 31.80 | 22.00 | 40.06 | 33.29 | 31.79 | **5.00** |" in text
    assert "the paper's order holds (6 of 6 pairs)" in text and "steps: a/b 3." in text
    with pytest.raises(ValueError, match="expected one file of tables, got 2"):
        benchmarks_page.keep("tables", 2 * [tmp_path / "in" / "tables.json"])


def test_the_import_benchmark_measures_what_it_says(tmp_path, monkeypatch):
    monkeypatch.setattr(import_benchmark, "WIDTH", 48)
    monkeypatch.setattr(import_benchmark, "HEIGHT", 28)
    import_benchmark.make_dump(tmp_path, 52)
    measured = import_benchmark.measure(tmp_path, 52, with_reference=True, workers=2)
    assert measured["frames"] == 52 and len(measured["resident_megabytes"]) == 2
    assert (
        measured["cpu_seconds_per_frame"] > 0 and 50 < measured["resident_megabytes"][0] < 50_000
    )  # MB, of a worker with whatever it ran before
    text = benchmarks_page.page([("import", {"kind": "import", "machine": "2 cores", "cases": {"small": measured}})])
    assert f"| small | 52 | {measured['frames_per_second']:.1f} |" in text
    assert not (tmp_path / "out").exists()
