"""The table that the terminal and the page share: which rows, in which order, what is best."""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple


class Column(NamedTuple):
    """One metric of the table.

    Attributes:
      key: name in ``metrics.json``.
      label: heading.
      digits: decimals.
      scale: factor from the stored to the shown number.
      best: "high", "low" or "zero" (nearest to zero).
      help: one line for a reader who asks.
    """

    key: str
    label: str
    digits: int
    scale: float
    best: str
    help: str


COLUMNS = (
    Column("psnr", "PSNR", 2, 1.0, "high", "dB after x / (1 + x) and sRGB, data range 1; mean of the frames' PSNRs"),
    Column("ssim", "SSIM", 4, 1.0, "high", "Gaussian window 11, sigma 1.5, C1 = 0.01², C2 = 0.03²"),
    Column("psnr_holes", "holes", 2, 1.0, "high", "PSNR (dB) on disoccluded pixels only"),
    Column("tpsnr", "tPSNR", 2, 1.0, "high",
           "PSNR (dB) of the change over two frames, of the same kind in every schedule; high = no more flicker than "
           "the reference"),
    Column("warped_error", "Δwarp", 2, 1e3, "zero",
           "10³ · mean |I_t − warp(I_t−2)| minus the reference's own: + flickers, − is smoother than the truth"),
)  # fmt: skip

KIND_NAMES = {"ss": "rendered (SS)", "ess": "extrapolated (ESS)", "all": "all frames"}
RESOLUTION_NAMES = {"hr": "High resolution, against the anti-aliased reference",
                    "lr": "Low resolution, against the frame's own aliased colour"}  # fmt: skip


class Cell(NamedTuple):
    """A formatted number; ``best`` where no comparable method is better."""

    text: str
    best: bool


class Line(NamedTuple):
    """One method's line: cells by kinds, then columns; ``remark`` where it is not comparable or not finite."""

    method: str
    cells: list[Cell]
    remark: str


class Table(NamedTuple):
    """Scores at one resolution of one sequence (or "mean"), ``COLUMNS`` per kind; the title says against what."""

    title: str
    sequence: str
    kinds: list[str]
    lines: list[Line]


def shown_value(row: Mapping[str, Any] | None, column: Column) -> float | None:
    """Return the number that a cell shows, or None; of the warped error what goes beyond the reference's own."""
    value = None if row is None else row.get(column.key)
    if row is None or value is None:
        return None
    if column.key == "warped_error":
        value -= row.get("warped_error_reference") or 0.0
    return value * column.scale


def _text(value: float | None, row: Mapping[str, Any] | None, column: Column) -> str:
    if value is None or row is None:
        return "–"
    text = f"{value:+.{column.digits}f}" if column.best == "zero" else f"{value:.{column.digits}f}"
    spread = row.get(f"{column.key}_range")  # over seeds
    return text if spread is None else f"{text} ±{spread * column.scale:.{column.digits}f}"


def _best(values: list[float | None], rule: str) -> float | None:
    known = [value for value in values if value is not None]
    if len(known) < 2:  # the best of one is no news
        return None
    key = {"high": lambda v: v, "low": lambda v: -v, "zero": lambda v: -abs(v)}[rule]
    return max(known, key=key)


def sequences(metrics: Mapping[str, Any]) -> list[str]:
    """Names of the sequences in the order of the rows, "mean" first."""
    names = dict.fromkeys(row["sequence"] for row in metrics["rows"])
    return sorted(names, key=lambda name: name != "mean")


def make_table(
    metrics: Mapping[str, Any], resolution: str, sequence: str, references: Mapping[str, str] | None = None
) -> Table:
    """Make the table of one resolution and one sequence.

    Methods come best first (PSNR on extrapolated frames, else on rendered ones), those in ``references`` last.

    Args:
      metrics: the content of ``metrics.json``.
      resolution: "lr" or "hr".
      sequence: a sequence's name or "mean".
      references: methods that are shown for orientation and are never marked best, with the reason why.
    """
    references = references or {}
    rows = {
        (row["method"], row["frames"]): row
        for row in metrics["rows"]
        if row["resolution"] == resolution and row["sequence"] == sequence
    }
    present = {kind for _, kind in rows}
    kinds = [kind for kind in ("ss", "ess") if kind in present] or sorted(present)
    methods = dict.fromkeys(method for method, _ in rows)
    methods = sorted(methods, key=lambda method: (method in references, -_quality(rows, method, kinds)))
    columns = [(kind, column) for kind in kinds for column in COLUMNS]
    values = {(m, k, c.key): shown_value(rows.get((m, k)), c) for m in methods for k, c in columns}
    comparable = [method for method in methods if method not in references]
    best = {(k, c.key): _best([values[m, k, c.key] for m in comparable], c.best) for k, c in columns}
    lines = []
    for method in methods:
        cells = []
        for kind, column in columns:
            value = values[method, kind, column.key]
            marked = value is not None and method in comparable and value == best[kind, column.key]
            cells.append(Cell(_text(value, rows.get((method, kind)), column), marked))
        spoiled = sum((rows.get((method, kind)) or {}).get("non_finite", 0) for kind in kinds)
        lost = f"NaN or infinity in or before {spoiled} frames: no mean of what they spoil" if spoiled else ""
        lines.append(Line(method, cells, "; ".join(filter(None, (references.get(method), lost)))))
    shares = [row["hole_share"] for row in rows.values() if row.get("hole_share") is not None]
    holes = f" (holes: {100 * sum(shares) / len(shares):.1f} % of the pixels)" if shares else ""
    return Table(RESOLUTION_NAMES[resolution] + holes, sequence, kinds, lines)


class RateTable(NamedTuple):
    """PSNR by distance to the rendered frame at one rate: heads of the columns, method -> its cells."""

    title: str
    heads: list[str]
    lines: dict[str, list[str]]


def rate_tables(metrics: Mapping[str, Any]) -> list[RateTable]:
    """Make a table of each resolution and rate; none where frames were rendered at 1:2 alone, for the others show that.

    Methods come in the order of their farthest frames.
    """
    rows = metrics.get("rates") or []
    rates = sorted({row["rate"] for row in rows})
    if rates in ([], [2]):
        return []
    tables = []
    for resolution, rate in itertools.product(resolutions({"rows": rows}), rates):
        found = {
            (row["method"], row["distance"]): row["psnr"]
            for row in rows
            if (row["resolution"], row["rate"]) == (resolution, rate) and row.get("psnr") is not None
        }
        distances = sorted({distance for _, distance in found})
        methods = sorted(
            dict.fromkeys(method for method, _ in found),
            key=lambda method: [-found.get((method, distance), 0.0) for distance in reversed(distances)],
        )
        lines = {
            method: [f"{found[method, d]:.2f}" if (method, d) in found else "–" for d in distances]
            for method in methods
        }
        title = f"One frame in {rate} rendered, {resolution.upper()}: PSNR (dB) by frames since the rendered one"
        tables.append(RateTable(title, [f"+{distance}" if distance else "SS" for distance in distances], lines))
    return tables


def _quality(rows: Mapping[tuple[str, str], Mapping[str, Any]], method: str, kinds: list[str]) -> float:
    """Return what methods are sorted by."""
    for kind in reversed(kinds):
        value = rows.get((method, kind), {}).get("psnr")
        if value is not None:
            return value
    return -1.0


def resolutions(metrics: Mapping[str, Any]) -> list[str]:
    """List the resolutions that were scored, "hr" first."""
    present = {row["resolution"] for row in metrics["rows"]}
    return [name for name in ("hr", "lr") if name in present]


def headline(metrics: Mapping[str, Any], references: Mapping[str, str] | None = None) -> str:
    """One sentence: what the variant reached, and how far the best other method on the same terms is from it."""
    references = references or {}
    variant, parts = metrics["variant"], []
    for resolution in resolutions(metrics):
        for kind in ("ss", "ess"):
            scores = {
                row["method"]: row["psnr"]
                for row in metrics["rows"]
                if (row["resolution"], row["frames"], row["sequence"]) == (resolution, kind, "mean")
                and row.get("psnr") is not None
            }
            if variant not in scores:
                continue
            part = f"{scores[variant]:.2f} dB on {KIND_NAMES[kind].split(' (')[0]} frames"
            terms = references.get(variant)
            others = {m: v for m, v in scores.items() if m != variant and references.get(m) == terms}
            if others:
                rival = max(others, key=others.__getitem__)
                part += f" ({scores[variant] - others[rival]:+.2f} against {rival})"
            parts.append(part)
        if parts:
            break  # the headline is about one resolution; the tables have both
    return f"{variant}: {', '.join(parts)}." if parts else f"Results of {variant}."
