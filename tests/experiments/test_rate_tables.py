"""Numbers by rate and distance: on the terminal, in the page of a run, in BENCHMARKS.md."""

import io

from rich.console import Console

from experiments.benchmarks_page import page
from experiments.report import print_table, write_report
from experiments.report.rows import rate_tables
from tests.experiments.test_report import make_metrics

RATES = [
    {"method": method, "frames": "ess" if distance else "ss", "resolution": "hr", "rate": rate, "distance": distance,
     "psnr": start - distance}
    for method, start in (("extrass", 26.25), ("taau-half", 24.5))
    for rate in (2, 3)
    for distance in range(rate)
]  # fmt: skip


def test_a_table_by_distance_where_there_is_more_than_every_other_frame(tmp_path):
    metrics = {**make_metrics(), "rates": RATES}
    half, third = rate_tables(metrics)
    assert half.heads == ["SS", "+1"] and third.heads == ["SS", "+1", "+2"]
    assert list(third.lines) == ["extrass", "taau-half"]  # the best first
    assert third.lines["extrass"] == ["26.25", "25.25", "24.25"]
    console = Console(file=io.StringIO(), width=80)
    print_table(metrics, console=console)
    text = console.file.getvalue()
    assert "One frame in 3 rendered, HR: PSNR (dB) by frames since the rendered one" in text and "…" not in text
    assert "<td>24.25</td>" in write_report(tmp_path, metrics).read_text()
    assert rate_tables(make_metrics()) == []
    assert rate_tables({**metrics, "rates": [row for row in RATES if row["rate"] == 2]}) == []


def test_what_buffers_are_worth_is_on_the_page():
    rows = [{**row, "without": without, "psnr_holes": None} for row in RATES[:2] for without in ("", "normal+stencil")]
    environment = {"commit": "abc", "device": "cpu", "versions": {"jax": "0.10.2"}}
    found = {"kind": "worth", "rows": rows, "weights": "w.safetensors", "clips": 3, "environment": environment}
    lines = page([("worth-test", found)]).splitlines()
    assert "| played | 1:2 SS | 1:2 +1 |" in lines
    assert "| extrass without normal, stencil | 26.25 | 25.25 |" in lines
