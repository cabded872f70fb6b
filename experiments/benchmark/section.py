"""A suite's results as a section of BENCHMARKS.md."""

from typing import Any

from experiments.benchmark.measure import QUEUED
from experiments.benchmark.schema import SIZE, check

NOTES = {
    "warp": "One image `[H, W, 3]`, float32. The guided warp reads 6 guide channels.",
    "networks": "One frame, weights as arguments. FLOP: two per multiply-add of convolutions and matrix products.",
    "pipeline": "Whole methods, weights built in, frame by frame: the frame to the device and the image back included, "
    "history donated, any other transfer refused. Difference: largest between streamed and unrolled images, over their "
    "mean.",
    "ratios": "As pipeline, of one output size; the row says the input's. x2 is pipeline's.",
    "train": "Both rollouts of ExtraSS, all losses, gradient and Adam; networks of 24 channels.",
    "scenes": "The built-in renderer, from outside: many jitted pieces.",
}

GPU_NOTE = (
    f"{QUEUED['gpu']} calls one after the other before each look at the clock (pipeline: one frame); device: for how "
    "long a call keeps the GPU busy, by the profiler; float32 products are TF32."
)


def section(name: str, result: dict[str, Any]) -> str:
    """Title, how it was measured, one row per case and implementation, facts."""
    check(result, name)
    environment, machine, settings = (result[key] for key in ("environment", "machine", "settings"))
    versions = environment["versions"]
    packages = ", ".join(f"{key} {versions[key]}" for key in ("jax", "torch", "python") if key in versions)
    limits = (
        f"copy {machine['copy_bytes_per_second'] / 1e9:.1f} GB/s, product "
        f"{machine['float32_flops_per_second'] / 1e9:.0f} GFLOP/s float32, "
        f"{machine['bfloat16_flops_per_second'] / 1e9:.0f} bfloat16"
    )
    size = "{}x{}".format(*settings["size"])
    size = "" if size == SIZE else f" --size {size}"
    notes = [NOTES[result["suite"]]] + [GPU_NOTE] * any("device_ms" in row for row in result["rows"])
    lines = [
        f"## {name}",
        "",
        f"`python -m experiments.benchmark --suite {result['suite']}{size}`; commit {environment['commit']}, "
        f"{environment['date']}; {environment['device']}; {packages}; {settings['repetitions']} repetitions, load "
        f"{machine['load_at_start']:.1f} at the start. The machine in the same run: {limits}. {' '.join(notes)}",
        "",
    ]
    return "\n".join([*lines, *_table(result["rows"]), "", *_facts(result["facts"])])


def _table(rows: list[dict[str, Any]]) -> list[str]:
    ours = {(row["name"], row.get("dtype")): row["median_ms"] for row in rows if row["implementation"] == "essjax"}
    columns = {
        "by": lambda row: row["implementation"] + (f", {row['dtype']}" if "dtype" in row else ""),
        "median, ms": lambda row: _short(row["median_ms"]),
        "IQR, ms": lambda row: _short(row["iqr_ms"], 2),
        "device, ms": lambda row: _short(row["device_ms"]) if "device_ms" in row else "",
        "over essjax": lambda row: _ratio(row, ours),
        "rate": _rate,
        "GFLOP/s": lambda row: _per_second(row, "flops", 1e9),
        "of the roofline": lambda row: f"{row['roofline_fraction']:.0%}" if "roofline_fraction" in row else "",
        "temporaries, MB": lambda row: f"{row['temporary_megabytes']:.1f}" if "temporary_megabytes" in row else "",
        "compiles, s": lambda row: f"{row['compile_seconds']:.1f}" if "compile_seconds" in row else "",
        "p95, p99, worst, ms": _latency,
        "difference": lambda row: f"{row['difference_from_unrolled']:.1g}" if "difference_from_unrolled" in row else "",
    }
    cells = {title: [value(row) for row in rows] for title, value in columns.items()}
    cells = {title: values for title, values in cells.items() if any(values)}  # no empty columns
    lines = ["| case | " + " | ".join(cells) + " |", "|---|---|" + "---:|" * (len(cells) - 1)]
    for n, row in enumerate(rows):
        lines.append(f"| {row['name']} | " + " | ".join(values[n] for values in cells.values()) + " |")
    return lines


def _short(value: float, digits: int = 3) -> str:
    """Significant digits, without an exponent."""
    return f"{value:.{digits}g}" if value < 10**digits else f"{value:.0f}"


def _ratio(row: dict[str, Any], ours: dict[tuple, float]) -> str:
    if row["implementation"] == "essjax":
        return ""
    return f"{row['median_ms'] / ours[row['name'], row.get('dtype')]:.2f}"


def _rate(row: dict[str, Any]) -> str:
    unit, amount = next(iter(row["work"].items()), ("", 0.0))
    if not unit:
        return ""
    rate = amount / (1e-3 * row["median_ms"])
    return f"{_short(rate)} {unit}/s" if rate < 1e4 else f"{_short(rate / 1e6)} M{unit}/s"


def _per_second(row: dict[str, Any], key: str, unit: float) -> str:
    # Warps hold no products: what XLA counts there is mostly index arithmetic.
    if row.get(key, 0.0) < 1e8:
        return ""
    return _short(row[key] / (1e-3 * row["median_ms"]) / unit)


def _latency(row: dict[str, Any]) -> str:
    found = row.get("latency")
    return ", ".join(f"{found[key]:.3g}" for key in ("p95", "p99", "worst")) if found else ""


def _facts(facts: dict[str, float]) -> list[str]:
    return [f"- {name}: {value:.3g}" for name, value in facts.items()] + ([""] if facts else [])
