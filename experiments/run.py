"""``python -m experiments.run --variant NAME``: render or read data, train, evaluate against baselines, report."""

import dataclasses
import itertools
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.text import Text

from experiments.settings import PRESETS

Folder = Annotated[str | None, tyro.conf.arg(metavar="DIR")]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options that ``run``, ``compare`` and ``tables`` have in common."""

    data: Folder = None
    """an essjax dataset; without it the built-in scenes are rendered"""
    preset: Annotated[str, tyro.conf.arg(help=f"one of {', '.join(PRESETS)}")] = "quick"
    set: Annotated[tuple[tuple[str, ...], ...], tyro.conf.arg(metavar="PATH=VALUE ..."), tyro.conf.UseAppendAction] = ()
    """settings, such as method.width=24 frnet.seconds=60, of one variant alone VARIANT:PATH=VALUE"""
    resume: bool = False
    """continue an interrupted run in --out"""
    eval_only: bool = False
    """evaluate the checkpoint in --out, no training"""
    tensorboard: bool = False
    """write TensorBoard events (needs tensorboardX)"""
    list: bool = False
    """list what can be named and stop"""
    compilation_cache: bool = True
    """compile everything anew instead of keeping programs in ~/.cache/essjax"""
    out: Folder = None
    """where results go; without it runs/NAME-PRESET[-DATA]"""

    @property
    def overrides(self) -> tuple[str, ...]:
        """Return those of all ``--set``."""
        return tuple(itertools.chain(*self.set))

    def run(self, names: Sequence[str], out: Path, console: Console, more: Sequence[str] = ()) -> dict[str, Any]:
        """Train and evaluate ``names`` in ``out``, with ``more`` settings before those of the command line."""
        # Imported here, as below: a typing error in the command line should not wait for JAX.
        from experiments.cache import keep_programs
        from experiments.experiment import run_experiment
        from experiments.request import Request

        keep_programs(self.compilation_cache)
        overrides = (*more, *self.overrides)
        request = Request(
            tuple(names), self.preset, overrides, self.data, out, self.resume, self.eval_only, self.tensorboard
        )
        return run_experiment(request, console)


@dataclasses.dataclass(frozen=True)
class RunOptions(Options):
    """Train a variant, evaluate it against baselines, write a report."""

    variant: str = "extrass"
    """what to run; --list shows all"""
    profile: bool = False
    """write a JAX profiler trace of train and streaming steps"""


def parse_as(kind: type, command: str, arguments: Sequence[str] | None) -> Any:
    """Parse the command line of ``python -m experiments.COMMAND`` as a ``kind``."""
    return tyro.cli(
        kind, prog=f"python -m experiments.{command}", args=arguments, config=(tyro.conf.FlagCreatePairsOff,)
    )


def parse(arguments: Sequence[str] | None = None) -> RunOptions:
    """Parse the command line."""
    return parse_as(RunOptions, "run", arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns 2 after a line about bad input, 130 or 143 after a signal, 1 for a dead network."""
    options = parse(arguments)
    return guarded(lambda console: _run(options, console))


def guarded(command: Callable[[Console], int], again: str = "Run the same command with --resume to continue.") -> int:
    """Run ``command``; returns 2 after a line about bad input, 130 (Ctrl-C) or 143 (SIGTERM) and ``again``."""
    from essjax.stopping import stoppable

    console = Console()

    def waiting() -> None:
        console.print("Stopping after this step; once more to stop at once.", soft_wrap=True)

    def stopped(text: str = "") -> None:
        console.show_cursor()  # progress bars hide it
        console.print(Text.assemble(("Stopped:" if text else "Stopped.", "red"), f" {text or again}"), soft_wrap=True)

    def checked() -> int:
        if os.environ.get("JAX_PLATFORMS"):
            from essjax.kernels import check_platform

            check_platform()
        return command(console)

    try:
        return stoppable(checked, waiting, stopped)
    except (ValueError, RuntimeError, OSError) as error:
        print_error(error, console)
        return 2
    except KeyboardInterrupt:
        stopped()
        return 130


def print_error(error: Exception, console: Console) -> None:
    """One line; brackets in the message are no markup."""
    hint = " Is it the right path, may it be used, is the disk full?" if isinstance(error, OSError) else ""
    text = " ".join(str(error).splitlines())
    console.print(Text.assemble(("Error:", "red"), f" {text}{hint}"), soft_wrap=True)


def exit_code(metrics: Mapping[str, Any], console: Console) -> int:
    """0, or 1 after a last line for each dead network of a run."""
    for text in metrics["dead"]:
        console.print(Text.assemble(("Dead network:", "red"), f" {text}"), soft_wrap=True)
    return 1 if metrics["dead"] else 0


def print_variants(console: Console) -> int:
    """Print what ``--list`` asks for."""
    from experiments.variants import VARIANTS

    width = max(len(name) for name in VARIANTS)
    for name, variant in VARIANTS.items():
        console.print(f"  [bold]{name:<{width}}[/bold] {variant.summary}", soft_wrap=True)
    return 0


def _run(options: RunOptions, console: Console) -> int:
    from experiments.request import default_folder

    if options.list:
        return print_variants(console)
    name = options.variant
    out = Path(options.out) if options.out else default_folder(name, options.preset, options.data)
    if options.profile:
        from experiments.profile import write_profile

        return write_profile(name, options.preset, options.overrides, out, console)
    return exit_code(options.run([name], out, console), console)


if __name__ == "__main__":
    sys.exit(main())
