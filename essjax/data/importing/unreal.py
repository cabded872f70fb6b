"""``unreal``: cameras from the metadata that Movie Render Queue writes into the header of every EXR.

Unreal's world is left-handed, z up, in centimetres; its camera looks along +X with +Y to the right. essjax's world here
is that one with y negated (right-handed), in metres.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from essjax.cameras import Camera
from essjax.data.importing.facts import FrameFacts, focal_length, make_camera

METRES = 0.01
_PREFIXES = ("unreal/camera", "unreal/layerData/rgba")
_LENS = ("unreal/camera/FinalImage", "unreal/layerData/rgba", "unreal/camera")


def rotation(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """Columns: the camera's forward, right and up in Unreal's world; FRotator angles in degrees."""
    (sp, sy, sr), (cp, cy, cr) = (f(np.radians([pitch, yaw, roll])) for f in (np.sin, np.cos))
    forward = [cp * cy, cp * sy, sp]
    right = [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp]
    up = [-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp]
    return np.asarray([forward, right, up]).T


def camera_to_world(position: tuple[float, ...], pitch: float, yaw: float, roll: float) -> np.ndarray:
    """``[4, 4]``: essjax camera (x right, y up, looking along -z) to world, from Unreal's position and rotator."""
    forward, right, up = rotation(pitch, yaw, roll).T
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, up, -forward], axis=1)
    matrix[:3, 3] = np.asarray(position) * METRES
    matrix[1] *= -1
    return matrix


def _number(header: Mapping[str, Any], names: list[str]) -> float | None:
    for name in names:
        if name in header:
            value = header[name]
            try:
                number = float(value.decode() if isinstance(value, bytes) else value)
            except (ValueError, TypeError):  # UnicodeDecodeError is a ValueError
                number = math.nan
            if not math.isfinite(number):
                raise ValueError(
                    f"header, {name}: expected a number, got {value!r}. Was the file changed? Render it again."
                )
            return number
    return None


def _camera(header: Mapping[str, Any], which: str, width: int, height: int) -> Camera | None:
    def read(key: str) -> float | None:
        return _number(header, [f"{prefix}/{which}{key}" for prefix in _PREFIXES])

    values = [read(key) for key in ("Pos/x", "Pos/y", "Pos/z", "Rot/pitch", "Rot/yaw", "Rot/roll")]
    fov = _number(header, [f"{prefix}/fov" for prefix in _LENS])
    numbers = [value for value in values if value is not None]
    if fov is None or len(numbers) < len(values):
        return None
    if not 0 < fov < 180:
        raise ValueError(f"header: expected a field of view in (0, 180) degrees, got {fov:g}.")
    focal = focal_length(np.radians(fov), width)
    matrix = camera_to_world((numbers[0], numbers[1], numbers[2]), *numbers[3:])
    return make_camera(matrix, [focal, focal], [width / 2, height / 2])


def header_facts(header: Mapping[str, Any], width: int, height: int) -> FrameFacts:
    """Read the cameras of a frame and of the one before; none if the header does not hold them.

    Raises:
      ValueError: names what in the header is no number.
    """
    return FrameFacts(camera=_camera(header, "cur", width, height), previous=_camera(header, "prev", width, height))
