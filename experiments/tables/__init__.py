"""The papers' tables that can be rebuilt on our scenes, one module per paper."""

from experiments.tables import dlctus, extranet, extrass, fasset
from experiments.tables.base import Table, check, markdown, measured, variants, verdict

_MODULES = (extrass, extranet, fasset, dlctus)
TABLES: dict[str, Table] = {table.name: table for module in _MODULES for table in module.TABLES}
"""Every table by name."""

for _table in TABLES.values():
    check(_table)


def get_table(name: str) -> Table:
    """Find the table called ``name``.

    Raises:
      ValueError: unknown; lists the valid names.
    """
    if name not in TABLES:
        raise ValueError(f"unknown table {name!r}; choose from {', '.join(TABLES)}.")
    return TABLES[name]


__all__ = ["TABLES", "Table", "get_table", "markdown", "measured", "variants", "verdict"]
