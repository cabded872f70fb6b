"""``arm-nss``: the metadata of Arm's captures, one ``<sequence>.json`` each.

Layout and fields: "NSS Dataset Specification" of Arm's Neural Graphics Model Gym, version 1.0.1.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data.importing.facts import Facts, FrameFacts, lookup
from essjax.data.layout import read_json

RATIO = "x2_index"


def arm_facts(path: Path, width: int, height: int) -> Facts:
    """Jitter (fractions of the frame's size), exposure, cuts and planes of one capture.

    Raises:
      ValueError: the file is missing or damaged, or the reference is not linear.
    """
    content = read_json(path)
    if content.get("GTColorSpace", "Linear") != "Linear":
        raise ValueError(f"{path}: expected GTColorSpace Linear, got {content['GTColorSpace']!r}. Capture it again.")
    try:
        # The plugin for Unreal writes FrameNumber where the specification says Frame.
        frames = {int(record.get("Frame", record.get("FrameNumber"))): record for record in content["Frames"]}
        ratio = int(content["UpscalingRatiosIndices"][RATIO])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path}: expected Frames and UpscalingRatiosIndices {RATIO} ({error!r}).") from error

    def facts(number: int, header: Mapping[str, Any]) -> FrameFacts:
        record = lookup(path, frames, number)
        try:
            jitter = record["NormalizedPerRatioJitter"][ratio]
            far = float(record["CameraFarPlane"])
            return FrameFacts(
                jitter=np.asarray([jitter["X"], jitter["Y"]], np.float32),
                exposure=float(record.get("Exposure", 1.0)),
                cut=bool(record.get("CameraCut", False)),
                near=float(record["CameraNearPlane"]),
                far=np.inf if far == -1 else far,
                depth_kind="reversed" if content.get("ReverseZ", False) else "forward",
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ValueError(
                f"{path}, frame {number}: a field is missing or has the wrong form ({error!r})."
            ) from error

    return facts
