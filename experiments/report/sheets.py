"""PNG sheets: every method side by side, the way a paper's figure shows them."""

import re
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from essjax.files import atomic
from experiments.report.images import ERROR_GAIN, FLICKER_GAIN, colored, crop_size, resize_nearest, to_bytes
from experiments.report.pictures import Picture

CELL = 320
"""Width of one method's column, pixels."""
COLUMNS = 6
GAP = 10
TITLE, LABEL = 44, 24
INK, MUTED, PAPER, MARK = (235, 237, 242), (150, 156, 168), (18, 20, 25), (255, 196, 61)


def sheet_name(picture: Picture) -> str:
    """File name of a picture's sheet, from sequence, frame, kind and resolution."""
    sequence = re.sub(r"[^A-Za-z0-9_-]+", "-", picture.sequence)
    return f"{sequence}_{picture.frame:04d}_{picture.kind}_{picture.resolution}.png"


def write_sheet(path: Path, picture: Picture) -> None:
    """Write one sheet: per method the frame, a magnified crop where methods disagree most, its error and its flicker.

    Args:
      path: the PNG to write.
      picture: shown images, see ``Picture``.
    """
    cells = [_cell(picture, name) for name in picture.images]
    lines = -(-len(cells) // COLUMNS)
    columns = -(-len(cells) // lines)  # lines of even length
    height = max(cell.height for cell in cells)
    sheet = Image.new("RGB", (GAP + columns * (CELL + GAP), TITLE + lines * (height + GAP)), PAPER)
    title = f"{picture.sequence}  ·  frame {picture.frame}  ·  {picture.kind.upper()}  ·  {picture.resolution.upper()}"
    _write(sheet, (GAP, 12), title, INK, 20)
    for k, cell in enumerate(cells):
        sheet.paste(cell, (GAP + k % columns * (CELL + GAP), TITLE + k // columns * (height + GAP)))
    with atomic(path) as temporary:
        sheet.save(temporary, "PNG", compress_level=4)  # optimize=True takes 10x the time for 2 % fewer bytes


def _cell(picture: Picture, name: str) -> Image.Image:
    reference = picture.images["reference"]
    height, width = reference.shape[:2]
    x, y = picture.focus
    high, wide = crop_size(height, width)
    box = (slice(y, y + high), slice(x, x + wide))
    frame = to_bytes(resize_nearest(picture.images[name], height, width))
    parts = [("", _framed(frame, picture)), ("", _magnified(frame[box]))]  # (label, part); the built-in font is ASCII
    if name != "reference":
        parts.append((f"error x{ERROR_GAIN:g}", _magnified(colored(picture.error(name)[box], ERROR_GAIN))))
        if name in picture.previous:
            parts.append((f"flicker x{FLICKER_GAIN:g}", _magnified(colored(picture.flicker(name)[box], FLICKER_GAIN))))
    cell = Image.new("RGB", (CELL, LABEL + sum(part.height + 4 for _, part in parts)), PAPER)
    _write(cell, (0, 3), name, INK, 15)
    if name in picture.scores:
        _write(cell, (CELL - 2, 3), f"{picture.scores[name]:.2f} dB", MUTED, 15, anchor="ra")
    top = LABEL
    for label, part in parts:
        cell.paste(part, (0, top))
        if label:
            ImageDraw.Draw(cell).rectangle((0, top + part.height - 20, 74, top + part.height - 1), fill=PAPER)
            _write(cell, (5, top + part.height - 18), label, INK, 13)
        top += part.height + 4
    return cell


def _framed(frame: np.ndarray, picture: Picture) -> Image.Image:
    """Draw the whole frame at the cell's width, the crop marked."""
    height, width = frame.shape[:2]
    scale = CELL / width
    method = Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST
    result = Image.fromarray(frame).resize((CELL, round(height * scale)), method)
    x, y = picture.focus
    high, wide = crop_size(height, width)
    corners = [round(scale * value) for value in (x, y, x + wide, y + high)]
    ImageDraw.Draw(result).rectangle(corners, outline=MARK, width=2)
    return result


def _magnified(crop: np.ndarray) -> Image.Image:
    height, width = crop.shape[:2]
    return Image.fromarray(np.ascontiguousarray(crop)).resize((CELL, height * CELL // width), Image.Resampling.NEAREST)


def _write(
    image: Image.Image, position: tuple[int, int], text: str, color: tuple[int, int, int], size: int, anchor: str = "la"
) -> None:
    ImageDraw.Draw(image).text(position, text, fill=color, font=ImageFont.load_default(size), anchor=anchor)
