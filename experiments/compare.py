"""``python -m experiments.compare --variants a,b,c``: train several variants on the same data, one table and report.

Variants that only differ in their steps share one training. Each trains in ``OUT/variants/NAME``, with its own settings
of the preset; an interrupted comparison resumes in the middle of a variant.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from experiments.run import Options, exit_code, guarded, parse_as, print_variants


@dataclasses.dataclass(frozen=True)
class CompareOptions(Options):
    """Train several variants on the same frames, evaluate all side by side, write one report."""

    variants: Annotated[str, tyro.conf.arg(metavar="A,B,C")] = ""
    """names, separated by commas; --list shows all"""


def parse(arguments: Sequence[str] | None = None) -> CompareOptions:
    """Parse the command line."""
    return parse_as(CompareOptions, "compare", arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns 2 after a line about bad input, 130 or 143 after a signal, 1 for a dead network."""
    options = parse(arguments)
    return guarded(lambda console: _compare(options, console))


def _compare(options: CompareOptions, console: Console) -> int:
    from experiments.request import default_folder

    if options.list:
        return print_variants(console)
    names = list(dict.fromkeys(name.strip() for name in options.variants.split(",") if name.strip()))
    if not names:
        raise ValueError("--variants: expected names separated by commas, got none. --list shows all.")
    out = Path(options.out) if options.out else default_folder("compare", options.preset, options.data)
    return exit_code(options.run(names, out, console), console)


if __name__ == "__main__":
    sys.exit(main())
