"""Facts that a dump tells of each frame beside its images: jitter, exposure, cuts, planes and cameras.

``generic_facts`` reads the JSON of docs/guides/importing.md; presets whose dumps say it in another way have functions
of their own (``arm``, ``unreal``).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.cameras import Camera
from essjax.data.json_files import FLAG, OBJECT, Kind, check, numbers, or_null, read_json, shown


@dataclasses.dataclass(frozen=True)
class FrameFacts:
    """One frame; what is unknown keeps its default.

    Attributes:
      jitter: ``[2]`` in the recipe's unit and sign, or None.
      exposure: colour was, or will be, multiplied with it; None: not known.
      cut: history is not valid.
      near: near plane, the dump's unit, or None.
      far: far plane, or None.
      depth_kind: "reversed" or "forward", or None.
      camera: in pixels of the frames, or None.
      previous: camera of the frame before, or None.
      dilated: motion was dilated before it was stored.
    """

    jitter: np.ndarray | None = None
    exposure: float | None = None
    cut: bool = False
    near: float | None = None
    far: float | None = None
    depth_kind: str | None = None
    camera: Camera | None = None
    previous: Camera | None = None
    dilated: bool = False


Facts = Callable[[int, Mapping[str, Any]], FrameFacts]
"""``(frame number, header of its colour file) -> FrameFacts``; a ValueError says which frame or field is missing."""


def no_facts(number: int, header: Mapping[str, Any]) -> FrameFacts:
    """For dumps that say nothing beside their images."""
    return FrameFacts()


def make_camera(camera_to_world: Any, focal: Any, center: Any) -> Camera:
    """Make a camera of NumPy float32 leaves; ``camera_to_world`` as 4 x 4 nested lists, the others in pixels."""
    return Camera(
        camera_to_world=np.asarray(camera_to_world, np.float32).reshape(4, 4),
        focal=np.asarray(focal, np.float32).reshape(2),
        center=np.asarray(center, np.float32).reshape(2),
    )


def focal_length(fov: float, size: int) -> float:
    """Focal length in pixels from a field of view (radians) over ``size`` pixels."""
    return 0.5 * size / math.tan(0.5 * fov)


def lookup(path: Path, frames: Mapping[int, Mapping], number: int) -> Mapping:
    """Find the record of a frame; a ValueError if there is none."""
    if number not in frames:
        raise ValueError(f"{path}: frame {number} is not listed there ({len(frames)} frames are).")
    return frames[number]


def numbered(path: Path, records: Mapping[str, Any]) -> dict[int, Any]:
    """Take the keys as frame numbers; a ValueError if one is none, or there twice ("8" and "08")."""
    frames: dict[int, Any] = {}
    for key, record in records.items():
        number = int(key) if key.isdecimal() and len(key) < 10 else None
        if number is None or number in frames:
            raise ValueError(f"{path}: frames: expected numbers of frames, each once, got {shown(key)}.")
        frames[number] = record
    return frames


def _is_numeral(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and not math.isnan(float(value))  # far may be infinite
    except (TypeError, ValueError, OverflowError):
        return False


_NUMERAL = or_null(Kind("a number", _is_numeral))
_EXPOSURE = or_null(Kind("a number above 0", lambda value: _is_numeral(value) and 0 < float(value) < math.inf))
"""Other programs write numbers as texts, too."""
_CAMERA = {"camera_to_world": numbers(16), "focal": numbers(2), "center": numbers(2)}
_FACTS = {
    "jitter": numbers(2), "exposure": _EXPOSURE, "cut": FLAG, "near": _NUMERAL, "far": _NUMERAL, **_CAMERA,
}  # fmt: skip


def generic_facts(path: Path, width: int, height: int) -> Facts:
    """Facts from ``{"frames": {"8": {"jitter": [x, y], "exposure": 1.0, "cut": false, ...}}}``.

    Raises:
      ValueError: the file is missing or damaged.
    """
    content = read_json(path)
    check(str(path), content, {"frames": OBJECT})
    frames = numbered(path, content["frames"])

    def camera(number: int) -> Camera | None:
        record = frames.get(number, {})
        if "camera_to_world" not in record:
            return None
        check(f"{path}, frame {number}", record, _CAMERA, optional=("center",))
        center = record.get("center", [width / 2, height / 2])
        return make_camera(record["camera_to_world"], record["focal"], center)

    def facts(number: int, header: Mapping[str, Any]) -> FrameFacts:
        record = lookup(path, frames, number)
        check(f"{path}, frame {number}", record, _FACTS, optional=_FACTS)
        try:
            return FrameFacts(
                jitter=None if "jitter" not in record else np.asarray(record["jitter"], np.float32),
                exposure=None if record.get("exposure") is None else float(record["exposure"]),
                cut=bool(record.get("cut", False)),
                near=None if record.get("near") is None else float(record["near"]),
                far=None if record.get("far") is None else float(record["far"]),
                camera=camera(number),
                previous=camera(number - 1),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}, frame {number}: a field is missing or has the wrong form ({error!r:.200})."
            ) from error

    return facts
