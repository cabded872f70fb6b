"""PNG sheets of class maps: what the classifier saw and what the labels say, over a dimmed reference."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from essjax.files import atomic
from experiments.report.images import shown, to_bytes
from experiments.report.sheets import GAP, INK, LABEL, MUTED, PAPER, TITLE

COLORS = {
    "visibility": (235, 70, 70), "shading": (70, 140, 255), "geometry": (250, 200, 40), "texture": (50, 205, 130),
}  # fmt: skip
"""One colour per class; pixels of none show the reference."""
WIDTH = 480
"""Width of one map, pixels."""


def class_picture(reference: np.ndarray, classes: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Classes in colours over the grey, dimmed reference, uint8 ``[H, W, 3]``.

    Args:
      reference: linear ``[H, W, 3]``.
      classes: index into ``names``, ``[H, W]``.
      names: of the classes; those without a colour show the reference.
    """
    grey = 0.55 * shown(reference).mean(axis=-1, keepdims=True)
    picture = to_bytes(np.repeat(grey, 3, axis=-1))
    for k, name in enumerate(names):
        if name in COLORS:
            picture[classes == k] = COLORS[name]
    return picture


def write_class_sheet(
    folder: Path,
    title: str,
    reference: np.ndarray,
    predicted: Mapping[str, np.ndarray],
    automatic: Mapping[str, np.ndarray],
    questions: Mapping[str, Sequence[str]],
) -> Path:
    """Write ``folder / labels-TITLE.png``: the reference, and per question predicted and automatic classes.

    Args:
      folder: the report's.
      title: of the sheet, and of its file.
      reference: linear ``[H, W, 3]``.
      predicted: question -> index ``[H, W]``.
      automatic: the same of the labels.
      questions: question -> names of the classes.
    """
    cells = [("reference", to_bytes(shown(reference)))]
    for question, names in questions.items():
        for source, classes in (("classifier", predicted), ("label", automatic)):
            cells.append((f"{question}: {source}", class_picture(reference, classes[question], names)))
    height = round(reference.shape[0] * WIDTH / reference.shape[1])
    lines = [cells[:1], *(cells[k : k + 2] for k in range(1, len(cells), 2))]
    sheet = Image.new("RGB", (GAP + 2 * (WIDTH + GAP), TITLE + len(lines) * (height + LABEL + GAP)), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, 12), title, fill=INK, font=ImageFont.load_default(20))
    for row, line in enumerate(lines):
        top = TITLE + row * (height + LABEL + GAP)
        for column, (name, picture) in enumerate(line):
            left = GAP + column * (WIDTH + GAP)
            draw.text((left, top + 3), name, fill=INK, font=ImageFont.load_default(15))
            large = Image.fromarray(picture).resize((WIDTH, height), Image.Resampling.NEAREST)
            sheet.paste(large, (left, top + LABEL))
    left, top = 2 * GAP + WIDTH, TITLE + LABEL
    for row, (name, color) in enumerate(COLORS.items()):
        draw.rectangle((left, top + 28 * row, left + 18, top + 28 * row + 18), fill=color)
        draw.text((left + 28, top + 28 * row + 1), name, fill=MUTED, font=ImageFont.load_default(15))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"labels-{re.sub(r'[^A-Za-z0-9_-]+', '-', title)}.png"
    with atomic(path) as temporary:
        sheet.save(temporary, "PNG", compress_level=4)
    return path
