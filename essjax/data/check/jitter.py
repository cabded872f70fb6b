"""Jitter: where in the reference the rendered pixels really lie, and what one frame's jitter says about the next."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

from essjax.data.check.compare import MARGIN, Comparison, decibel, judge
from essjax.data.check.finding import Finding, some
from essjax.data.check.motion import Look, rendered_errors, tone
from essjax.data.check.pairs import Step
from essjax.data.check.readings import jitter_step
from essjax.sizes import ratios
from essjax.typing import Array, Color
from essjax.warp import inside_mask
from essjax.warp.sampling import axis_taps

SHIFT = "sub-pixel shift"
ROWS = ("jitter, references", "jitter, frame to frame", SHIFT)
READINGS = ("as stated", "negated", "x flipped", "y flipped", "swapped", "times 2", "times 1/2", "UV", "NDC", "none")
"""How jitter could have been meant; the first is what is stated."""
FIXES = {
    "negated": "jitter has the wrong sign: negate x and y at import (the sample lies at pixel centre + jitter; recipe: "
    "sign in [jitter])",
    "x flipped": "jitter x has the wrong sign: negate it at import",
    "y flipped": "jitter y has the wrong sign: negate it at import (y points down; recipe: y in [jitter])",
    "swapped": "jitter x and y are swapped: exchange them at import",
    "times 2": "jitter is too short: multiply it by 2 at import (recipe: unit in [jitter])",
    "times 1/2": "jitter is too long: divide it by 2 at import (recipe: unit in [jitter])",
    "UV": "jitter is in UV units: multiply it by the frame's size at import (recipe: unit 'uv' in [jitter])",
    "NDC": "jitter is in NDC: multiply x by half the width and y by minus half the height at import (recipe: unit 'ndc'"
    " and y 'up' in [jitter])",
    "none": "the rendered frames are not jittered against the references: set the jitter to 0 at import, or switch the "
    "jitter of the reference off",
}
ABSENT = (
    "the frames are jittered, and the dataset says that they are not: give the jitter of each frame at import (recipe: "
    "source in [jitter])"
)


def matrices(size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Map each reading to the matrix that makes it of the stated jitter; ``size`` is height and width."""
    height, width = size
    of = lambda a, b, c, d: np.array([[a, b], [c, d]], np.float32)
    return {
        "as stated": of(1, 0, 0, 1), "negated": of(-1, 0, 0, -1), "x flipped": of(-1, 0, 0, 1),
        "y flipped": of(1, 0, 0, -1), "swapped": of(0, 1, 1, 0), "times 2": of(2, 0, 0, 2),
        "times 1/2": of(0.5, 0, 0, 0.5), "UV": of(width, 0, 0, height), "NDC": of(width / 2, 0, 0, -height / 2),
        "none": of(0, 0, 0, 0),
    }  # fmt: skip


SHIFT_STEP, SHIFT_REACH = 0.25, 4
SHIFTS = np.arange(-SHIFT_REACH, SHIFT_REACH + 1) * SHIFT_STEP
"""Offsets from the pixel's centre that are tried along each axis, LR pixels."""
OFF, BETTER, CLOSE = 0.12, 0.5, 0.04
"""LR pixels by which the stated jitter may miss what a frame shows; the share of it that another reading must not
exceed; and the difference below which two readings fit equally well."""
SHIFT_COSTS = 0.25
"""A reading that needs a constant shift as well is less likely: what a pixel of it counts."""
FEW = 3
"""Frames that are needed."""
SHIFT_OK, SHIFT_WRONG = 0.1, 0.15
"""LR pixels: half a pixel of a 2x reference is 0.25; the estimate is good to 0.06 on real and built-in clips."""
FRAMES = 12
"""Frames per sequence that are compared with the reference."""
SAMPLES = 8192
"""Pixels per frame that are compared with the reference."""
_BORDER = 2
NOTHING = 1e-6
"""Jitter that stays below is none; of 1e-4 it may still be in UV."""
NO_JITTER = "the frames are not jittered"
OWN_REFERENCE = "the colour is its own reference"


def _read(image: Array, positions: Array, axis: int) -> Array:
    """Bicubic read of ``[H, W, C]`` at ``positions [n]`` along axis 0 or 1.

    Not bilinear: that blurs between pixels, and a blurred reference is closer to noisy frames wherever it is read.
    """
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    taps = axis_taps(positions, image.shape[axis], "bicubic", "border")
    return sum((jnp.take(image, t.index, axis=axis) * t.weight.reshape(shape) for t in taps), jnp.zeros(()))


@partial(jax.jit, static_argnames="ratio")
def _grid_errors(
    pixels: Color, reference: Color, rows: Array, columns: Array, key: Array, *, ratio: tuple[float, float]
) -> Array:
    """Mean absolute error ``[dy, dx]`` of LR ``pixels [h, w, 3]`` against the reference at their place + ``SHIFTS``.

    Args:
      pixels: of the frame, at ``rows`` and ``columns``.
      reference: ``[H', W', 3]``.
      rows: ``[h]`` y of the pixel centres.
      columns: ``[w]`` x of the pixel centres.
      key: see ``tone``.
      ratio: reference size over frame size, along x and y.
    """
    toned, reference = tone(pixels, key), tone(reference, key)
    shifts, (along_x, along_y) = jnp.asarray(SHIFTS, jnp.float32), ratio

    def of_column(dx: Array) -> Array:
        wide = _read(reference, (columns + dx) * along_x, 1)
        error = lambda dy: jnp.abs(_read(wide, (rows + dy) * along_y, 0) - toned).mean()
        return jax.lax.map(error, shifts)

    return jax.lax.map(of_column, shifts).T


def reference_errors(step: Step) -> np.ndarray:
    """``[dy, dx]``: how far the frame is from the reference read at pixel centre + (dx, dy)."""
    height, width = step.size
    stride = max(1, math.ceil(math.sqrt(height * width / SAMPLES)))
    rows, columns = (np.arange(_BORDER, n - _BORDER, stride) for n in (height, width))
    pixels = np.asarray(step.now.color)[rows][:, columns]
    centres = (rows + np.float32(0.5), columns + np.float32(0.5))
    ratio = ratios(step.size, step.output)
    return np.asarray(_grid_errors(pixels, step.reference, *centres, step.key, ratio=ratio), np.float64)


@dataclasses.dataclass
class JitterCheck:
    """Over the frames of one sequence.

    Attributes:
      found: of the frames that were compared with their references: where the samples lie, off the pixel centres.
      stated: the jitter of the same frames.
      surfaces: ``reference_errors`` of the same frames.
      matrices: see there.
      between: frames against the frames before.
      jitters: of all frames.
      outside: frames whose jitter is beyond half a pixel.
      compared: frames that were compared.
    """

    found: list[np.ndarray] = dataclasses.field(default_factory=list)
    stated: list[np.ndarray] = dataclasses.field(default_factory=list)
    surfaces: list[np.ndarray] = dataclasses.field(default_factory=list)
    matrices: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    between: Comparison = dataclasses.field(default_factory=lambda: Comparison(READINGS))
    jitters: list[np.ndarray] = dataclasses.field(default_factory=list)
    outside: list[str] = dataclasses.field(default_factory=list)
    compared: int = 0

    def add_frame(self, step: Step) -> None:
        """Compare a frame with its reference."""
        self.jitters.append(np.asarray(step.now.jitter))
        self.matrices = matrices(step.size)
        if not (np.abs(step.now.jitter) <= 0.5).all():
            self.outside.append(step.where)
        if self.compared < FRAMES:
            self.compared += 1
            surface = reference_errors(step)
            if decibel(surface.min(), surface.max()) >= 2 * MARGIN:
                self.surfaces.append(surface)
                self.found.append(locate_minimum(surface))
                self.stated.append(np.asarray(step.now.jitter, np.float64))

    def add_pair(self, step: Step, looked: Look) -> None:
        """Compare a frame with the one before, along the stated motion."""
        lookups = np.stack([looked.motions[0] + matrix @ jitter_step(step) for matrix in self.matrices.values()])
        usable = np.asarray(inside_mask(lookups))[..., 0] > 0
        errors = np.stack([rendered_errors(step, lookup) for lookup in lookups])
        self.between.add(errors, lookups, usable & looked.usable[0])


def locate_minimum(surface: np.ndarray) -> np.ndarray:
    """(x, y) in LR pixels of the smallest error on the grid of ``SHIFTS``, refined by a parabola along each axis."""
    row, column = np.unravel_index(surface.argmin(), surface.shape)

    def refine(values: np.ndarray, index: int) -> float:
        if index in (0, len(values) - 1):
            return float(SHIFTS[index])
        left, middle, right = values[index - 1 : index + 2]
        bend = left - 2 * middle + right
        return float(SHIFTS[index] + (0.5 * SHIFT_STEP * (left - right) / bend if bend > 0 else 0.0))

    return np.array([refine(surface[row], int(column)), refine(surface[:, column], int(row))])


def _judge_range(checks: Sequence[JitterCheck]) -> Finding | None:
    outside = [where for check in checks for where in check.outside]
    if not outside:
        return None
    found = f"jitter beyond half a pixel in {len(outside)} frames: {some(outside)}"
    fix = "jitter is in pixels of the rendered frame, in [-0.5, 0.5): is it in pixels of another size, or in [0, 1)?"
    return Finding(ROWS[0], "wrong", found, fix)


def spread(offsets: np.ndarray) -> float:
    """Median distance from the median: what a constant shift does not explain."""
    return float(np.median(np.linalg.norm(offsets - np.median(offsets, axis=0), axis=-1)))


def _judge_against(checks: Sequence[JitterCheck]) -> Finding:
    check = ROWS[0]
    found, stated = (np.array([o for c in checks for o in getattr(c, name)]) for name in ("found", "stated"))
    if len(found) < FEW:
        return Finding(check, "not decidable", "the pictures have too little detail", "check more frames")
    off = {name: spread(found - stated @ matrix.T) for name, matrix in checks[0].matrices.items()}
    numbers = {name: round(value, 3) for name, value in off.items()}
    if not np.abs(stated).max() > NOTHING:
        if off["as stated"] <= OFF:
            return Finding(check, "not decidable", NO_JITTER, "", numbers)
        where = f"frames show the references at places that change by {off['as stated']:.2f} px from frame to frame"
        return Finding(check, "wrong", where, ABSENT, numbers)
    others = {name: value for name, value in off.items() if name != "as stated"}
    shift = {name: np.linalg.norm(np.median(found - stated @ m.T, axis=0)) for name, m in checks[0].matrices.items()}
    best = min(others, key=lambda name: others[name] + SHIFT_COSTS * shift[name])
    where = f"what frames and references show is {off['as stated']:.2f} px off as stated, '{best}' {off[best]:.2f} px"
    if off["as stated"] > OFF and off[best] < BETTER * off["as stated"]:
        return Finding(check, "wrong", where, FIXES[best], numbers)
    if off[best] - off["as stated"] < CLOSE:
        return Finding(check, "not decidable", where, "check a clip with more frames or more texture", numbers)
    return Finding(check, "ok", where, "", numbers)


def _around(surface: np.ndarray, jitter: np.ndarray) -> np.ndarray:
    """Move a surface of errors such that the stated position is in its middle."""
    rows, columns = np.mgrid[: len(SHIFTS), : len(SHIFTS)].astype(float)
    return map_coordinates(surface, [rows + jitter[1] / SHIFT_STEP, columns + jitter[0] / SHIFT_STEP], mode="nearest")


def _judge_shift(checks: Sequence[JitterCheck], ratio: tuple[float, float]) -> Finding:
    check = ROWS[2]
    stated = [jitter for c in checks for jitter in c.stated]
    if not stated:
        return Finding(check, "not decidable", "the pictures have too little detail")
    surfaces = [surface for c in checks for surface in c.surfaces]
    x, y = locate_minimum(sum(_around(surface, jitter) for surface, jitter in zip(surfaces, stated, strict=True)))
    numbers = {"x": round(float(x), 3), "y": round(float(y), 3)}
    where = f"frames match the references best ({x:+.2f}, {y:+.2f}) px off the stated sample positions"
    size = max(abs(x), abs(y))
    if size < SHIFT_OK:
        return Finding(check, "ok", where, "", numbers)
    fix = (
        f"add ({x:+.2f}, {y:+.2f}) to the jitter, or move the reference by "
        f"({-ratio[0] * x:+.1f}, {-ratio[1] * y:+.1f}) of its pixels: is jitter in [0, 1), or the "
        "reference resized with aligned corners, cropped or jittered?"
    )
    return Finding(check, "wrong" if size >= SHIFT_WRONG else "warning", where, fix, numbers)


def _jittered(checks: Sequence[JitterCheck]) -> bool:
    return max(np.abs(jitter).max() for check in checks for jitter in check.jitters) > NOTHING


def judge_against(
    checks: Sequence[JitterCheck], ratio: tuple[float, float], *, own_reference: bool = False
) -> tuple[Finding, Finding]:
    """Judge jitter and a constant shift, frames against references.

    Args:
      checks: one per sequence.
      ratio: reference size over frame size, along x and y.
      own_reference: the references are the frames themselves, so only the jitter's range can be judged.
    """
    if own_reference:
        unknown = Finding(ROWS[0], "not decidable", OWN_REFERENCE if _jittered(checks) else NO_JITTER)
        return _judge_range(checks) or unknown, Finding(ROWS[2], "not decidable", OWN_REFERENCE)
    against = _judge_range(checks) or _judge_against(checks)
    if against.verdict == "wrong":
        fix = "put the jitter right, then check again"
        return against, Finding(ROWS[2], "not decidable", "the jitter is wrong", fix)
    return against, _judge_shift(checks, ratio)


def judge_between(checks: Sequence[JitterCheck], *, motion_wrong: bool, against: Finding) -> Finding:
    """Judge jitter from frame to frame; ``against`` is the finding of frames against references."""
    if not _jittered(checks):
        return Finding(ROWS[1], "not decidable", NO_JITTER)
    if motion_wrong:
        fix = "put the motion right, then check again"
        return Finding(ROWS[1], "not decidable", "the motion is wrong", fix)
    finding = judge(ROWS[1], [check.between for check in checks], FIXES, "the jitter hardly changes")
    if finding.verdict == "wrong" and against.verdict in ("ok", "wrong") and finding.fix != against.fix:
        found = f"{finding.found}; the references, which are cleaner, say otherwise"
        return dataclasses.replace(finding, verdict="not decidable", found=found, fix="")
    return finding
