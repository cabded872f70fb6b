"""The chosen frames of the report, checked and made display-referred once."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from experiments.report import images as pixels

REQUIRED = ("sequence", "frame", "kind", "resolution", "images")


class Picture(NamedTuple):
    """One frame as every method shows it.

    Attributes:
      sequence: name of the sequence.
      frame: index in the sequence.
      kind: "ss" or "ess".
      resolution: "lr" or "hr".
      images: name -> display-referred float32 ``[h, w, 3]`` in [0, 1]; "reference" last, "input" (if any) first.
      previous: the same of the frame two before, for the names that have it; {} if unknown.
      focus: (x, y) of the top left corner of the crop where methods disagree most, reference pixels.
      scores: name -> PSNR in dB against the reference, for images of its size.
    """

    sequence: str
    frame: int
    kind: str
    resolution: str
    images: dict[str, np.ndarray]
    previous: dict[str, np.ndarray]
    focus: tuple[int, int]
    scores: dict[str, float]

    def error(self, name: str) -> np.ndarray:
        """Mean absolute error of a method, ``[H, W]``."""
        return pixels.error(self.images[name], self.images["reference"])

    def flicker(self, name: str) -> np.ndarray:
        """Temporal difference error of a method, ``[H, W]``; zeros where the frame two before is not known."""
        reference = self.images["reference"]
        if name not in self.previous or "reference" not in self.previous:
            return np.zeros(reference.shape[:2], np.float32)
        return pixels.flicker(self.images[name], self.previous[name], reference, self.previous["reference"])


def make_picture(entry: Mapping[str, Any]) -> Picture:
    """Check one entry of ``write_report``'s ``pictures`` and make it display-referred.

    Raises:
      ValueError: a key is missing, there is no reference, or an image is not ``[H, W, 3]``.
    """
    missing = [key for key in REQUIRED if key not in entry]
    if missing:
        raise ValueError(f"picture: expected the keys {', '.join(REQUIRED)}; missing: {', '.join(missing)}.")
    name = f"picture of {entry['sequence']}, frame {entry['frame']}"
    if "reference" not in entry["images"]:
        raise ValueError(f'{name}: expected an image "reference", got {", ".join(entry["images"])}.')
    for key, image in entry["images"].items():
        if np.ndim(image) != 3 or np.shape(image)[-1] != 3:
            raise ValueError(f"{name}, {key}: expected an image [H, W, 3], got {np.shape(image)}.")
    order = sorted(entry["images"], key=lambda key: {"input": -1, "reference": 1}.get(key, 0))
    exposure = np.float32(entry.get("exposure", 1.0))
    shown = {key: pixels.shown(exposure * entry["images"][key]) for key in order}
    before = (entry.get("previous") or {}).items()
    previous = {key: pixels.shown(exposure * image) for key, image in before if key in shown}
    reference = shown["reference"]
    compared = {key: image for key, image in shown.items() if image.shape == reference.shape}
    scores = {
        key: -10.0 * math.log10(max(float(np.mean((image - reference) ** 2)), 1e-10))
        for key, image in compared.items()
        if key not in ("reference", "input")
    }
    look = [image for key, image in compared.items() if key != "input"]
    return Picture(
        sequence=str(entry["sequence"]), frame=int(entry["frame"]), kind=entry["kind"], resolution=entry["resolution"],
        images=shown, previous=previous, focus=pixels.focus(look), scores=scores,
    )  # fmt: skip
