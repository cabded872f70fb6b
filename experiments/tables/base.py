"""Tables of the papers on our scenes: the paper's numbers next to ours, and whether the order of the methods holds.

The numbers are of other scenes and of longer training: only their order can be compared.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

from essjax.deploy import Cost


class Metric(NamedTuple):
    """One measured quantity of a table.

    Attributes:
      key: its name in the rows of ``metrics.json``; "cost.parameters" (millions) or "cost.multiply_adds" (10^9 per
        frame of this kind); None where it is not measured yet (VMAF, LPIPS): shown as a dash.
      frames: "ss" or "ess".
      resolution: "hr" or "lr".
      digits: decimals shown.
      low: smaller is better.
    """

    key: str | None
    frames: str = "ss"
    resolution: str = "hr"
    digits: int = 2
    low: bool = False


class Row(NamedTuple):
    """One row: a variant (None where the method is not implemented), and whose frames it is scored on if not all.

    Attributes:
      variant: a name of ``--variant``.
      frames: "ss" or "ess" where the row overrides the metric's (ExtraSS's own rows); None: the metric's.
    """

    variant: str | None
    frames: str | None = None


class Table(NamedTuple):
    """A table of a paper.

    Attributes:
      name: as on the command line, for example "extrass-1".
      title: what the paper calls it.
      source: paper and number.
      scenes: the paper's columns of one metric, one per scene or dataset.
      metrics: label -> how we measure it.
      rows: label -> what stands behind it here.
      paper: row label -> metric label -> the paper's number per scene (None: not given).
      settings: ``--set`` of the comparison behind it, beyond the preset.
      half_input: size and crop are half the preset's (4x4 upsampling to the preset's output).
      note: what a reader must know, one or two sentences.
    """

    name: str
    title: str
    source: str
    scenes: tuple[str, ...]
    metrics: Mapping[str, Metric]
    rows: Mapping[str, Row]
    paper: Mapping[str, Mapping[str, tuple[float | None, ...]]]
    settings: tuple[str, ...] = ()
    half_input: bool = False
    note: str = ""


def variants(table: Table) -> list[str]:
    """List the variants that fill a table, each once, in its order."""
    return list(dict.fromkeys(row.variant for row in table.rows.values() if row.variant))


def paper_mean(table: Table, row: str, metric: str) -> float | None:
    """Return the mean over the paper's scenes, None if it gives none."""
    values = [value for value in table.paper.get(row, {}).get(metric, ()) if value is not None]
    return sum(values) / len(values) if values else None


def measured(
    table: Table, metrics: Mapping[str, Any], costs: Mapping[str, Cost] | None = None
) -> dict[str, dict[str, float | None]]:
    """Row label -> metric label -> our number, the mean over test sequences; None where there is none.

    Args:
      table: which.
      metrics: the content of a comparison's ``metrics.json``.
      costs: variant -> its cost, for tables that show it.
    """
    means = {
        (row["method"], row["frames"], row["resolution"]): row for row in metrics["rows"] if row["sequence"] == "mean"
    }
    found: dict[str, dict[str, float | None]] = {}
    for label, row in table.rows.items():
        found[label] = {}
        for name, metric in table.metrics.items():
            line = means.get((row.variant, row.frames or metric.frames, metric.resolution), {})
            if row.variant is None or metric.key is None:
                found[label][name] = None
            elif metric.key.startswith("cost."):
                found[label][name] = _cost((costs or {}).get(row.variant), metric)
            else:
                found[label][name] = line.get(metric.key)
    return found


def _cost(cost: Cost | None, metric: Metric) -> float | None:
    if cost is None:
        return None
    if metric.key == "cost.parameters":
        return cost.parameters / 1e6
    return cost.multiply_adds.get(metric.frames, 0) / 1e9


class Agreement(NamedTuple):
    """How many pairs of rows stand in the paper's order, and which do not: (better there, better here)."""

    same: int
    total: int
    different: list[tuple[str, str]]


def agreement(table: Table, ours: Mapping[str, Mapping[str, float | None]], metric: str) -> Agreement:
    """Compare the order of all pairs of rows that have both numbers; the paper's ties are left out."""
    sign = -1.0 if table.metrics[metric].low else 1.0
    scores = {}
    for label in table.rows:
        theirs, mine = paper_mean(table, label, metric), ours[label][metric]
        if theirs is not None and mine is not None:
            scores[label] = (sign * theirs, sign * mine)
    same, total, different = 0, 0, []
    for a, b in itertools.combinations(scores, 2):
        if scores[a][0] == scores[b][0]:
            continue
        better, worse = (a, b) if scores[a][0] > scores[b][0] else (b, a)
        total += 1
        if scores[better][1] > scores[worse][1]:
            same += 1
        else:
            different.append((better, worse))
    return Agreement(same, total, different)


def verdict(table: Table, ours: Mapping[str, Mapping[str, float | None]]) -> str:
    """Say in one sentence per measured metric whether the paper's order holds."""
    sentences = []
    for name, metric in table.metrics.items():
        if metric.key is None:
            continue
        found = agreement(table, ours, name)
        if not found.total:
            continue
        if not found.different:
            sentences.append(f"{name}: the paper's order holds ({found.total} of {found.total} pairs).")
            continue
        pairs = "; ".join(f"{worse} above {better}" for better, worse in found.different)
        sentences.append(f"{name}: {found.same} of {found.total} pairs in the paper's order; here {pairs}.")
    return " ".join(sentences) or "Nothing to compare: fewer than two rows have numbers on both sides."


def markdown(table: Table, ours: Mapping[str, Mapping[str, float | None]]) -> str:
    """Write the table: per metric the paper's scenes, their mean, and ours; then the verdict."""
    several = len(table.scenes) > 1
    heads = []
    for name in table.metrics:
        heads += [f"{name} {scene}".strip() for scene in table.scenes] + ([f"{name} mean"] if several else [])
        heads.append(f"**{name} ours**")
    lines = [f"### {table.name}: {table.title}", "", f"{table.source}. {table.note}".strip(), ""]
    lines += ["| | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for label, row in table.rows.items():
        cells = []
        for name, metric in table.metrics.items():
            given = table.paper.get(label, {}).get(name, (None,) * len(table.scenes))
            cells += [_number(value, metric.digits) for value in given]
            cells += [_number(paper_mean(table, label, name), metric.digits)] if several else []
            value = ours[label][name]
            cells.append("–" if value is None else f"**{_number(value, metric.digits)}**")
        name = f"{label} (`{row.variant}`)" if row.variant else f"{label} (not implemented)"
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", verdict(table, ours), ""])


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def check(table: Table) -> None:
    """Raise a ValueError where the literal does not fit itself: rows, metrics or the number of scenes."""
    for label, metrics in table.paper.items():
        if label not in table.rows:
            raise ValueError(f"{table.name}: the paper's row {label!r} is not among {', '.join(table.rows)}.")
        for name, values in metrics.items():
            if name not in table.metrics or len(values) != len(table.scenes):
                raise ValueError(
                    f"{table.name}, {label}, {name}: expected one of {', '.join(table.metrics)} with "
                    f"{len(table.scenes)} numbers, got {len(values)}."
                )
