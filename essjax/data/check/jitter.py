"""Jitter: where in the reference the rendered pixels really lie, and what one frame's jitter says about the next."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from essjax.data.check.compare import MARGIN, Comparison, decibel, judge
from essjax.data.check.finding import Finding, some
from essjax.data.check.motion import Look, rendered_errors, tone
from essjax.data.check.pairs import Step
from essjax.data.check.readings import jitter_step
from essjax.typing import Array, Color
from essjax.warp import inside_mask
from essjax.warp.sampling import axis_taps

ROWS = ("jitter, references", "jitter, frame to frame", "sub-pixel shift")
READINGS = {
    "as stated": ((1, 0), (0, 1)),
    "negated": ((-1, 0), (0, -1)),
    "x flipped": ((-1, 0), (0, 1)),
    "y flipped": ((1, 0), (0, -1)),
    "swapped": ((0, 1), (1, 0)),
    "none": ((0, 0), (0, 0)),
}
"""Reading -> the matrix that makes it of the jitter that is stated."""
FIXES = {
    "negated": "jitter has the wrong sign: negate x and y at import (the sample lies at pixel centre + jitter; recipe: "
    "sign in [jitter])",
    "x flipped": "jitter x has the wrong sign: negate it at import",
    "y flipped": "jitter y has the wrong sign: negate it at import (y points down; recipe: y in [jitter])",
    "swapped": "jitter x and y are swapped: exchange them at import",
    "none": "the rendered frames are not jittered against the references: set the jitter to 0 at import, or switch the "
    "jitter of the reference off",
}
MATRICES = {name: np.array(matrix, np.float32) for name, matrix in READINGS.items()}
SHIFT_STEP, SHIFT_REACH = 0.25, 3
SHIFTS = np.arange(-SHIFT_REACH, SHIFT_REACH + 1) * SHIFT_STEP
"""Constant offsets that are tried along each axis, LR pixels."""
SHIFT_OK, SHIFT_WRONG = 0.1, 0.15
"""LR pixels: half a pixel of a 2x reference is 0.25; the estimate is good to 0.06 on real and built-in clips."""
FRAMES = 12
"""Frames per sequence that are compared with the reference."""
SAMPLES = 8192
"""Pixels per frame that are compared with the reference."""
_BORDER = 2
JITTERED = 0.05
"""LR pixels: frames whose jitter stays below are not jittered."""
NO_JITTER = "the frames are not jittered"
OWN_REFERENCE = "the colour is its own reference"


def _read(image: Array, positions: Array, axis: int) -> Array:
    """Bicubic read of ``[H, W, C]`` at ``positions [n]`` along axis 0 or 1.

    Not bilinear: that blurs between pixels, and a blurred reference is closer to noisy frames wherever it is read.
    """
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    taps = axis_taps(positions, image.shape[axis], "bicubic", "border")
    return sum((jnp.take(image, t.index, axis=axis) * t.weight.reshape(shape) for t in taps), jnp.zeros(()))


@partial(jax.jit, static_argnames="scale")
def _grid_errors(
    pixels: Color, reference: Color, rows: Array, columns: Array, jitters: Array, key: Array, *, scale: int
):
    """Mean absolute error ``[N, dy, dx]`` of LR ``pixels [h, w, 3]`` against the reference at their place + an offset.

    Args:
      pixels: of the frame, at ``rows`` and ``columns``.
      reference: ``[sH, sW, 3]``.
      rows: ``[h]`` y of the pixel centres, LR pixels.
      columns: ``[w]`` x of the pixel centres.
      jitters: ``[N, 2]`` (x, y); the offsets are these plus ``SHIFTS`` along each axis.
      key: see ``tone``.
      scale: reference size over frame size.
    """
    toned, reference = tone(pixels, key), tone(reference, key)
    shifts = jnp.asarray(SHIFTS, jnp.float32)

    def of_jitter(jitter: Array) -> Array:
        def of_column(dx: Array) -> Array:
            wide = _read(reference, (columns + jitter[0] + dx) * scale, 1)
            error = lambda dy: jnp.abs(_read(wide, (rows + jitter[1] + dy) * scale, 0) - toned).mean()
            return jax.lax.map(error, shifts)

        return jax.lax.map(of_column, shifts).T

    return jax.lax.map(of_jitter, jitters)


def reference_errors(step: Step) -> np.ndarray:
    """``[readings, dy, dx]``: how far the frame is from the reference read at pixel centre + jitter + (dx, dy)."""
    height, width = step.size
    stride = max(1, math.ceil(math.sqrt(height * width / SAMPLES)))
    rows, columns = (np.arange(_BORDER, n - _BORDER, stride) for n in (height, width))
    pixels = np.asarray(step.now.color)[rows][:, columns]
    jitters = np.stack([matrix @ step.now.jitter for matrix in MATRICES.values()]).astype(np.float32)
    centres = (rows + np.float32(0.5), columns + np.float32(0.5))
    return np.asarray(_grid_errors(pixels, step.reference, *centres, jitters, step.key, scale=step.scale), np.float64)


@dataclasses.dataclass
class JitterCheck:
    """Sums over the frames of one sequence."""

    against: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((len(READINGS), len(SHIFTS), len(SHIFTS))))
    between: Comparison = dataclasses.field(default_factory=lambda: Comparison(tuple(READINGS)))
    jitters: list[np.ndarray] = dataclasses.field(default_factory=list)
    outside: list[str] = dataclasses.field(default_factory=list)
    compared: int = 0

    def add_frame(self, step: Step) -> None:
        """Compare a frame with its reference."""
        self.jitters.append(np.asarray(step.now.jitter))
        if not (np.abs(step.now.jitter) <= 0.5).all():
            self.outside.append(step.where)
        if self.compared < FRAMES:
            self.against += reference_errors(step)
            self.compared += 1

    def add_pair(self, step: Step, looked: Look) -> None:
        """Compare a frame with the one before, along the stated motion."""
        lookups = np.stack([looked.motions[0] + matrix @ jitter_step(step) for matrix in MATRICES.values()])
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


def _judge_against(surfaces: np.ndarray) -> Finding:
    check, names = ROWS[0], list(READINGS)
    lowest = surfaces.min(axis=(1, 2))
    margins = [decibel(lowest[0], error) for error in lowest]
    numbers = {name: round(margin, 2) for name, margin in zip(names[1:], margins[1:], strict=True)}
    best = int(np.argmin(lowest))
    if margins[best] <= -MARGIN:
        gain = -margins[best]
        found = f"'{names[best]}' matches frames and references better than what is stated, by {gain:.1f} dB"
        return Finding(check, "wrong", found, FIXES[names[best]], numbers)
    second = int(np.argmin(lowest[1:])) + 1
    if margins[second] < MARGIN:
        found = f"as stated and '{names[second]}' match frames and references equally well (within {MARGIN} dB)"
        return Finding(check, "not decidable", found, "check a clip with more frames or more texture", numbers)
    found = (
        f"as stated beats all {len(names) - 1} alternatives, the next ('{names[second]}') by {margins[second]:.1f} dB"
    )
    return Finding(check, "ok", found, "", numbers)


def _judge_shift(surface: np.ndarray, scale: int) -> Finding:
    check = ROWS[2]
    x, y = locate_minimum(surface)
    numbers = {"x": round(float(x), 3), "y": round(float(y), 3)}
    if decibel(surface.min(), surface.max()) < 2 * MARGIN:
        return Finding(check, "not decidable", "the pictures have too little detail", "", numbers)
    where = f"frames match the references best ({x:+.2f}, {y:+.2f}) px off the stated sample positions"
    size = max(abs(x), abs(y))
    if size < SHIFT_OK:
        return Finding(check, "ok", where, "", numbers)
    fix = (
        f"add ({x:+.2f}, {y:+.2f}) to the jitter, or move the reference by ({-scale * x:+.1f}, {-scale * y:+.1f}) of "
        "its pixels: is jitter in [0, 1), or the reference resized with aligned corners, cropped or jittered?"
    )
    return Finding(check, "wrong" if size >= SHIFT_WRONG else "warning", where, fix, numbers)


def _jittered(checks: Sequence[JitterCheck]) -> bool:
    return max(np.abs(jitter).max() for check in checks for jitter in check.jitters) >= JITTERED


def judge_against(checks: Sequence[JitterCheck], scale: int, *, own_reference: bool = False) -> tuple[Finding, Finding]:
    """Findings about jitter and a constant shift, frames against references.

    Args:
      checks: one per sequence.
      scale: reference size over frame size.
      own_reference: the references are the frames themselves, so only the jitter's range can be judged.
    """
    if own_reference:
        unknown = Finding(ROWS[0], "not decidable", OWN_REFERENCE if _jittered(checks) else NO_JITTER)
        return _judge_range(checks) or unknown, Finding(ROWS[2], "not decidable", OWN_REFERENCE)
    surfaces = np.sum([check.against for check in checks], axis=0)
    if not _jittered(checks):
        return Finding(ROWS[0], "not decidable", NO_JITTER), _judge_shift(surfaces[0], scale)
    against = _judge_range(checks) or _judge_against(surfaces)
    if against.verdict == "wrong":
        fix = "put the jitter right, then check again"
        return against, Finding(ROWS[2], "not decidable", "the jitter is wrong", fix)
    return against, _judge_shift(surfaces[0], scale)


def judge_between(checks: Sequence[JitterCheck], *, motion_wrong: bool) -> Finding:
    """The finding about jitter from frame to frame."""
    if not _jittered(checks):
        return Finding(ROWS[1], "not decidable", NO_JITTER)
    if motion_wrong:
        fix = "put the motion right, then check again"
        return Finding(ROWS[1], "not decidable", "the motion is wrong", fix)
    return judge(ROWS[1], [check.between for check in checks], FIXES, "the jitter hardly changes")
