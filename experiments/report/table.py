"""The result table on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from experiments.report.rows import COLUMNS, Table, headline, make_table, rate_tables, resolutions


def print_table(
    metrics: Mapping[str, Any],
    *,
    references: Mapping[str, str] | None = None,
    sequence: str = "mean",
    console: Console | None = None,
) -> None:
    """Print the rows that the page shows, one table per resolution; the best comparable number of a column is bold.

    Args:
      metrics: the content of ``metrics.json``.
      references: methods shown for orientation only, with the reason why (printed below the table).
      sequence: a sequence's name or "mean".
      console: where to print; the terminal if None.
    """
    console = console or Console()
    unlimited = console.options.update(width=1000)
    for resolution in resolutions(metrics):
        table = make_table(metrics, resolution, sequence, references)
        if not table.lines:
            continue
        for count in range(len(COLUMNS), 0, -1):  # the widest that fits: cut numbers help nobody
            grid = _grid(table, count)
            if console.measure(grid, options=unlimited).maximum <= console.width:
                break
        console.print(table.title, style="bold", highlight=False)
        console.print(grid)
        for line in table.lines:
            if line.remark:
                console.print(f"* {line.method}: {line.remark}", style="dim", highlight=False)
    for rates in rate_tables(metrics):
        grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False)
        grid.add_column("method", no_wrap=True)
        for head in rates.heads:
            grid.add_column(head, justify="right", no_wrap=True)
        for method, cells in rates.lines.items():
            grid.add_row(method, *cells)
        console.print(rates.title, style="bold", highlight=False)
        console.print(grid)
    console.print(headline(metrics, references), highlight=False)


def _grid(table: Table, count: int) -> RichTable:
    """Make the table with the first ``count`` metrics of every kind."""
    grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False)
    grid.add_column("method", no_wrap=True)
    for kind in table.kinds:
        for column in COLUMNS[:count]:
            grid.add_column(f"{kind.upper()}\n{column.label}", justify="right", no_wrap=True)
    for line in table.lines:
        name = f"{line.method} *" if line.remark else line.method
        chosen = [cell for k, cell in enumerate(line.cells) if k % len(COLUMNS) < count]
        cells = [Text(cell.text, style="bold green" if cell.best else "") for cell in chosen]
        grid.add_row(Text(name, style="dim" if line.remark else ""), *cells)
    return grid
