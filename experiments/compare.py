"""``python -m experiments.compare --variants a,b,c``: train several variants on the same data, one table and report."""

import argparse
import dataclasses
import sys
from pathlib import Path

from rich.console import Console

from experiments.run import exit_code, guarded, print_variants, shared_options


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        "python -m experiments.compare",
        description="Train several variants on the same frames, evaluate all side by side, write one report.",
    )
    parser.add_argument("--variants", default="", metavar="A,B,C", help="names, separated by commas; --list shows all")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: runs/compare-PRESET[-DATA])")
    shared_options(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, a signal 130, a run with a dead network 1."""
    options = parse(arguments)
    return guarded(lambda console: _compare(options, console))


def _compare(options: argparse.Namespace, console: Console) -> int:
    # Imported here: a typing error in the command line should not wait for JAX.
    from experiments.cache import keep_programs
    from experiments.experiment import default_folder

    if options.list:
        return print_variants(console)
    keep_programs(options.compilation_cache)
    names = list(dict.fromkeys(name.strip() for name in options.variants.split(",") if name.strip()))
    if not names:
        raise ValueError("--variants: expected names separated by commas, got none. --list shows all.")
    out = Path(options.out) if options.out else default_folder("compare", options.preset, options.data)
    metrics = compare(
        names, preset=options.preset, overrides=options.overrides, data=options.data, out=out, resume=options.resume,
        eval_only=options.eval_only, console=console, tensorboard=options.tensorboard,
    )  # fmt: skip
    return exit_code(metrics, console)


def compare(
    names: list[str],
    *,
    preset: str,
    overrides: list[str],
    data: str | None,
    out: Path,
    resume: bool,
    eval_only: bool,
    console: Console,
    tensorboard: bool = False,
) -> dict:
    """Train and evaluate ``names`` on the same data; returns the content of ``out / "metrics.json"``.

    Variants that only differ in their steps share one training. Each trains in ``out / "variants" / NAME``, with its
    own settings of the preset; an interrupted comparison resumes in the middle of a variant.

    Raises:
      ValueError: an unknown variant, preset or key, or ``out`` holds another run.
    """
    from experiments.experiment import check_folder, run_experiment
    from experiments.variants import config_of, trained_as

    configs = {name: config_of(name, preset, overrides) for name in names}
    folders = {name: out / "variants" / trained_as(name) for name in names}
    wanted = {"variants": names, "data": data, **{name: dataclasses.asdict(c) for name, c in configs.items()}}
    check_folder(out, wanted, resume=resume, eval_only=eval_only)
    return run_experiment(
        names, configs, folders, preset=preset, overrides=overrides, data=data, out=out, wanted=wanted,
        eval_only=eval_only, console=console, tensorboard=tensorboard,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
