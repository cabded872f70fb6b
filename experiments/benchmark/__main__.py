"""``python -m experiments.benchmark [--suite warp ...]``: time everything and keep the results."""

import argparse
import datetime
import os
import re
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.benchmark.schema import SIZE
from experiments.run import print_error

SUITES = ("warp", "networks", "pipeline", "train", "scenes")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        "python -m experiments.benchmark", description="Time essjax and its peers; results go to experiments/results."
    )
    parser.add_argument("--suite", nargs="+", default=list(SUITES), metavar="NAME", help=f"of {', '.join(SUITES)}")
    parser.add_argument("--device", help="cpu or gpu (default: JAX's choice)")
    parser.add_argument("--size", default=SIZE, metavar="WxH", help=f"of low-resolution frames (default: {SIZE})")
    parser.add_argument("--repetitions", type=int, default=20, help="of each case (default: 20)")
    parser.add_argument("--frames", type=int, default=300, help="streamed by the pipeline suite (default: 300)")
    parser.add_argument(
        "--dtypes", nargs="+", default=["float32", "bfloat16"], help="of networks (default: float32 bfloat16)"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="cases that begin so, for example: extrass guided")
    parser.add_argument("--no-peers", action="store_true", help="only essjax, even where PyTorch is installed")
    parser.add_argument("--out", metavar="DIR", type=Path, help="where results go (default: experiments/results)")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2."""
    options, console = parse(arguments), Console()
    try:
        return _benchmark(options, console)
    except (ValueError, RuntimeError, OSError) as error:
        print_error(error, console)
        return 2


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match or min(int(n) for n in match.groups()) < 32:
        raise ValueError(f"--size {text}: expected WIDTHxHEIGHT, at least 32x32 pixels, for example 960x540.")
    return int(match[1]), int(match[2])


def _benchmark(options: argparse.Namespace, console: Console) -> int:
    width, height = _size(options.size)
    unknown = [name for name in options.suite if name not in SUITES]
    if unknown:
        raise ValueError(f"--suite: expected some of {', '.join(SUITES)}, got {', '.join(unknown)}.")
    if options.repetitions < 1 or options.frames < 2:
        raise ValueError(
            f"expected at least 1 repetition and 2 frames, got {options.repetitions} and {options.frames}."
        )
    if options.device not in (None, "cpu", "gpu"):
        raise ValueError(f"--device: expected cpu or gpu, got {options.device!r}.")
    dtypes = ("float32", "bfloat16", "float16")
    unknown = [name for name in options.dtypes if name not in dtypes]
    if unknown:
        raise ValueError(f"--dtypes: expected some of {', '.join(dtypes)}, got {', '.join(unknown)}.")
    if options.device:
        os.environ["JAX_PLATFORMS"] = {"cpu": "cpu", "gpu": "cuda"}[options.device]
    # Imported here: a typing error should not wait for JAX, and JAX reads its platform once.
    import jax

    from experiments.benchmark import machine, schema, suites
    from experiments.benchmarks_page import RESULTS
    from experiments.environment import environment
    from experiments.experiment import write_json

    settings = suites.Options(
        width, height, options.repetitions, options.frames, not options.no_peers, tuple(options.dtypes),
        tuple(options.only or ()),
    )  # fmt: skip
    out, load_average = options.out or RESULTS, os.getloadavg()[0]
    out.mkdir(parents=True, exist_ok=True)
    limits = machine.roofline(options.repetitions)
    for name in options.suite:
        suite = suites.load()[name]
        result: dict[str, Any] = {
            "schema": 1,
            "kind": "benchmark",
            "suite": name,
            "environment": {**environment("torch"), "date": datetime.datetime.now(datetime.UTC).date().isoformat()},
            "machine": {**limits, "load_at_start": load_average},
            "settings": {"size": [width, height], "repetitions": options.repetitions, "frames": options.frames},
            "rows": [],
            "facts": {},
        }
        size = "" if options.size == SIZE else f"-{options.size}"
        path = out / f"benchmark-{name}-{jax.default_backend()}-jax-{jax.__version__}{size}.json"
        partial = path.with_suffix(".partial")  # what a run that breaks off has measured
        for row in suite.rows(settings):
            if "flops" in row:
                row["roofline_fraction"] = machine.roofline_fraction(row, limits, row.get("dtype", "float32"))
            result["rows"].append(row)
            write_json(partial, result)
            _print(row, console)
        if not result["rows"]:
            raise ValueError(f"--only {' '.join(options.only)}: no case of the suite {name} begins so.")
        result["facts"] = {fact: float(value) for fact, value in suite.facts(result["rows"]).items()}
        schema.check(result)
        write_json(path, result)
        partial.unlink()
        for fact, value in result["facts"].items():
            console.print(f"{fact}: {value:.3g}", soft_wrap=True)
        console.print(f"{name}: {path}", soft_wrap=True, markup=False)
    return 0


def _print(row: dict[str, Any], console: Console) -> None:
    rate = f", {row['roofline_fraction']:.0%} of the roofline" if "roofline_fraction" in row else ""
    memory = f", {row['temporary_megabytes']:.1f} MB of temporaries" if "temporary_megabytes" in row else ""
    dtype = f" {row['dtype']}" if "dtype" in row else ""
    console.print(
        f"{row['name']} ({row['implementation']}{dtype}): {row['median_ms']:.3f} ms ± {row['iqr_ms'] / 2:.3f}"
        f"{rate}{memory}",
        soft_wrap=True, highlight=False,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
