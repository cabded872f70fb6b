import json

import pytest

from experiments import benchmarks_page


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
