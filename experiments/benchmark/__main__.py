"""``python -m experiments.benchmark [--suite warp ...]``: time everything and keep the results."""

import dataclasses
import datetime
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from experiments.benchmark.schema import SIZE
from experiments.run import guarded, parse_as

SUITES = ("warp", "networks", "pipeline", "ratios", "train", "scenes")


@dataclasses.dataclass(frozen=True)
class Command:
    """Time essjax and its peers; results go to experiments/results."""

    suite: tuple[str, ...] = SUITES
    """some of warp, networks, pipeline, ratios, train, scenes"""
    device: str | None = None
    """cpu or gpu; JAX's choice without it"""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = SIZE
    """of low-resolution frames"""
    repetitions: int = 20
    """of each case"""
    frames: int = 300
    """streamed by the suites pipeline and ratios"""
    dtypes: tuple[str, ...] = ("float32", "bfloat16")
    """of networks"""
    only: tuple[str, ...] = ()
    """cases that begin so, for example: extrass guided"""
    peers: bool = True
    """only essjax, even where PyTorch is installed"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """where results go; experiments/results without it"""


def parse(arguments: Sequence[str] | None = None) -> Command:
    """Parse the command line."""
    return parse_as(Command, "benchmark", arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, Ctrl-C 130, SIGTERM 143."""
    options = parse(arguments)
    return guarded(lambda console: _benchmark(options, console), "What was measured so far is in *.partial.")


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match or min(int(n) for n in match.groups()) < 32:
        raise ValueError(f"--size {text}: expected WIDTHxHEIGHT, at least 32x32 pixels, for example 960x540.")
    return int(match[1]), int(match[2])


def _benchmark(options: Command, console: Console) -> int:
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

    from essjax.data.json_files import write_json
    from essjax.kernels import check_platform
    from experiments.benchmark import machine, schema, suites
    from experiments.benchmarks_page import RESULTS
    from experiments.environment import environment

    check_platform()
    settings = suites.Options(
        width, height, options.repetitions, options.frames, options.peers, options.dtypes, options.only,
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
