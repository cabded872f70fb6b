"""BENCHMARKS.md from ``experiments/results/*.json``.

``python -m experiments.benchmarks_page`` writes the page; ``... NAME METRICS.json [METRICS.json ...]`` first keeps a
run (or comparison), or the same run with several seeds, as ``experiments/results/NAME.json``; ``... NAME TABLES.json``
keeps what ``experiments.tables`` filled in.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from essjax.data.json_files import write_json
from experiments.benchmark.section import section
from experiments.report.rows import rate_tables
from experiments.tables import get_table, markdown
from experiments.worth import table

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "experiments" / "results"
PAGE = ROOT / "BENCHMARKS.md"
COLUMNS = {
    "psnr": "PSNR", "ssim": "SSIM", "psnr_holes": "PSNR in holes", "tpsnr": "PSNR of frame differences",
    "psnr_foreground": "PSNR of the foreground", "psnr_reference": "foreground against the reference",
}  # fmt: skip
PACE = ("steps", "seconds", "compile_seconds")
"""Fields of each stage of a run, for its pace."""
HEAD = """# Benchmarks

Generated from `experiments/results/*.json` by `python -m experiments.benchmarks_page`; do not edit. Each table is the
mean over test sequences of one run; PSNR in dB after x/(1+x) and sRGB. SS: rendered frames; ESS: extrapolated frames.
`taau` gets every frame rendered (twice the input), `taa` every frame at native resolution (eight times the input).
Frame differences are over two frames, of the same kind in every schedule; in results from before 2026-11-28 over one.
"""


def keep(name: str, paths: Sequence[Path]) -> Path:
    """Keep the mean rows of runs that differ in their seed as ``NAME.json`` in the results folder; returns the file.

    Each metric becomes the mean over runs, with ``<metric>_range``: half of the distance between best and worst.

    Raises:
      ValueError: a file of another schema, runs that differ in more than the seed, or one seed twice.
    """
    runs = [json.loads(path.read_text()) for path in paths]
    for path, run in zip(paths, runs, strict=True):
        if run.get("schema") != 1:
            raise ValueError(f"{path}: expected schema 1, got {run.get('schema')!r}.")
        if run.get("kind") in ("tables", "worth"):
            return _keep_one(name, paths, run)
        first = _alike(runs[0])
        for field, value in _alike(run).items():
            if value != first[field]:
                raise ValueError(
                    f"{path}: expected the {field} of {paths[0]}, {first[field]!r}, got {value!r}. Give runs "
                    "that differ in their seed only."
                )
    seeds = [run["environment"]["seed"] for run in runs]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"{name}: expected runs of different seeds, got the seeds {', '.join(map(str, seeds))}.")
    merged = {**runs[0], "rows": _merge_rows(runs)}
    if len(runs) > 1:
        environments = [run["environment"] for run in runs]
        parts = ("commit", "seed", "steps")
        merged["environment"] = {**environments[0], **{part: [e[part] for e in environments] for part in parts}}
        merged["seconds"] = {
            part: round(sum(run["seconds"][part] for run in runs) / len(runs), 1) for part in runs[0]["seconds"]
        }
        merged["training"] = {
            stage: {part: sum(run["training"][stage][part] for run in runs) / len(runs) for part in PACE}
            for stage in runs[0].get("training", {})
        }
    path = RESULTS / f"{name}.json"
    write_json(path, merged)
    return path


def _alike(run: dict[str, Any]) -> dict[str, Any]:
    """Return what runs with several seeds share, field -> value; settings are None in files older than they."""
    environment, configs = run["environment"], run.get("configs")
    settings = configs and {name: {**config, "seed": None} for name, config in configs.items()}
    parts = {field: run[field] for field in ("variant", "preset", "dataset")}
    return {**parts, "settings": settings, "device": environment["device"], "versions": environment["versions"]}


def _keep_one(name: str, paths: Sequence[Path], content: dict[str, Any]) -> Path:
    if len(paths) > 1:
        raise ValueError(f"{name}: expected one file of {content['kind']}, got {len(paths)}.")
    path = RESULTS / f"{name}.json"
    write_json(path, content)
    return path


def _merge_rows(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Average the rows of the mean over sequences over runs."""
    labels = ("method", "frames", "resolution")
    tables = [
        {tuple(row[label] for label in labels): row for row in run["rows"] if row["sequence"] == "mean"} for run in runs
    ]
    merged = []
    for key, first in tables[0].items():
        row = dict(first)
        for column in COLUMNS:
            values = [table[key].get(column) for table in tables if key in table]
            if any(value is None for value in values):  # one run's frames were not all finite: neither is the mean
                row[column] = None
            elif len(values) > 1:
                row[column] = sum(values) / len(values)
                row[f"{column}_range"] = (max(values) - min(values)) / 2
        merged.append(row)
    return merged


def page(results: list[tuple[str, dict[str, Any]]]) -> str:
    """Make the whole page."""
    sections = {"import": _import_section, "tables": _tables_section, "benchmark": section, "worth": _worth_section}
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


def _tables_section(name: str, content: dict[str, Any]) -> str:
    """Show the papers' tables on our scenes (experiments/tables)."""
    lines = [
        f"## {name}",
        "",
        "The tables of the papers with our numbers (bold) next to theirs, `python -m experiments.tables --preset "
        f"{content['preset']}`. Theirs are of other scenes, longer training and mostly one model per scene: only the "
        "order of the rows can be compared.",
        "",
    ]
    for run in content["runs"]:
        environment, settings = run["environment"], " ".join(run["settings"]) or "none"
        steps = ", ".join(f"{stage} {count}" for stage, count in environment["steps"].items()) or "none"
        lines += [
            f"{', '.join(run['tables'])}: {run['dataset']}; settings: {settings}; commit {environment['commit']}; "
            f"{environment['device']}; jax {environment['versions']['jax']}; seed {environment['seed']}; "
            f"steps: {steps}.",
            "",
        ]
    for remark in content.get("remarks", ()):  # written into the file by hand: what a reader of these numbers must know
        lines += [remark, ""]
    return "\n".join([*lines, *(markdown(get_table(key), ours) for key, ours in content["tables"].items())])


def _section(name: str, metrics: dict[str, Any]) -> str:
    environment = metrics["environment"]
    seeds, commits, counts = (_as_list(environment[part]) for part in ("seed", "commit", "steps"))
    steps = "; ".join(", ".join(f"{stage} {count}" for stage, count in run.items()) or "none" for run in counts)
    seed = (
        f"seed {seeds[0]}" if len(seeds) == 1 else f"mean ± half the range over the seeds {', '.join(map(str, seeds))}"
    )
    versions = environment["versions"]
    overrides = [text for text in metrics.get("overrides", ()) if not text.startswith("seed=")]
    settings = f" --set {' '.join(overrides)}" if overrides else ""
    lines = [
        f"## {name}",
        "",
        f"`--variant {metrics['variant']} --preset {metrics['preset']}{settings}`; {metrics['dataset']}.",
        f"Commit {', '.join(dict.fromkeys(commits))}; {environment['device']}; jax {versions['jax']}, Python "
        f"{versions['python']}; {seed}; steps: {steps}.",
        "Seconds: " + ", ".join(f"{part} {value:g}" for part, value in metrics["seconds"].items()) + ".",
        *_pace(metrics.get("training") or {}),
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
    for rates in rate_tables(metrics):
        body = [[method, *cells] for method, cells in rates.lines.items()]
        lines += [f"{rates.title}:", "", *_markdown(["method", *rates.heads], body)]
    return "\n".join(lines)


def _worth_section(name: str, content: dict[str, Any]) -> str:
    """Show what each buffer is worth (experiments/worth.py)."""
    heads, lines = table(content)
    environment = content["environment"]
    about = (
        f"`python -m experiments.worth {content['weights']}`, {content['clips']} test clips; commit "
        f"{environment['commit']}; {environment['device']}; jax {environment['versions']['jax']}. PSNR (in holes), by "
        "rate and frames since the rendered one."
    )
    return "\n".join([f"## {name}", "", about, "", *_markdown(["played", *heads], lines)])


def _markdown(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    rule = "|---|" + "---:|" * (len(heads) - 1)
    return [f"| {' | '.join(heads)} |", rule, *(f"| {' | '.join(line)} |" for line in lines), ""]


def _pace(training: dict[str, Any]) -> list[str]:
    """How fast each stage trained; nothing for runs older than the measurement."""
    parts = [
        f"{stage} {found['steps'] / found['seconds']:.2f} steps per second (waited {found['compile_seconds']:.0f} s "
        "for its compilation)"
        for stage, found in training.items()
        if found["seconds"]
    ]
    return [f"Pace: {', '.join(parts)}."] if parts else []


def _number(value: float | None, column: str) -> str:
    return "–" if value is None else f"{value:.3f}" if column == "ssim" else f"{value:.2f}"


def _spread(row: dict[str, Any], column: str) -> str:
    spread = row.get(f"{column}_range")
    return f" ± {_number(spread, column)}" if spread else ""


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def current() -> str:
    """Make the page as the results folder has it."""
    return page([(path.stem, json.loads(path.read_text())) for path in sorted(RESULTS.glob("*.json"))])


if __name__ == "__main__":
    if len(sys.argv) > 2:
        keep(sys.argv[1], [Path(argument) for argument in sys.argv[2:]])
    elif len(sys.argv) == 2:
        sys.exit(__doc__)
    PAGE.write_text(current())
