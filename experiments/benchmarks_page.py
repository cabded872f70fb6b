"""BENCHMARKS.md from ``experiments/results/*.json``: ``python -m experiments.benchmarks_page [metrics.json ...]``.

Given metrics files of runs, it first copies their means into ``experiments/results``; then it writes the page.
"""

import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "experiments" / "results"
PAGE = ROOT / "BENCHMARKS.md"
COLUMNS = {
    "psnr": "PSNR", "ssim": "SSIM", "psnr_holes": "PSNR in holes", "tpsnr": "PSNR of frame differences",
    "psnr_foreground": "PSNR of the foreground", "psnr_reference": "foreground against the reference",
}  # fmt: skip
HEAD = """# Benchmarks

Generated from `experiments/results/*.json` by `python -m experiments.benchmarks_page`; do not edit. Each table is the
mean over test sequences of one run; PSNR in dB after x/(1+x) and sRGB. SS: rendered frames; ESS: extrapolated frames.
`taau` gets every frame rendered (twice the input), `taa` every frame at native resolution (eight times the input).
"""


def keep(metrics_path: Path, name: str | None = None) -> Path:
    """Copy the mean rows of a run's ``metrics.json`` into the results folder; returns the file."""
    metrics = json.loads(metrics_path.read_text())
    if metrics.get("schema") != 1:
        raise ValueError(f"{metrics_path}: expected schema 1, got {metrics.get('schema')!r}.")
    metrics["rows"] = [row for row in metrics["rows"] if row["sequence"] == "mean"]
    path = RESULTS / f"{name or metrics_path.resolve().parent.name}.json"
    path.write_text(json.dumps(metrics, indent=1) + "\n")
    return path


def page(results: list[tuple[str, dict[str, Any]]]) -> str:
    """The whole page."""
    sections = {"import": _import_section}
    return "\n".join(
        [HEAD, *(sections.get(metrics.get("kind", ""), _section)(name, metrics) for name, metrics in results)]
    )


def _import_section(name: str, metrics: dict[str, Any]) -> str:
    """Speed and memory of ``essjax import`` (experiments/import_benchmark.py)."""
    lines = [
        f"## {name}",
        "",
        f"`python -m experiments.import_benchmark`; {metrics['machine']}. Memory: of the process, after a tenth of the "
        "frames and at the end.",
        "",
        "| frames | count | frames per second | CPU seconds per frame | MB per frame on disk | memory, MB |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for case, values in metrics["cases"].items():
        memory, speed = values["resident_megabytes"], values["frames_per_second"]
        lines.append(
            f"| {case} | {values['frames']} | {speed:.1f} | {values['cpu_seconds_per_frame']:.3f} | "
            f"{values['megabytes_per_frame']:.1f} | {memory[len(memory) // 10]:.0f}, {memory[-1]:.0f} |"
        )
    return "\n".join([*lines, ""])


def _section(name: str, metrics: dict[str, Any]) -> str:
    environment = metrics["environment"]
    steps = ", ".join(f"{stage} {count}" for stage, count in environment["steps"].items())
    versions = environment["versions"]
    lines = [
        f"## {name}",
        "",
        f"`--variant {metrics['variant']} --preset {metrics['preset']}`; {metrics['dataset']}.",
        f"Commit {environment['commit']}; {environment['device']}; jax {versions['jax']}, Python {versions['python']}; "
        f"seed {environment['seed']}; steps: {steps or 'none'}.",
        "Seconds: " + ", ".join(f"{part} {value:g}" for part, value in metrics["seconds"].items()) + ".",
        "",
    ]
    for resolution, title in (("hr", "High resolution"), ("lr", "Low resolution")):
        rows = [row for row in metrics["rows"] if row["resolution"] == resolution]
        columns = [c for c in COLUMNS if any(row.get(c) is not None for row in rows)]
        if rows:
            lines += [f"{title}:", "", "| method | frames | " + " | ".join(COLUMNS[c] for c in columns) + " |"]
            lines.append("|---|---|" + "---:|" * len(columns))
            for row in sorted(rows, key=lambda row: (row["frames"] != "ss", -(row["psnr"] or 0))):
                values = [_number(row.get(c), c) + _spread(row, c) for c in columns]
                lines.append(f"| {row['method']} | {row['frames'].upper()} | " + " | ".join(values) + " |")
            lines.append("")
    return "\n".join(lines)


def _number(value: float | None, column: str) -> str:
    return "–" if value is None else f"{value:.3f}" if column == "ssim" else f"{value:.2f}"


def _spread(row: dict[str, Any], column: str) -> str:
    spread = row.get(f"{column}_range")
    return "" if spread is None else f" ± {_number(spread, column)}"


def current() -> str:
    """The page as the results folder has it."""
    return page([(path.stem, json.loads(path.read_text())) for path in sorted(RESULTS.glob("*.json"))])


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        keep(Path(argument))
    PAGE.write_text(current())
