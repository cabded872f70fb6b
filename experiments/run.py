"""``python -m experiments.run --variant NAME``: render or read data, train, evaluate against baselines, report."""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from experiments.config import PRESET_NAMES


def shared_options(parser: argparse.ArgumentParser) -> None:
    """Add what ``run`` and ``compare`` have in common."""
    parser.add_argument("--data", metavar="DIR", help="an essjax dataset; without it the built-in scenes are rendered")
    parser.add_argument("--preset", default="quick", help=f"one of {', '.join(PRESET_NAMES)} (default: quick)")
    parser.add_argument("--set", dest="overrides", metavar="KEY=VALUE", nargs="+", action="extend", default=[])
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run in --out")
    parser.add_argument("--eval-only", action="store_true", help="evaluate the checkpoint in --out, no training")
    parser.add_argument(
        "--tensorboard",
        action="store_true",
        help="write TensorBoard events (needs tensorboardX)",
    )
    parser.add_argument("--list", action="store_true", help="list the variants and stop")
    parser.add_argument(
        "--no-compilation-cache", dest="compilation_cache", action="store_false",
        help="compile everything anew instead of keeping programs in ~/.cache/essjax",
    )  # fmt: skip


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        "python -m experiments.run", description="Train a variant, evaluate it against baselines, write a report."
    )
    parser.add_argument("--variant", default="extrass", help="what to run; --list shows all (default: extrass)")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: runs/VARIANT-PRESET[-DATA])")
    parser.add_argument(
        "--profile", action="store_true", help="write a JAX profiler trace of train and streaming steps"
    )
    shared_options(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, a signal 130, a run with a dead network 1."""
    options = parse(arguments)
    return guarded(lambda console: _run(options, console))


def guarded(command: Callable[[Console], int]) -> int:
    """Run ``command``; bad input prints one line and returns 2, a signal 130."""
    console = Console()
    try:
        return command(console)
    except (ValueError, RuntimeError, OSError) as error:
        from essjax.train import Interrupted

        stopped = isinstance(error, Interrupted)
        print_error(error, console, "Stopped" if stopped else "Error")
        return 130 if stopped else 2
    except KeyboardInterrupt:
        console.print("[red]Stopped.[/red] Run the same command with --resume to continue.")
        return 130


def print_error(error: Exception, console: Console, label: str = "Error") -> None:
    """One line; brackets in the message are no markup."""
    console.print(Text.assemble((f"{label}:", "red"), f" {error}"), soft_wrap=True)


def exit_code(metrics: Mapping[str, Any], console: Console) -> int:
    """0, or 1 after a last line for each dead network of a run."""
    for text in metrics["dead"]:
        console.print(Text.assemble(("Dead network:", "red"), f" {text}"), soft_wrap=True)
    return 1 if metrics["dead"] else 0


def print_variants(console: Console) -> int:
    """What ``--list`` prints."""
    from experiments.variants import describe

    summaries = describe()
    width = max(len(name) for name in summaries)
    for name, summary in summaries.items():
        console.print(f"  [bold]{name:<{width}}[/bold] {summary}", soft_wrap=True)
    return 0


def _run(options: argparse.Namespace, console: Console) -> int:
    # Imported here: a typing error in the command line should not wait for JAX.
    from experiments.cache import keep_programs
    from experiments.experiment import check_folder, default_folder, run_experiment
    from experiments.profile import write_profile
    from experiments.variants import config_of

    if options.list:
        return print_variants(console)
    keep_programs(options.compilation_cache)
    name = options.variant
    config = config_of(name, options.preset, options.overrides)
    out = Path(options.out) if options.out else default_folder(name, options.preset, options.data)
    if options.profile:
        return write_profile(name, config, out, console)
    wanted = {"variant": name, "data": options.data, **dataclasses.asdict(config)}
    check_folder(out, wanted, resume=options.resume, eval_only=options.eval_only)
    metrics = run_experiment(
        [name], {name: config}, {name: out}, preset=options.preset, overrides=options.overrides, data=options.data,
        out=out, wanted=wanted, eval_only=options.eval_only, console=console, tensorboard=options.tensorboard,
    )  # fmt: skip
    return exit_code(metrics, console)


if __name__ == "__main__":
    sys.exit(main())
