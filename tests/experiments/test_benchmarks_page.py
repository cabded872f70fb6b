import json

import pytest

from experiments import benchmarks_page, import_benchmark


def test_the_page_is_current():
    assert benchmarks_page.PAGE.read_text() == benchmarks_page.current(), "run python -m experiments.benchmarks_page"


def test_a_result_becomes_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmarks_page, "RESULTS", tmp_path)
    row = {"method": "jau", "frames": "ss", "resolution": "hr", "psnr": 23.456, "psnr_range": 0.12, "ssim": 0.71239}
    environment = {"commit": "abc", "device": "cpu", "seed": 0, "steps": {"a": 3}}
    environment["versions"] = {"jax": "1", "python": "3"}
    metrics = {
        "schema": 1, "variant": "extrass", "preset": "quick", "dataset": "d", "environment": environment,
        "seconds": {"data": 2.0}, "rows": [{**row, "sequence": "mean"}, {**row, "sequence": "one"}],
    }  # fmt: skip
    (tmp_path / "run").mkdir()
    source = tmp_path / "run" / "metrics.json"
    source.write_text(json.dumps(metrics))
    kept = json.loads(benchmarks_page.keep(source).read_text())
    assert [r["sequence"] for r in kept["rows"]] == ["mean"]
    assert "| jau | SS | 23.46 ± 0.12 | 0.712 |" in benchmarks_page.current()
    source.write_text(json.dumps({**metrics, "schema": 2}))
    with pytest.raises(ValueError, match="expected schema 1, got 2"):
        benchmarks_page.keep(source)


def test_the_import_benchmark_measures_what_it_says(tmp_path, monkeypatch):
    monkeypatch.setattr(import_benchmark, "WIDTH", 48)
    monkeypatch.setattr(import_benchmark, "HEIGHT", 28)
    import_benchmark.make_dump(tmp_path, 52)
    measured = import_benchmark.measure(tmp_path, 52, with_reference=True, workers=2)
    assert measured["frames"] == 52 and len(measured["resident_megabytes"]) == 2
    assert measured["cpu_seconds_per_frame"] > 0 and 50 < measured["resident_megabytes"][0] < 5000
    text = benchmarks_page.page([("import", {"kind": "import", "machine": "2 cores", "cases": {"small": measured}})])
    assert f"| small | 52 | {measured['frames_per_second']:.1f} |" in text
    assert not (tmp_path / "out").exists()
