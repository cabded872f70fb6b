"""Values in the files: NaN, infinities, out of range, channels that never change, colour that looks clipped."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from essjax.buffers import BUFFERS, UNIT_RANGE
from essjax.data.check.finding import Finding, some
from essjax.data.check.pairs import Step
from essjax.data.exr import HALF_MAX
from essjax.data.layout import SUFFIXES

TOLERANCE = 1e-3
"""By which a value may leave its range: half precision."""
VARIES = ("reference", *(name for name, buffer in BUFFERS.items() if buffer.varies))
CLIPPED = {1.0: 1e-3, 255.0: 1e-3, HALF_MAX: 1e-2}
"""Largest values that display-referred pictures and half-precision files have -> share of values that is too much: a
few at the end of half are a sun or a lamp."""


BEYOND = 4
"""Pictures that motion may be long: nothing is seen that came from farther."""
HALF_STEP = 2.0**-11
"""Relative error of half precision."""
BITS = 0.99
"""Share of the values that 8 bits can hold in pictures that were of 8 bits."""


def channels_of(image: str, count: int) -> list[str]:
    """``["motion.X", "motion.Y"]``; those of the reference are plain letters in its file."""
    return [f"{image}.{suffix}" for suffix in SUFFIXES.get(image, "RGB")[:count]]


@dataclasses.dataclass
class ValuesCheck:
    """Over the frames of one sequence.

    Attributes:
      bad: kind of defect -> channel -> frames.
      low: channel -> smallest finite value.
      high: channel -> largest finite value.
      at_top: image -> values of colour and reference that are in ``CLIPPED``.
      eighths: image -> values that 8 bits can hold: k / 255.
      wholes: image -> values that are whole numbers.
      pixels: image -> how many values there are.
    """

    bad: dict[str, dict[str, list[str]]] = dataclasses.field(default_factory=dict)
    low: dict[str, float] = dataclasses.field(default_factory=dict)
    high: dict[str, float] = dataclasses.field(default_factory=dict)
    at_top: dict[str, int] = dataclasses.field(default_factory=dict)
    eighths: dict[str, int] = dataclasses.field(default_factory=dict)
    wholes: dict[str, int] = dataclasses.field(default_factory=dict)
    pixels: dict[str, int] = dataclasses.field(default_factory=dict)

    def add(self, step: Step) -> None:
        """Look at the images of a frame as they are in the files."""
        for image, values in step.raw.items():
            for index, channel in enumerate(channels_of(image, values.shape[-1])):
                self._add_plane(image, channel, np.asarray(values[..., index], np.float32), step.where)

    def _add_plane(self, image: str, channel: str, plane: np.ndarray, where: str) -> None:
        finite = plane[np.isfinite(plane)]
        infinite = np.isneginf(plane).any() if image == "depth" else np.isinf(plane).any()
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.inf, -np.inf)
        defects = {
            "NaN": np.isnan(plane).any(),
            "infinite": infinite,
            "negative": image in ("color", "reference") and low < 0,
            "beyond the picture": image == "motion" and max(-low, high) > BEYOND * max(plane.shape),
            "out of [0, 1]": image in UNIT_RANGE and (low < -TOLERANCE or high > 1 + TOLERANCE),
        }
        for kind, found in defects.items():
            if found:
                self.bad.setdefault(kind, {}).setdefault(channel, []).append(where)
        everywhere_finite = finite.size == plane.size
        if not everywhere_finite and image == "depth" and finite.size:
            high = np.inf  # some background: the channel changes
        self.low[channel] = min(self.low.get(channel, np.inf), low)
        self.high[channel] = max(self.high.get(channel, -np.inf), high)
        if image in ("color", "reference"):
            self.at_top[image] = self.at_top.get(image, 0) + int(np.isin(finite, list(CLIPPED)).sum())
            self.pixels[image] = self.pixels.get(image, 0) + plane.size
            bits = np.abs(255 * finite - np.rint(255 * finite)) < 0.01 + 255 * finite * HALF_STEP
            self.eighths[image] = self.eighths.get(image, 0) + int((bits & (finite <= 1)).sum())
            self.wholes[image] = self.wholes.get(image, 0) + int((finite == np.rint(finite)).sum())


_FIXES = {
    "NaN": "find what makes them in the renderer, or set them to 0 at import and mark the pixels as reactive",
    "infinite": "clamp radiance at import (half holds 65504); only the background's depth is +inf",
    "negative": "clamp at 0 at import: filters with negative lobes and denoisers make them",
    "beyond the picture": "is motion in another unit (recipe: unit in [motion]), or is it garbage where nobody wrote "
    "any (recipe: unwritten in [motion], written in [channels])?",
    "out of [0, 1]": "is the channel in [0, 255], or another one? Scale or clamp it at import",
}


def _judge_defects(checks: Sequence[ValuesCheck]) -> Finding:
    for kind, fix in _FIXES.items():
        channels: dict[str, list[str]] = {}
        for check in checks:
            for channel, places in check.bad.get(kind, {}).items():
                channels.setdefault(channel, []).extend(places)
        if channels:
            places = list(dict.fromkeys(where for found in channels.values() for where in found))
            found = f"{kind}: {some(channels)} in {len(places)} frames ({some(places)})"
            return Finding("values", "wrong", found, fix, {channel: len(found) for channel, found in channels.items()})
    return Finding("values", "ok", "finite and in range")


def _extremes(checks: Sequence[ValuesCheck]) -> dict[str, tuple[float, float]]:
    channels = checks[0].low
    return {c: (min(check.low[c] for check in checks), max(check.high[c] for check in checks)) for c in channels}


def _judge_constant(checks: Sequence[ValuesCheck]) -> Finding:
    check, extremes = "constant channels", _extremes(checks)
    constant = {c: low for c, (low, high) in extremes.items() if low == high or low > high}
    values = [f"{channel} = {value:.3g}" for channel, value in constant.items()]
    suspicious = [channel for channel in constant if channel.rpartition(".")[0] in VARIES]
    if any(channel.startswith(("color", "reference")) for channel in suspicious):
        return Finding(
            check, "wrong", some(values), "is the right channel imported, and was the pass rendered?", constant
        )
    if suspicious:
        return Finding(
            check, "warning", some(values), "is the right channel imported, and was the pass rendered?", constant
        )
    return Finding(check, "ok", f"only {some(values)}" if values else "none", "", constant)


def _judge_scale(checks: Sequence[ValuesCheck], srgb: bool) -> Finding:
    check, extremes = "colour scale", _extremes(checks)
    for image in ("color", "reference"):
        total = max(sum(c.pixels[image] for c in checks), 1)
        top = max(extremes[channel][1] for channel in channels_of(image, 3))
        lit = top > 0 and max(extremes[channel][0] for channel in channels_of(image, 3)) < top
        if lit and top <= 1 and sum(c.eighths[image] for c in checks) > BITS * total:
            found = f"{image} holds 256 different values, k / 255: pictures of 8 bits, taken as linear"
            fix = "8 bits are as good as always sRGB: say so at import (recipe: encoding 'srgb' in [color])"
            return Finding(check, "warning", found, fix, {"max": top})
        if lit and 1 < top <= 255 and sum(c.wholes[image] for c in checks) > BITS * total:
            found = f"{image} holds whole numbers up to {top:g}: bytes, taken as radiance"
            fix = (
                "scale them by 1/255, and decode sRGB, at import (recipe: color in [scale], encoding 'srgb' in [color])"
            )
            return Finding(check, "warning", found, fix, {"max": top})
        high = max(extremes[channel][1] for channel in channels_of(image, 3))
        share = sum(c.at_top[image] for c in checks) / sum(c.pixels[image] for c in checks)
        if srgb and high == 1:
            return Finding(check, "ok", f"{image} ends at 1, as sRGB does ({share:.1%} of it)", "", {"max": high})
        if high in CLIPPED and share > CLIPPED[high]:
            found = f"{image} never exceeds {high:g} and is exactly that in {share:.1%} of its values: it looks clipped"
            fix = (
                "radiance is beyond what half precision holds: scale it down at import (recipe: color in [scale])"
                if high == HALF_MAX
                else "import linear HDR radiance from before tone mapping; if this is 8-bit sRGB, say so at import"
            )
            return Finding(check, "warning", found, fix, {"max": high, "share": round(share, 4)})
    high = max(extremes[channel][1] for channel in channels_of("color", 3))
    return Finding(check, "ok", f"radiance up to {high:.3g}", "", {"max": high})


def judge_values(checks: Sequence[ValuesCheck], *, srgb: bool = False) -> list[Finding]:
    """Judge values, constant channels and the scale of colour; ``srgb``: it was decoded at import."""
    return [_judge_defects(checks), _judge_constant(checks), _judge_scale(checks, srgb)]
