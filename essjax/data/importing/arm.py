"""``arm-nss``: the metadata of Arm's captures, one ``<sequence>.json`` each; ``arm-gym``: their safetensors.

Layout and fields: "NSS Dataset Specification" of Arm's Neural Graphics Model Gym, version 1.0.1.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data.importing.facts import Facts, FrameFacts, lookup
from essjax.data.importing.planes import stacked_facts
from essjax.data.json_files import FLAG, LIST, check, read_json, whole

RATIO = re.compile(r"x(\d+(?:_\d+)?)_index")
"""``x2_index``, ``x1_5_index``: the upscaling ratio in the name of an index."""
CLOSE = 0.02
"""Relative difference of two ratios that counts as equal: sizes are whole pixels."""


def _ratio_index(path: Path, content: Mapping[str, Any], width: int) -> int | None:
    """Which entry of ``NormalizedPerRatioJitter`` belongs to frames of this width; None: there is only one."""
    indices = content.get("UpscalingRatiosIndices")
    if indices is None:
        return None
    ratio = content["TargetResolution"]["X"] / width
    for name, index in indices.items():
        match = RATIO.fullmatch(name)
        if match and abs(float(match[1].replace("_", ".")) / ratio - 1) < CLOSE:
            return int(index)
    raise ValueError(
        f"{path}: UpscalingRatiosIndices has {', '.join(indices) or 'nothing'}, but the target is {ratio:.3g} times as "
        f"wide as the frames of {width} pixels. Are these the frames of another ratio ([files] in the recipe)?"
    )


def _jitter(record: Mapping[str, Any], index: int | None) -> np.ndarray:
    jitters = record["NormalizedPerRatioJitter"]
    if index is None and len(jitters) != 1:
        raise ValueError(f"{len(jitters)} entries of NormalizedPerRatioJitter, and no UpscalingRatiosIndices")
    jitter = jitters[index or 0]
    return np.asarray([jitter["X"], jitter["Y"]], np.float32)


_FLAGS = ("ReverseZ", "MotionVectorsDilated", "CameraCut")
"""Fields that may be absent: false."""


def arm_facts(path: Path, width: int, height: int) -> Facts:
    """Jitter (fractions of the frame's size), exposure, cuts and planes of one capture, and whether motion is dilated.

    Args:
      path: of the JSON.
      width: of the frames, pixels: with the target's it says which ratio's jitter is theirs.
      height: of the frames, pixels.

    Raises:
      ValueError: the file is missing or damaged, the reference is not linear, or there is no jitter for this width.
    """
    content = read_json(path)
    if content.get("GTColorSpace", "Linear") != "Linear":
        raise ValueError(f"{path}: expected GTColorSpace Linear, got {content['GTColorSpace']!r}. Capture it again.")
    check(str(path), content, {"Frames": LIST, "ReverseZ": FLAG, "MotionVectorsDilated": FLAG}, optional=_FLAGS)
    frames = {}
    for position, record in enumerate(content["Frames"]):
        # The plugin for Unreal writes FrameNumber where the specification says Frame.
        key = "FrameNumber" if isinstance(record, dict) and "Frame" not in record else "Frame"
        check(f"{path}: Frames, entry {position}", record, {key: whole(0, 1 << 31), "CameraCut": FLAG}, optional=_FLAGS)
        if record[key] in frames:
            raise ValueError(f"{path}: Frames, entry {position}: the frame {record[key]} is there twice.")
        frames[record[key]] = record
    try:
        index = _ratio_index(path, content, width)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected TargetResolution and UpscalingRatiosIndices ({error!r:.200}).") from error

    def facts(number: int, header: Mapping[str, Any]) -> FrameFacts:
        record = lookup(path, frames, number)
        try:
            far = float(record["CameraFarPlane"])
            return FrameFacts(
                jitter=_jitter(record, index),
                exposure=None if record.get("Exposure") is None else float(record["Exposure"]),
                cut=bool(record.get("CameraCut", False)),
                near=float(record["CameraNearPlane"]),
                far=np.inf if far == -1 else far,
                depth_kind="reversed" if content.get("ReverseZ", False) else "forward",
                dilated=bool(content.get("MotionVectorsDilated", False)),
            )
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise ValueError(
                f"{path}, frame {number}: a field is missing or has the wrong form ({error!r:.200})."
            ) from error

    return facts


def gym_facts(path: Path, width: int, height: int) -> Facts:
    """Jitter, exposure, cuts and planes from the safetensors that the model gym makes of a capture.

    All arrays have the frame on their first axis: ``jitter`` (y, x) in pixels, ``exposure`` as its natural logarithm,
    ``zNear``, ``zFar``, ``infinite_zFar``, ``camera_cut``. Depth is stored forward, whatever it was captured as.

    Raises:
      ValueError: the file is missing or damaged.
    """
    try:
        arrays = stacked_facts(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: expected a safetensors file of the model gym, cannot read it ({error!s:.200})."
        ) from error

    def facts(number: int, header: Mapping[str, Any]) -> FrameFacts:
        try:
            of = lambda name: np.asarray(arrays[name][number], np.float64).reshape(-1)
            return FrameFacts(
                jitter=of("jitter")[::-1].astype(np.float32),
                exposure=float(np.exp(of("exposure")[0])) if "exposure" in arrays else None,
                cut="camera_cut" in arrays and bool(of("camera_cut")[0]),
                near=float(of("zNear")[0]),
                far=np.inf if of("infinite_zFar")[0] else float(of("zFar")[0]),
                depth_kind="forward",
            )
        except (KeyError, IndexError) as error:
            raise ValueError(f"{path}, frame {number}: an array is missing or too short ({error!r:.200}).") from error

    return facts
