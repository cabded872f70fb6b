"""``python -m experiments.tables [NAME ...]``: rebuild tables of the papers on our scenes, side by side with theirs."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from experiments.run import Options, guarded, parse_as


@dataclasses.dataclass(frozen=True)
class TablesOptions(Options):
    """Train what stands behind the papers' tables and fill them in."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME ...")] = ()
    """tables; all if none is named; --list shows them"""


def parse(arguments: Sequence[str] | None = None) -> TablesOptions:
    """Parse the command line."""
    return parse_as(TablesOptions, "tables", arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, Ctrl-C 130, SIGTERM 143."""
    options = parse(arguments)
    return guarded(lambda console: _tables(options, console))


def _tables(options: TablesOptions, console: Console) -> int:
    # Imported here: a typing error in the command line should not wait for JAX.
    from essjax.data.json_files import write_json
    from essjax.files import atomic
    from experiments import tables

    if options.list:
        for name, table in tables.TABLES.items():
            console.print(f"  [bold]{name:<12}[/bold] {table.title} ({table.source})", soft_wrap=True)
        return 0
    chosen = [tables.get_table(name) for name in dict.fromkeys(options.names or tables.TABLES)]
    out = Path(options.out or f"runs/tables-{options.preset}")
    results: dict[str, Any] = {"schema": 1, "kind": "tables", "preset": options.preset, "runs": [], "tables": {}}
    for number, same in enumerate(dict.fromkeys((table.settings, table.half_input) for table in chosen)):
        group = [table for table in chosen if (table.settings, table.half_input) == same]
        run, filled = _fill(group, options, out / f"group-{number}", console)
        results["runs"].append(run)
        results["tables"] |= filled
        write_json(out / "tables.json", results)  # an interrupted command leaves what is finished
    page = "\n".join(tables.markdown(table, results["tables"][table.name]) for table in chosen)
    with atomic(out / "tables.md") as temporary:
        temporary.write_text(page)
    console.print(page, soft_wrap=True, highlight=False)
    console.print(f"tables: {out / 'tables.md'}, numbers: {out / 'tables.json'}", soft_wrap=True)
    return 0


def _fill(group: list, options: TablesOptions, out: Path, console: Console) -> tuple[dict, dict]:
    """One comparison for all tables with the same settings: what was run, and table -> row -> metric -> number."""
    from essjax.deploy import method_cost
    from experiments import tables
    from experiments.members import settings_of
    from experiments.variants import VARIANTS

    names = list(dict.fromkeys(name for table in group for name in tables.variants(table)))
    settings = [*group[0].settings, *(_halved(options.preset) if group[0].half_input else [])]
    costs = {}
    for table in group:
        if any((metric.key or "").startswith("cost.") for metric in table.metrics.values()):
            for name in tables.variants(table):
                method = VARIANTS[name].method(settings_of(name, "paper", table.settings))
                costs[name] = method_cost(method, 1280, 720)
    metrics = options.run(names, out, console, settings)
    keys = ("dataset", "environment", "seconds")
    return (
        {
            "tables": [table.name for table in group],
            "settings": [*settings, *options.overrides],
            **{key: metrics[key] for key in keys},
        },
        {table.name: tables.measured(table, metrics, costs) for table in group},
    )


def _halved(preset: str) -> list[str]:
    """Half the preset's size and crop, no smaller than a crop may be."""
    from experiments.settings import COMMON, PRESETS
    from experiments.training import MIN_CROP

    sizes = {path: COMMON[path][PRESETS.index(preset)] for path in ("data.size", "stages.crop")}
    return [
        f"{path}=[{max(width // 2, MIN_CROP)},{max(height // 2, MIN_CROP)}]" for path, (width, height) in sizes.items()
    ]


if __name__ == "__main__":
    sys.exit(main())
