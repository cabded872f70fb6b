"""Findings: a verdict, why, and what to do about it."""

import dataclasses
from collections.abc import Iterable, Mapping

VERDICTS = ("ok", "not decidable", "warning", "wrong")
"""From harmless to harmful. "not decidable": the data cannot tell (no motion, no jitter, no such buffer)."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One row of the table.

    Attributes:
      check: its name.
      verdict: one of ``VERDICTS``.
      found: what was measured, one sentence.
      fix: what to change; empty if nothing is to be done.
      numbers: the measurement, JSON types.
    """

    check: str
    verdict: str
    found: str
    fix: str = ""
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)


def some(items: Iterable, limit: int = 4) -> str:
    """List a few: ``"a, b, c, d and 3 more"``."""
    names = [str(item) for item in items]
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
