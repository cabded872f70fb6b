"""``python -m experiments.run --variant NAME``: render or read data, train, evaluate against baselines, report."""

import argparse
import dataclasses
import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from experiments.config import PRESET_NAMES, Config, make_config


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        "python -m experiments.run", description="Train a variant, evaluate it against baselines, write a report."
    )
    parser.add_argument("--variant", default="extrass", help="what to run; --list shows all (default: extrass)")
    parser.add_argument("--data", metavar="DIR", help="an essjax dataset; without it the built-in scenes are rendered")
    parser.add_argument("--preset", default="quick", help=f"one of {', '.join(PRESET_NAMES)} (default: quick)")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: runs/VARIANT-PRESET)")
    parser.add_argument("--set", dest="overrides", metavar="KEY=VALUE", nargs="+", action="extend", default=[])
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run in --out")
    parser.add_argument("--eval-only", action="store_true", help="evaluate the checkpoint in --out, no training")
    parser.add_argument(
        "--profile", action="store_true", help="write a JAX profiler trace of train and streaming steps"
    )
    parser.add_argument("--list", action="store_true", help="list the variants and stop")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, a signal 130."""
    options, console = parse(arguments), Console()
    try:
        return _run(options, console)
    except (ValueError, RuntimeError) as error:
        from essjax.train import Interrupted

        console.print(f"[red]{'Stopped' if isinstance(error, Interrupted) else 'Error'}:[/red] {error}", soft_wrap=True)
        return 130 if isinstance(error, Interrupted) else 2
    except KeyboardInterrupt:
        console.print("[red]Stopped.[/red] Run the same command with --resume to continue.")
        return 130


def _run(options: argparse.Namespace, console: Console) -> int:
    # Imported here: a typing error in the command line should not wait for JAX.
    from experiments import variants
    from experiments.profile import write_profile

    if options.list:
        for name, summary in variants.describe().items():
            console.print(f"  [bold]{name:<12}[/bold] {summary}")
        return 0
    config = make_config(options.preset, options.overrides)
    variants.get_variant(options.variant)
    out = Path(options.out or f"runs/{options.variant}-{options.preset}")
    if options.profile:
        return write_profile(options.variant, config, out, console)
    _claim(out, options, config)
    _experiment(options, config, out, console)
    return 0


def _claim(out: Path, options: argparse.Namespace, config: Config) -> None:
    """Record what runs in ``out``; refuse to mix two runs, or to start over a run that can be resumed."""
    path, wanted = out / "run.json", {"variant": options.variant, "data": options.data, **dataclasses.asdict(config)}
    wanted = json.loads(json.dumps(wanted))
    if path.exists():
        found = json.loads(path.read_text())
        if not (options.resume or options.eval_only):
            raise ValueError(
                f"{out} already holds a run. Continue it with --resume, evaluate it with --eval-only, "
                "or choose another --out."
            )
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            pairs = ", ".join(f"{key} was {found.get(key)}, now {wanted[key]}" for key in different)
            raise ValueError(f"{out} holds a run with other settings: {pairs}. Use the same ones, or another --out.")
    elif options.eval_only:
        raise ValueError(f"--eval-only: {out} holds no run. Give the --out of a trained one.")
    out.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(wanted, indent=1) + "\n")
    temporary.replace(path)


def _experiment(options: argparse.Namespace, config: Config, out: Path, console: Console) -> None:
    from experiments import datasets
    from experiments.comparison import make_runners, notes, table_references
    from experiments.evaluate import evaluate, load_clip
    from experiments.report import print_table, write_report
    from experiments.training import restore_variant, train_variant
    from experiments.variants import get_variant

    variant = get_variant(options.variant)
    clock, seconds = time.monotonic(), {}

    def lap(name: str) -> None:
        nonlocal clock
        now = time.monotonic()
        seconds[name], clock = round(now - clock, 1), now

    columns = (
        TextColumn("{task.description:<16}"),
        BarColumn(),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("data", total=None, text="")
        dataset = datasets.prepare(
            config,
            options.data,
            out,
            lambda n, total: progress.update(bar, completed=n, total=total, text=f"{n}/{total}"),
        )
        progress.update(bar, completed=1, total=1, text=f"{len(dataset.sequences)} sequences")
        console.print(datasets.describe(dataset), soft_wrap=True)
        lap("data")

        variables, training = {}, {}
        if variant.stages(config):
            if not config.vgg:
                console.print(
                    "VGG term off: give torchvision-layout VGG-16 weights with --set vgg=PATH to switch it on."
                )
            bars: dict[str, Any] = {}

            def on_step(stage: str, step: int, fraction: float, terms: dict[str, float]) -> None:
                if stage not in bars:
                    bars[stage] = progress.add_task(f"train {stage}", total=1.0, text="")
                progress.update(bars[stage], completed=fraction, text=f"step {step}, loss {terms['loss']:.4f}")

            if options.eval_only:
                variables, training = restore_variant(variant, dataset, config, out)
            else:
                variables, training = train_variant(variant, dataset, config, out, on_step)
        lap("training")

        bar = progress.add_task("evaluate", total=None, text="reading")
        segments = {split: dataset.segments(split) for split in ("validation", "test")}
        clips = {split: [load_clip(dataset, s, config.warmup) for s in segments[split]] for split in segments}
        runners, settings = make_runners(
            options.variant, config, variables, clips["validation"], out, lambda text: progress.update(bar, text=text)
        )
        lap("tuning")
        progress.update(bar, total=len(runners) * len(clips["test"]), completed=0)
        result = evaluate(
            runners,
            clips["test"],
            pictures=config.pictures,
            on_step=lambda text: progress.update(bar, advance=1, text=text),
        )
        progress.update(bar, text="done")
        lap("evaluation")
    metrics = {
        "schema": 1,
        "variant": options.variant,
        "preset": options.preset,
        "dataset": datasets.describe(dataset),
        "environment": _environment(config, training),
        "settings": {name: setting._asdict() for name, setting in settings.items()},
        "seconds": seconds,
        "rows": result["rows"],
    }
    remarks = notes(dataset, clips["test"], settings, config)
    page = write_report(
        out, metrics, curves=result["curves"], pictures=result["pictures"], notes=remarks, references=table_references()
    )
    lap("report")
    metrics["seconds"] = {**seconds, "total": round(sum(seconds.values()), 1)}
    _write_json(out / "metrics.json", metrics)
    print_table(metrics, references=table_references(), console=console)
    for remark in remarks:
        console.print(f"[dim]{remark}[/dim]", soft_wrap=True)
    spent = ", ".join(f"{name} {value:.0f} s" for name, value in metrics["seconds"].items())
    console.print(f"{spent}\nmetrics: {out / 'metrics.json'}\nreport:  {page}", soft_wrap=True)


def _write_json(path: Path, content: dict) -> None:
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)


def _environment(config: Config, training: dict) -> dict[str, Any]:
    import jax

    root = Path(__file__).resolve().parent.parent
    try:
        git = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    packages = ("jax", "jaxlib", "flax", "optax", "numpy", "orbax-checkpoint")
    return {
        "commit": commit,
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()}), {os.cpu_count()} CPU cores",
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
        "seed": config.seed,
        "steps": {name: stage["steps"] for name, stage in training.items()},
    }


if __name__ == "__main__":
    sys.exit(main())
