"""The content of a result file of the benchmark, checked before it is written and before it is shown."""

from typing import Any

SIZE = "960x540"
"""Size of low-resolution frames; results of another have it in their file's name."""
RESULT = {
    "schema": int, "kind": str, "suite": str, "environment": dict, "machine": dict, "settings": dict, "rows": list,
    "facts": dict,
}  # fmt: skip
ENVIRONMENT = {"commit": str, "date": str, "device": str, "versions": dict}
ROW = {"name": str, "implementation": str, "median_ms": float, "iqr_ms": float, "repetitions": int, "work": dict}
OPTIONAL = {
    "dtype": str, "compile_seconds": float, "compilations": int, "temporary_megabytes": float, "peak_megabytes": float,
    "least_bytes": float, "xla_bytes": float, "xla_flops": float, "flops": float, "roofline_fraction": float,
    "parameters": int, "latency": dict, "difference_from_unrolled": float, "difference_from_essjax": float,
    "waiting_fraction": float, "device_ms": float,
}  # fmt: skip


def check(result: dict[str, Any], where: str = "result") -> None:
    """Raise a ValueError that names the first entry that is missing, unknown or of the wrong type."""
    _entries(result, RESULT, {}, where)
    if result["schema"] != 1 or result["kind"] != "benchmark":
        raise ValueError(
            f"{where}: expected schema 1 and kind 'benchmark', got {result['schema']} and {result['kind']!r}."
        )
    _entries(result["environment"], ENVIRONMENT, {}, f"{where}, environment", others=True)
    if not result["rows"]:
        raise ValueError(f"{where}: expected at least one row, got none. Run the suite again.")
    for row in result["rows"]:
        _entries(row, ROW, OPTIONAL, f"{where}, row {row.get('name', '?')!r}")
        if not row["median_ms"] > 0:
            raise ValueError(f"{where}, row {row['name']!r}: expected a positive median, got {row['median_ms']}.")


def _entries(found: dict, required: dict[str, type], optional: dict[str, type], where: str, *, others=False) -> None:
    for name, kind in required.items():
        if name not in found:
            raise ValueError(f"{where}: {name} is missing; expected {', '.join(required)}.")
        _typed(found[name], kind, f"{where}, {name}")
    for name, value in found.items():
        if name in optional:
            _typed(value, optional[name], f"{where}, {name}")
        elif name not in required and not others:
            raise ValueError(f"{where}: unknown entry {name}; expected {', '.join([*required, *optional])}.")


def _typed(value: Any, kind: type, where: str) -> None:
    fits = isinstance(value, int | float) if kind is float else isinstance(value, kind)
    if not fits or isinstance(value, bool):
        raise ValueError(f"{where}: expected {kind.__name__}, got {value!r}.")
