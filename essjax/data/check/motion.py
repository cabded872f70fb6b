"""Motion: the picture before, warped as the dataset states it and as it could have been meant."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax.data.check.compare import DIFFERENT, MARGIN, Comparison, judge, total
from essjax.data.check.finding import Finding
from essjax.data.check.pairs import Step
from essjax.data.check.readings import JITTERED, NONE, READINGS, fix_of, jitter_step, motions_of
from essjax.data.check.surfaces import guide_errors, interior, lands_inside, regions_of
from essjax.data.layout import SequenceInfo
from essjax.sizes import Size, whole_ratio
from essjax.typing import Array, Color, Image, Jitter, Motion
from essjax.warp import backward_warp, hole_mask, inside_mask, upsample_motion

ROWS = ("motion, references", "motion, rendered frames")


class Look(NamedTuple):
    """The readings of one pair and what they give.

    Attributes:
      motions: ``[N, H, W, 2]`` each reading's motion, pixels of the rendered frame; NaN if there is no such reading.
      usable: ``[N, H, W]`` bool: inside the image, and not masked by the dataset.
      reference: ``[N, H, W]`` absolute error of the warped reference, toned.
      squares: ``[N, H, W]`` its squared error.
      similarity: the best correlation of a warped reference with the present one; 1 if they are flat.
    """

    motions: np.ndarray
    usable: np.ndarray
    reference: np.ndarray
    squares: np.ndarray
    similarity: float


def tone(image: Array, key: Array | float) -> Array:
    """Radiance x as x / (x + key): errors count as an eye would count them, whatever the unit of radiance."""
    return image / (image + key)


def _blocks(image: Array, size: Size) -> Array:
    """Means over the pixels whose centres lie in each pixel of a grid of ``size``: ``[H', W']`` to ``size``."""
    factor = whole_ratio(size, image.shape)
    if factor is not None:
        return image.reshape(size[0], factor, size[1], factor).mean(axis=(1, 3))
    rows, columns = (_shares(n, large) for n, large in zip(size, image.shape, strict=True))
    return rows @ image @ columns.T


def _shares(size: int, large: int) -> np.ndarray:
    """Share of each of ``large`` pixels in each of ``size`` that are as long together, ``[size, large]``."""
    inside = np.floor((np.arange(large) + 0.5) * size / large) == np.arange(size)[:, None]
    return np.asarray(inside / inside.sum(axis=1, keepdims=True), np.float32)


@jax.jit
def warp_errors(previous: Color, current: Color, motion: Motion, jitter: Jitter, key: Array) -> Image:
    """``[H, W, 3]``: absolute error, squared error and luminance of ``previous`` warped by LR ``motion``, toned."""
    warped = tone(backward_warp(previous, upsample_motion(motion, previous.shape[:2], jitter=jitter)), key)
    difference = warped - tone(current, key)
    planes = (jnp.abs(difference), difference**2, warped)
    return jnp.stack([_blocks(plane.mean(axis=-1), motion.shape[:2]) for plane in planes], axis=-1)


@jax.jit
def _inside(motion: Motion) -> Array:
    return inside_mask(motion)[..., 0] > 0


@jax.jit
def _holes(now, before, motion, jitter, jitter_before) -> Array:
    return hole_mask(now, before, motion, jitter=jitter, jitter_previous=jitter_before)[..., 0] > 0


def unoccluded(step: Step) -> np.ndarray:
    """``[H, W]`` bool: where the frame before shows the same surface, from the dataset's masks or else its buffers."""
    before, now = step.before, step.now
    if step.exact or before is None:
        return step.mask
    return np.asarray(_holes(now.gbuffers, before.gbuffers, now.motion, now.jitter, before.jitter)) & step.mask


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-9))


def look(step: Step) -> Look:
    """Warp the reference before by every reading; the step must have a frame before."""
    height, width = step.size
    motions = np.stack(list(motions_of(step).values()))
    known = np.isfinite(motions).all(axis=(1, 2, 3))
    planes = np.full((len(READINGS), height, width, 3), np.nan, np.float32)
    usable = np.zeros((len(READINGS), height, width), bool)
    for index in np.flatnonzero(known):
        motion = motions[index]
        planes[index] = warp_errors(step.reference_before, step.reference, motion, step.now.jitter, step.key)
        usable[index] = np.asarray(_inside(motion)) & step.mask
    present = _blocks(tone(step.reference, step.key).mean(axis=-1), step.size)
    flat = present.std() < 1e-3
    similarity = max(_correlation(planes[i, ..., 2], np.asarray(present)) for i in np.flatnonzero(known))
    return Look(motions, usable, planes[..., 0], planes[..., 1], 1.0 if flat else similarity)


@dataclasses.dataclass
class MotionCheck:
    """Sums over the pairs of one sequence."""

    reference: Comparison = dataclasses.field(default_factory=lambda: Comparison(READINGS))
    rendered: Comparison = dataclasses.field(default_factory=lambda: Comparison(READINGS))
    guided: Comparison = dataclasses.field(default_factory=lambda: Comparison(READINGS))
    squares: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    pixels: int = 0

    def add(self, step: Step, looked: Look) -> None:
        """Add a pair that is not a cut."""
        assert step.before is not None
        lookups, regions = looked.motions + jitter_step(step), regions_of(step)
        known = looked.usable.any(axis=(1, 2))
        usable = looked.usable & interior(step.now.gbuffers)
        usable &= lands_inside(step, lookups)
        self.reference.add(looked.reference, looked.motions, usable, regions)
        valid = unoccluded(step) & looked.usable[0]
        self.squares += [looked.squares[0][valid].sum(), looked.squares[NONE][valid].sum()]
        self.pixels += int(valid.sum())
        usable[[READINGS.index(name) for name in JITTERED]] = False
        errors = np.zeros(usable.shape, np.float32)
        for index in np.flatnonzero(known):
            errors[index] = rendered_errors(step, lookups[index])
        self.rendered.add(errors, lookups, usable, regions)
        guided = guide_errors(step, lookups, known)
        if guided is not None:
            self.guided.add(guided, lookups, usable, regions)

    @property
    def psnr(self) -> tuple[float, float]:
        """Score the reference warped as stated and not at all, on pixels that the frame before shows, toned; dB."""
        stated, none = -10 * np.log10(np.maximum(self.squares / max(self.pixels, 1), 1e-10))
        return float(stated), float(none)


def rendered_errors(step: Step, lookup: np.ndarray) -> np.ndarray:
    """Absolute error ``[H, W]`` of the rendered frame before, read at pixel + ``lookup``, toned."""
    assert step.before is not None
    zero = np.zeros(2, np.float32)
    return np.asarray(warp_errors(step.before.color, step.now.color, lookup, zero, step.key))[..., 0]


def right_reading(checks: Sequence[MotionCheck], proved: int | None) -> tuple[int | None, str]:
    """Return the reading that is right, if something knows it that does not lie, and what that is.

    Cameras and depth prove a convention on what stands still, and a convention is one for the whole picture; else base
    colour and normals, which move with the surfaces, may.
    """
    if proved is not None:
        return proved, "cameras and depth say so of what stands still"
    guided = total(check.guided for check in checks)
    best = guided.best()
    if best and guided.supported(best):
        return best, f"base colour and normals follow it better than what is stated, by {guided.margin(best, 0):.1f} dB"
    closest = guided.rivals()[:1]
    if not best and closest and guided.margin(0, closest[0]) >= MARGIN and guided.decidable(0, NONE):
        gain = guided.margin(0, closest[0])
        return 0, f"base colour and normals follow the motion, the next reading is {gain:.1f} dB behind"
    return None, ""


def judge_motion(
    checks: Sequence[MotionCheck],
    info: SequenceInfo,
    *,
    references_jittered: bool = False,
    proved: int | None = None,
) -> list[Finding]:
    """Judge motion: against the references, and against the rendered frames.

    Args:
      checks: one per sequence.
      info: of the dataset.
      references_jittered: they look as jittered as the frames, so they cannot tell whether jitter is in the motion.
      proved: the reading that the cameras prove, see ``surfaces.proved``.
    """
    fixes = {name: fix_of(name, info) for name in READINGS}
    still = f"the motion is < {DIFFERENT} px, or nothing is seen twice"
    right, proof = right_reading(checks, proved)
    known = {"right": right, "proof": proof}
    references = [check.reference for check in checks]
    of_jitter = total(references).best() in [READINGS.index(name) for name in JITTERED]
    if of_jitter and proved is None and right == 0:  # which base colour of jittered frames cannot tell
        known = {}
    against = judge(ROWS[0], references, fixes, still, ignore=JITTERED, **known)
    rendered = judge(ROWS[1], [check.rendered for check in checks], fixes, still, **known)
    if rendered.verdict == "wrong" and against.verdict in ("ok", "wrong") and rendered.fix != against.fix:
        found = "the references, which are cleaner, say otherwise"
        rendered = dataclasses.replace(rendered, verdict="not decidable", found=found, fix="")
    pixels = sum(check.pixels for check in checks)
    merged = MotionCheck(squares=np.sum([check.squares for check in checks], axis=0), pixels=pixels)
    if references_jittered and against.fix in [fixes[name] for name in JITTERED]:
        fix = "put the jitter right, then check again"
        against = dataclasses.replace(against, verdict="not decidable", found="the references are jittered", fix=fix)
    if not merged.pixels:
        return [against, rendered]
    stated, none = merged.psnr
    gain = {"psnr": round(stated, 2), "psnr_without_motion": round(none, 2), "gain": round(stated - none, 2)}
    found = f"{against.found}; reference t-1 -> t {stated:.1f} dB, without motion {none:.1f} ({stated - none:+.1f} dB)"
    return [dataclasses.replace(against, found=found, numbers={**gain, **against.numbers}), rendered]
