"""The report of a run: a table on the terminal, a self-contained page, PNG sheets."""

from experiments.report.page import write_report
from experiments.report.table import print_table

__all__ = ["print_table", "write_report"]
