"""How training went: loss and validation over steps, as figures of the page that need no script."""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

WIDTH, HEIGHT, LEFT, BOTTOM, MARGIN = 520, 200, 52, 26, 10
BINS = 150
"""A loss of more steps is shown as means over so many."""
Line = Sequence[tuple[float, float]]


def learning_section(training: Mapping[str, Mapping[str, Any]]) -> str:
    """Make the section of the page; empty where nothing was trained.

    Args:
      training: stage -> ``{"loss": [(step, value)], "validated": [{"step", kind: PSNR}]}``.
    """
    figures = []
    for stage, found in training.items():
        loss = binned([point for point in found["loss"] if point[1] > 0])
        if len(loss) > 1:
            figures.append(_figure(f"{stage}: loss", {"loss": loss}, log=True))
        lines = {
            kind.upper(): [(entry["step"], entry[kind]) for entry in found["validated"] if math.isfinite(entry[kind])]
            for kind in dict.fromkeys(kind for entry in found["validated"] for kind in entry if kind != "step")
        }
        if any(len(line) > 1 for line in lines.values()):
            figures.append(_figure(f"{stage}: validation, dB", lines))
    if not figures:
        return ""
    return f'<section><h2>Learning</h2><div class="learning">{"".join(figures)}</div></section>'


def binned(line: Line, bins: int = BINS) -> list[tuple[float, float]]:
    """At most ``bins`` points, each the mean of neighbours."""
    size = max(math.ceil(len(line) / bins), 1)
    parts = [line[k : k + size] for k in range(0, len(line), size)]
    return [(sum(x for x, _ in part) / len(part), sum(y for _, y in part) / len(part)) for part in parts]


def _figure(title: str, lines: Mapping[str, Line], *, log: bool = False) -> str:
    scale = math.log10 if log else float
    points = [point for line in lines.values() for point in line]
    last = max(x for x, _ in points)
    low, high = min(y for _, y in points), max(y for _, y in points)
    bottom, top = scale(low), scale(high)
    top = top if top > bottom else bottom + 1.0

    def place(x: float, y: float) -> tuple[float, float]:
        across = LEFT + x / last * (WIDTH - LEFT - MARGIN)
        return across, MARGIN + (top - scale(y)) / (top - bottom) * (HEIGHT - BOTTOM - MARGIN)

    parts = []
    for number, (name, line) in enumerate(lines.items()):
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*point) for point in line))
        parts.append(f'<polyline points="{path}" fill="none" stroke="var(--c{number})" stroke-width="2"/>')
        x, y = place(*line[-1])
        parts.append(
            f'<text x="{x - 4:.1f}" y="{y - 6:.1f}" text-anchor="end" style="fill: var(--c{number})">'
            f"{html.escape(name)}</text>"
        )
    for value in (low, high):
        y = place(0, value)[1]
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.4g}</text>')
    parts.append(f'<text x="{WIDTH - MARGIN}" y="{HEIGHT - 8}" text-anchor="end">step {last:.0f}</text>')
    return (
        f'<figure><figcaption>{html.escape(title)}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{html.escape(title)}">{"".join(parts)}</svg></figure>'
    )
