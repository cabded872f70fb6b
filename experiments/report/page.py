"""``write_report``: one self-contained page and the PNG sheets next to it."""

import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from essjax.files import atomic
from experiments.report import images as pixels
from experiments.report.learning import learning_section
from experiments.report.pictures import Picture, make_picture
from experiments.report.rows import (
    COLUMNS,
    KIND_NAMES,
    RateTable,
    Table,
    headline,
    make_table,
    rate_tables,
    resolutions,
    sequences,
)
from experiments.report.sheets import sheet_name, write_sheet

PAGE_BYTES = 12_000_000
SHEET_BYTES = 7_000_000
"""Page and sheets together stay below 20 MB; pictures that do not fit are left out, and the page says so."""

Curves = Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]]


def write_report(
    out_dir: str | Path,
    metrics: Mapping[str, Any],
    *,
    curves: Curves | None = None,
    pictures: Sequence[Mapping[str, Any]] = (),
    notes: Sequence[str] = (),
    references: Mapping[str, str] | None = None,
    training: Mapping[str, Mapping[str, Any]] | None = None,
) -> Path:
    """Write ``out_dir/report/index.html`` (works offline, in any browser) and ``out_dir/report/sheets/*.png``.

    Args:
      out_dir: the run's folder.
      metrics: the content of ``metrics.json``: ``{"schema": 1, "variant", "preset", "dataset", "environment",
        "seconds", "rows": [{"method", "sequence" (or "mean"), "frames": "ss"|"ess"|"all", "resolution": "lr"|"hr",
        metrics ...}]}``; ``"<metric>_range"`` in a row is shown as "±".
      curves: method -> sequence -> one entry per frame and kind, ``{"frame", "kind", "resolution", metrics ...}``.
      pictures: ``{"sequence", "frame", "kind", "resolution", "images": {name: [H, W, 3] linear HDR}, "previous": the
        same of the frame two before (optional, for flicker), "exposure": what they are multiplied with before they are
        shown (optional, 1)}``; the images hold "reference" and, if wanted, "input". Most interesting first: what does
        not fit the size limit is left out from the end.
      notes: remarks to the reader, one paragraph each.
      references: methods shown for orientation, never marked best, with the reason.
      training: how each stage learned, see ``learning_section``.

    Returns:
      The path of the page.

    Raises:
      ValueError: a picture lacks a key or its reference, or an image has the wrong shape.
    """
    folder = Path(out_dir) / "report"
    sheets = folder / "sheets"
    sheets.mkdir(parents=True, exist_ok=True)
    for stale in sheets.glob("*.png"):
        stale.unlink()
    chosen = [make_picture(entry) for entry in pictures]
    data, left_out = _page_pictures(chosen)
    notes = list(notes)
    if left_out:
        notes.append(f"{left_out} of {len(chosen)} pictures were left out to keep this page small.")
    _write_sheets(sheets, chosen)
    path = folder / "index.html"
    with atomic(path) as temporary:
        text = _page(metrics, curves or {}, data, notes, references or {}, training or {})
        temporary.write_text(text, encoding="utf-8")
    return path


def _page_pictures(pictures: Sequence[Picture]) -> tuple[list[dict], int]:
    """Prepare as many pictures for the page's script as fit, and count those that did not."""
    data, size = [], 0
    for picture in pictures:
        entry = _page_picture(picture)
        size += sum(len(image["src"]) + len(image["flicker"] or "") for image in entry["images"])
        if size > PAGE_BYTES:
            break
        data.append(entry)
    return data, len(pictures) - len(data)


def _page_picture(picture: Picture) -> dict[str, Any]:
    height, width = picture.images["reference"].shape[:2]
    high, wide = pixels.crop_size(height, width)
    images = []
    for name, image in picture.images.items():
        known = name in picture.previous and name != "reference"
        flicker = pixels.to_bytes(picture.flicker(name) * pixels.FLICKER_GAIN) if known else None
        images.append({
            "name": name, "src": pixels.data_uri(pixels.to_bytes(image)), "psnr": picture.scores.get(name),
            "flicker": None if flicker is None else pixels.data_uri(flicker),
        })  # fmt: skip
    return {
        "sequence": picture.sequence, "frame": picture.frame, "kind": picture.kind, "resolution": picture.resolution,
        "width": width, "height": height, "focus": picture.focus, "crop": [wide, high], "images": images,
    }  # fmt: skip


def _write_sheets(folder: Path, pictures: Sequence[Picture]) -> None:
    size = 0
    for picture in pictures:
        path = folder / sheet_name(picture)
        write_sheet(path, picture)
        size += path.stat().st_size
        if size > SHEET_BYTES:
            path.unlink()
            break


def _page(
    metrics: Mapping[str, Any],
    curves: Curves,
    pictures: list[dict],
    notes: list[str],
    references: Mapping[str, str],
    training: Mapping[str, Mapping[str, Any]],
) -> str:
    data = {
        "variant": metrics["variant"], "curves": _round(curves), "pictures": pictures, "references": list(references),
        "columns": [column._asdict() for column in COLUMNS], "kinds": KIND_NAMES,
        "colormap": pixels.color_map().tolist(), "errorGain": pixels.ERROR_GAIN, "flickerGain": pixels.FLICKER_GAIN,
    }  # fmt: skip
    tables = [
        make_table(metrics, resolution, sequence, references)
        for sequence in sequences(metrics)
        for resolution in resolutions(metrics)
    ]
    help_lines = [f"<dt>{html.escape(c.label)}</dt><dd>{html.escape(c.help)}</dd>" for c in COLUMNS]
    options = [f"<option>{html.escape(name)}</option>" for name in sequences(metrics)]
    parts = {
        "title": html.escape(f"{metrics['variant']} · {metrics['dataset']}"),
        "variant": html.escape(str(metrics["variant"])),
        "dataset": html.escape(str(metrics["dataset"])),
        "headline": html.escape(headline(metrics, references)),
        "facts": "".join(_fact(name, value) for name, value in _facts(metrics)),
        "notes": "".join(f"<p>{html.escape(note)}</p>" for note in notes),
        "sequences": "".join(options),
        "tables": "\n".join(
            [*(_table(table) for table in tables if table.lines), *(_rates(table) for table in rate_tables(metrics))]
        ),
        "help": "".join(help_lines),
        "learning": learning_section(training),
        "costs": _costs(metrics.get("costs") or {}),
        # A "</script>" inside the data would end the element that holds it.
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "style": _asset("style.css"),
        "script": "\n".join(_asset(name) for name in ("viewer.js", "curves.js", "page.js")),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], _asset("template.html"))


def _asset(name: str) -> str:
    return resources.files("experiments.report").joinpath(name).read_text(encoding="utf-8")


def _round(value: Any) -> Any:
    """Numbers to six digits and anything that is no JSON (NaN, NumPy scalars) made so; the page gets smaller."""
    if isinstance(value, Mapping):
        return {str(key): _round(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_round(item) for item in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    number = float(value)
    return round(number, 6) if abs(number) < float("inf") else None


def _facts(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Say what made these numbers: preset, environment, times."""
    environment = dict(metrics.get("environment") or {})
    overrides = " ".join(metrics.get("overrides") or ())
    facts = [("preset", f"{metrics.get('preset', '–')} {overrides}".rstrip())]
    for name, value in environment.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {item}" for key, item in value.items())
        elif name == "commit":
            value = str(value)[:12]
        facts.append((name, str(value)))
    return facts + [(name, f"{value:.0f} s") for name, value in (metrics.get("seconds") or {}).items()]


def _fact(name: str, value: str) -> str:
    return f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"


def _table(table: Table) -> str:
    groups = "".join(f'<th colspan="{len(COLUMNS)}" scope="colgroup">{KIND_NAMES[kind]}</th>' for kind in table.kinds)
    labels = "".join(
        f'<th scope="col" title="{html.escape(column.help)}"{_edge(k)}>{column.label}</th>'
        for _ in table.kinds
        for k, column in enumerate(COLUMNS)
    )
    body = []
    for line in table.lines:
        cells = [
            f"<td{_edge(k % len(COLUMNS))}>{'<b>' + cell.text + '</b>' if cell.best else cell.text}</td>"
            for k, cell in enumerate(line.cells)
        ]
        remark = f"<small>{html.escape(line.remark)}</small>" if line.remark else ""
        kind = ' class="reference"' if line.remark else ""
        body.append(f'<tr{kind}><th scope="row">{html.escape(line.method)}{remark}</th>{"".join(cells)}</tr>')
    return (
        f'<figure class="scores" data-sequence="{html.escape(table.sequence)}">'
        f"<figcaption>{table.title}</figcaption><div><table><thead>"
        f'<tr><th rowspan="2" scope="col">method</th>{groups}</tr><tr>{labels}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div></figure>"
    )


def _rates(table: RateTable) -> str:
    heads = "".join(f'<th scope="col">{head}</th>' for head in table.heads)
    body = "".join(
        f'<tr><th scope="row">{html.escape(method)}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for method, cells in table.lines.items()
    )
    return (
        f'<figure class="scores"><figcaption>{table.title}</figcaption><div><table><thead>'
        f'<tr><th scope="col">method</th>{heads}</tr></thead><tbody>{body}</tbody></table></div></figure>'
    )


def _costs(costs: Mapping[str, Mapping[str, Any]]) -> str:
    """Show what each method costs, as a table; nothing where it is not known."""
    if not costs:
        return ""
    body = []
    for method, cost in costs.items():
        work = [cost["multiply_adds"].get(kind) for kind in ("ss", "ess")]
        cells = [f"{cost['parameters']:,}", *("–" if w is None else f"{w / 1e9:.3f}" for w in work), cost["latency"]]
        body.append(
            f'<tr><th scope="row">{html.escape(method)}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        )
    heads = "".join(
        f'<th scope="col">{name}</th>'
        for name in ("method", "parameters", "10⁹ multiply-adds, SS", "ESS", "later frames needed")
    )
    return (
        '<figure class="scores"><figcaption>Cost per frame at this size</figcaption><div><table><thead>'
        f"<tr>{heads}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
        '<p class="lead">Convolutions and matrix products only; warps are not counted.</p></figure>'
    )


def _edge(column: int) -> str:
    return ' class="edge"' if column == 0 else ""
