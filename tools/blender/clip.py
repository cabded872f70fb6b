"""Parts of render_essjax.py that need no Blender: jitter, camera shift, meta.json. Imports without bpy."""

import argparse
import json
import os
from pathlib import Path

JITTER_UNIT = "LR pixels, sample at pixel centre + (x, y), y down"
STEP = (0.829019, 0.600993)
"""From each frame's jitter to the next one's, modulo a pixel: that of essjax.scenes."""


def jitter(frame: int) -> tuple[float, float]:
    """(x right, y down) in LR pixels, in [-0.5, 0.5): ``frame`` steps, modulo a pixel.

    Every frame, every second, third and fourth of them cover the pixel evenly.
    """
    return frame * STEP[0] % 1 - 0.5, frame * STEP[1] % 1 - 0.5


def camera_shift(jitter: tuple[float, float], width: int, height: int, sensor_fit: str) -> tuple[float, float]:
    """Blender's ``shift_x``, ``shift_y`` that put a sample at pixel centre + jitter.

    Blender's unit is the image side that the sensor is fitted to (AUTO: the longer one); +x moves the view to the
    right, +y up. Moving the view by one pixel to the right puts every sample one pixel further to the right.
    """
    side = {"HORIZONTAL": width, "VERTICAL": height, "AUTO": max(width, height)}[sensor_fit]
    return jitter[0] / side, -jitter[1] / side


def sensor_width(width: int, height: int, sensor_fit: str, sensor: tuple[float, float]) -> float:
    """Millimetres of sensor across the image's width: focal length in pixels = lens / this * width.

    Args:
      width: of the image.
      height: of the image.
      sensor_fit: Blender's HORIZONTAL, VERTICAL or AUTO.
      sensor: Blender's ``sensor_width`` and ``sensor_height``; AUTO fits the first to the longer side.
    """
    if sensor_fit == "HORIZONTAL" or (sensor_fit == "AUTO" and width >= height):
        return sensor[0]
    return (sensor[1] if sensor_fit == "VERTICAL" else sensor[0]) * width / height


def parse_size(text: str) -> tuple[int, int]:
    """``"480x270"`` -> (480, 270)."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise ValueError(f"--size: expected WIDTHxHEIGHT such as 480x270, got {text!r}.")
    return int(width), int(height)


def parse_frames(text: str) -> range:
    """``"1:64"`` -> frames 1 to 64, both included."""
    first, _, last = text.partition(":")
    if not (first.isdigit() and last.isdigit() and int(first) <= int(last)):
        raise ValueError(f"--frames: expected FIRST:LAST such as 1:64, from 0 up, got {text!r}.")
    return range(int(first), int(last) + 1)


def positive(text: str) -> int:
    """Parse a whole number above 0, as an argument's type."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text}")
    return value


def write_atomically(path: Path, text: str) -> None:
    """Leave the old file or the new one, never half of it."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def ratio(text: str) -> float:
    """Parse a number of at least 1, as an argument's type."""
    value = float(text)
    if not 1 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number of at least 1, got {text}")
    return value


def enlarged(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Width and height of the reference."""
    return round(scale * size[0]), round(scale * size[1])


def open_meta(path: Path, size: tuple[int, int], scale: float, source: dict) -> dict:
    """Read meta.json: that of an unfinished clip, or a new one without frames.

    Args:
      path: of meta.json.
      size: width and height of the LR images.
      scale: reference size / LR size.
      source: what else decides about the pictures (scene, samples); a clip can only be continued with the same.

    Raises:
      ValueError: the clip there was rendered with other settings, or its meta.json is damaged.
    """
    meta = {
        "render_size": list(size),
        "display_size": list(enlarged(size, scale)),
        "jitter_unit": JITTER_UNIT,
        "source": source,
    }
    if not path.is_file():
        return {**meta, "frames": {}}
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error}). Delete the clip and render it again.") from error
    other = [key for key in meta if found.get(key) != meta[key]]
    if other:
        pairs = "; ".join(f"{key}: asked {meta[key]}, found {found.get(key)}" for key in other)
        raise ValueError(f"{path}: the clip there has other settings ({pairs}). Choose another --out or delete it.")
    return found


def image_paths(folder: Path, frame: int) -> tuple[Path, Path]:
    """Name the files of the LR image and the reference."""
    return folder / f"lr.{frame:04d}.exr", folder / f"hr.{frame:04d}.exr"


def is_done(folder: Path, meta: dict, frame: int) -> bool:
    """Whether both images are in place and meta.json lists the frame, which is written last."""
    return str(frame) in meta["frames"] and all(path.is_file() for path in image_paths(folder, frame))


def add_frame(path: Path, meta: dict, frame: int, record: dict) -> None:
    """List a finished frame in meta.json.

    Args:
      path: of meta.json.
      meta: its contents; changed in place.
      frame: its number.
      record: ``jitter``, ``camera_to_world``, ``lens_mm``, ``sensor_width_mm``.
    """
    meta["frames"][str(frame)] = record
    meta["frames"] = dict(sorted(meta["frames"].items(), key=lambda item: int(item[0])))
    write_atomically(path, json.dumps(meta, indent=1))
