"""``python -m experiments.tables [NAME ...]``: rebuild tables of the papers on our scenes, side by side with theirs."""

import argparse
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.run import guarded, shared_options


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        "python -m experiments.tables", description="Train what stands behind the papers' tables and fill them in."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="tables; all if none is named; --list shows them")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: runs/tables-PRESET)")
    shared_options(parser)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2, a signal 130."""
    options = parse(arguments)
    return guarded(lambda console: _tables(options, console))


def _tables(options: argparse.Namespace, console: Console) -> int:
    # Imported here: a typing error in the command line should not wait for JAX.
    from experiments import tables
    from experiments.cache import keep_programs
    from experiments.experiment import write_json

    if options.list:
        for name, table in tables.TABLES.items():
            console.print(f"  [bold]{name:<12}[/bold] {table.title} ({table.source})", soft_wrap=True)
        return 0
    keep_programs(options.compilation_cache)
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
    (out / "tables.md").write_text(page)
    console.print(page, soft_wrap=True, highlight=False)
    console.print(f"tables: {out / 'tables.md'}, numbers: {out / 'tables.json'}", soft_wrap=True)
    return 0


def _fill(group: list, options: argparse.Namespace, out: Path, console: Console) -> tuple[dict, dict]:
    """One comparison for all tables with the same settings: what was run, and table -> row -> metric -> number."""
    from essjax.deploy import method_cost
    from experiments import tables
    from experiments.compare import compare
    from experiments.variants import VARIANTS, config_of

    names = list(dict.fromkeys(name for table in group for name in tables.variants(table)))
    overrides = [*group[0].settings, *(_halved(options.preset) if group[0].half_input else []), *options.overrides]
    costs = {}
    for table in group:
        if any((metric.key or "").startswith("cost.") for metric in table.metrics.values()):
            for name in tables.variants(table):
                method = VARIANTS[name].method(config_of(name, "paper", list(table.settings)))
                costs[name] = method_cost(method, 1280, 720)
    metrics = compare(
        names, preset=options.preset, overrides=overrides, data=options.data, out=out, resume=options.resume,
        eval_only=options.eval_only, console=console, tensorboard=options.tensorboard,
    )  # fmt: skip
    keys = ("dataset", "environment", "seconds")
    return (
        {"tables": [table.name for table in group], "settings": overrides, **{key: metrics[key] for key in keys}},
        {table.name: tables.measured(table, metrics, costs) for table in group},
    )


def _halved(preset: str) -> list[str]:
    """Half the preset's size and crop, no smaller than a crop may be."""
    from experiments.config import make_config
    from experiments.training import MIN_CROP

    config = make_config(preset, [])
    sizes = {key: [max(n // 2, MIN_CROP) for n in getattr(config, key)] for key in ("size", "crop")}
    return [f"{key}=[{width},{height}]" for key, (width, height) in sizes.items()]


if __name__ == "__main__":
    sys.exit(main())
