"""The surfaces of a frame: which parts there are, what moves with them, and whether the stated motion holds on each.

Shaded colour does not move with a surface: mirror images, highlights and shadows have motions of their own, and a plain
sky shows nothing but the edges of what stands before it. Base colour, normals and ids do move with it, and so does what
cameras and depth say of everything that stands still.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from essjax.data.check.finding import Finding, some
from essjax.data.check.pairs import Step
from essjax.data.check.readings import READINGS, camera_motion, jitter_step
from essjax.typing import Array
from essjax.warp import backward_warp

ROW = "motion, surfaces"
SKY, STATIC = -1, 0
"""Parts; the others are ids of objects."""
TILES = (4, 3)
"""Columns and rows into which what stands still is divided: one wrong corner must not speak for all of it."""
EDGE = 1.1
"""Ratio of two neighbouring depths that are two surfaces."""
NEAR_CAMERAS = (0.1, 0.02)
"""Pixels, and share of its length, by which motion may miss that of the cameras."""
MOVES = 0.25
"""Pixels: what moves less proves no convention."""
PROVED, PROVED_UNMARKED, PIXELS = 0.9, 0.6, 200
"""Share of the still pixels (of all, where nothing marks what moves) that proves a reading; how many there must be."""
FOLLOWS = 0.5
"""Share of the background whose motion must be that of the cameras."""
OFFSETS = sorted(
    {(x, y) for step, reach in ((0.5, 1), (1, 3), (2, 10)) for x in np.arange(-reach, reach + step, step)
     for y in np.arange(-reach, reach + step, step)},
    key=lambda offset: np.hypot(*offset),
)  # fmt: skip
"""Pixels off the stated place at which an object is looked for; the first is that place."""
ELSEWHERE = ((0.75, 0.015, 0.0, 0.0), (0.65, 0.015, 0.4, 1.5))
"""An object is elsewhere if the mismatch of its interior, or of all of it, is there less than this share of the stated
one, and less by this much, and its blocks agree on so many pixels, and there are more than so many blocks per frame:
outlines fit here and there by chance."""
OBJECTS, OBJECT_PIXELS, SAMPLES = 8, 30, 100
"""Objects that are looked for per frame, pixels that they and their blocks need, and pixels compared per block."""
BLOCK, BLOCKS = 10, 12
"""Side of a block, pixels (a sixth of the height of larger pictures), and how many there may be of an object."""
GUIDE_GAIN = 4.0
"""Mismatch of base colour and normals that counts like another object is the inverse of this."""


def parts_of(step: Step) -> np.ndarray:
    """``[H, W]`` int: ``SKY``, ``STATIC`` or the id of an object."""
    return _parts(step.now.gbuffers)


def _parts(gbuffers) -> np.ndarray:
    ids = np.zeros(gbuffers.depth.shape[:2], int) if gbuffers.stencil is None else np.asarray(gbuffers.stencil)[..., 0]
    return np.where(np.isfinite(gbuffers.depth[..., 0]), ids, SKY)


def interior(gbuffers) -> np.ndarray:
    """``[H, W]`` bool: pixels away from silhouettes, by a pixel."""
    parts, depth = _parts(gbuffers), np.asarray(gbuffers.depth)[..., 0]
    far, border = np.where(np.isfinite(depth), depth, 1e30), np.zeros(parts.shape, bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        a, b = far[one], far[other]
        edge = (parts[one] != parts[other]) | (np.maximum(a, b) > EDGE * np.minimum(a, b))
        border[one] |= edge
        border[other] |= edge
    return ~border


def regions_of(step: Step) -> np.ndarray:
    """``[H, W]`` int: like ``parts_of``, but with what stands still divided into tiles, ids below ``SKY``."""
    parts = parts_of(step)
    (height, width), (columns, rows) = parts.shape, TILES
    y, x = np.mgrid[:height, :width]
    tile = (y * rows // height) * columns + x * columns // width
    return np.where(parts == STATIC, SKY - 1 - tile, parts)


def guides(gbuffers) -> np.ndarray | None:
    """``[H, W, C]`` what moves with the surfaces: base colour, and normals with a quarter of their length."""
    images = [gbuffers.base_color, None if gbuffers.normal is None else 0.25 * np.asarray(gbuffers.normal)]
    images = [np.asarray(image, np.float32) for image in images if image is not None]
    return np.concatenate(images, axis=-1) if images else None


@jax.jit
def _guide_errors(previous: Array, current: Array, lookup: Array) -> Array:
    return abs(backward_warp(previous, lookup) - current).mean(axis=-1)


def guide_errors(step: Step, lookups: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """``[N, H, W]`` how far the guides of the frame before, read at pixel + lookup, are off; None without guides."""
    assert step.before is not None
    now, before = guides(step.now.gbuffers), guides(step.before.gbuffers)
    if now is None or before is None:
        return None
    errors = np.zeros(lookups.shape[:3], np.float32)
    for index in np.flatnonzero(known):
        errors[index] = _guide_errors(before, now, lookups[index])
    return errors


def lands_inside(step: Step, lookups: np.ndarray) -> np.ndarray:
    """``[N, H, W]`` bool: the lookup lies in the interior of the same part, in the frame before."""
    assert step.before is not None
    parts, before, inner = parts_of(step), _parts(step.before.gbuffers), interior(step.before.gbuffers)
    rows, columns, inside = _places(parts.shape, lookups)
    return inside & (before[rows, columns] == parts) & inner[rows, columns]


def _places(shape: tuple[int, ...], lookups: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column that each lookup lies in, clamped, and whether it is inside."""
    (height, width), (y, x) = shape, np.mgrid[: shape[0], : shape[1]] + 0.5
    safe = np.nan_to_num(lookups, nan=1e9, posinf=1e9, neginf=-1e9)
    column, row = np.floor(x + safe[..., 0]), np.floor(y + safe[..., 1])
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    clamp = lambda values, size: np.clip(values, 0, size - 1).astype(int)
    return clamp(row, height), clamp(column, width), inside


@dataclasses.dataclass
class SurfaceCheck:
    """Over the pairs of one sequence.

    Attributes:
      still: pixels that stand still and that the cameras move.
      agree: ``[N]`` those of them where a reading is what the cameras say.
      sky: the same of the background.
      sky_agree: ``[N]``.
      background: pixels of the background in all.
      unmoved: those with no motion at all, in frames whose surfaces move.
      has_stencil: whether moving objects are marked.
      seen: object -> frames in which it was looked for.
      objects: object -> sums of ``_mismatches``.
    """

    still: int = 0
    agree: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(len(READINGS)))
    sky: int = 0
    sky_agree: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(len(READINGS)))
    background: int = 0
    unmoved: int = 0
    has_stencil: bool = False
    seen: dict[int, int] = dataclasses.field(default_factory=dict)
    objects: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)

    def add(self, step: Step, motions: np.ndarray) -> None:
        """Add a pair; ``motions`` ``[N, H, W, 2]`` of all readings."""
        parts = parts_of(step)
        self.has_stencil = step.now.gbuffers.stencil is not None
        self._add_cameras(step, motions, parts)
        lengths = np.linalg.norm(motions[0], axis=-1)
        self.background += int((parts == SKY).sum())
        if (parts != SKY).any() and np.median(lengths[parts != SKY]) > MOVES:
            self.unmoved += int((lengths[parts == SKY] == 0).sum())
        for identity, table in _mismatches(step, motions[0], parts).items():
            self.seen[identity] = self.seen.get(identity, 0) + 1
            self.objects[identity] = self.objects.get(identity, 0) + table

    def _add_cameras(self, step: Step, motions: np.ndarray, parts: np.ndarray) -> None:
        expected = camera_motion(step)
        if expected is None:
            return
        length = np.linalg.norm(expected, axis=-1)
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(motions - expected, axis=-1)
            agree = off <= NEAR_CAMERAS[0] + NEAR_CAMERAS[1] * length
        for part, total, share in ((STATIC, "still", "agree"), (SKY, "sky", "sky_agree")):
            where = (parts == part) & (length > MOVES) & np.isfinite(length)
            setattr(self, total, getattr(self, total) + int(where.sum()))
            setattr(self, share, getattr(self, share) + agree[:, where].sum(axis=1))


def _mismatches(step: Step, motion: np.ndarray, parts: np.ndarray) -> dict[int, np.ndarray]:
    """Object -> ``[2, 5]``: of its interior and of all of it: blocks, their mismatch as stated, their least one, and
    the (x, y) off the stated place at which it is found, summed over blocks.

    It is looked for in blocks, as parts of a turning or deforming object go their own ways. With its silhouette it is
    looked for a whole pixel away and more: nearer by, a blurred outline fits better than a sharp one.
    """
    assert step.before is not None
    before = _parts(step.before.gbuffers)
    ids, counts = np.unique(parts[parts > STATIC], return_counts=True)
    largest = [int(i) for i in ids[np.argsort(-counts)][:OBJECTS] if (before == i).sum() >= OBJECT_PIXELS]
    inner, side = interior(step.now.gbuffers), max(BLOCK, parts.shape[0] // 6)
    y, x = np.mgrid[: parts.shape[0], : parts.shape[1]] // side
    block = y * parts.shape[1] + x
    found = {}
    for identity in largest:
        table = np.zeros((2, 5))
        for row, where, least in zip(table, ((parts == identity) & inner, parts == identity), (0.0, 1.0), strict=True):
            names, sizes = np.unique(block[where], return_counts=True)
            for name in names[np.argsort(-sizes)][:BLOCKS][: (sizes >= OBJECT_PIXELS).sum()]:
                row += _block_mismatch(step, motion, before, identity, where & (block == name), least)
        found[identity] = table
    return found


def _block_mismatch(
    step: Step, motion: np.ndarray, before: np.ndarray, identity: int, where: np.ndarray, least: float
) -> np.ndarray:
    """One block's row of ``_mismatches``, looked for ``least`` pixels away or more; zeros if it leaves the picture."""
    assert step.before is not None
    now, old = guides(step.now.gbuffers), guides(step.before.gbuffers)
    rows, columns = np.nonzero(where)
    stride = max(1, len(rows) // SAMPLES)
    rows, columns = rows[::stride], columns[::stride]
    lookup, offsets = motion[rows, columns] + jitter_step(step), np.array(OFFSETS, np.float32)
    x, y = columns + lookup[:, 0] + offsets[:, :1], rows + lookup[:, 1] + offsets[:, 1:]
    inside = (x >= 0) & (x <= before.shape[1] - 1) & (y >= 0) & (y <= before.shape[0] - 1)
    mismatch = _read((before != identity).astype(np.float32)[..., None], x, y)[..., 0]
    if now is not None and old is not None:
        difference = np.abs(_read(old, x, y) - now[rows, columns]).mean(axis=-1)
        mismatch = np.maximum(mismatch, np.minimum(GUIDE_GAIN * difference, 1))
    count = inside.sum(axis=1)
    mean = np.where(count > 0.5 * len(rows), (mismatch * inside).sum(axis=1) / np.maximum(count, 1), np.inf)
    if not np.isfinite(mean[0]):
        return np.zeros(5)
    mean[1:][np.hypot(*offsets[1:].T) < least] = np.inf
    best = int(np.argmin(mean))
    return np.array([1, mean[0], mean[best], *offsets[best]])


def _read(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear read of ``[H, W, C]`` at pixel indices; outside, its border."""
    height, width = image.shape[:2]
    column, row = np.clip(np.nan_to_num(x), 0, width - 1), np.clip(np.nan_to_num(y), 0, height - 1)
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (column - left)[..., None], (row - top)[..., None]
    upper = image[top, left] * (1 - u) + image[top, right] * u
    return upper * (1 - v) + (image[below, left] * (1 - u) + image[below, right] * u) * v


def proved(checks: Sequence[SurfaceCheck]) -> int | None:
    """Return the reading that the cameras prove on what stands still: 0 the stated one; None: they prove none."""
    still, agree = sum(check.still for check in checks), sum(check.agree for check in checks)
    if still < PIXELS:
        return None
    least = PROVED if all(check.has_stencil for check in checks) else PROVED_UNMARKED
    shares = np.asarray(agree) / still
    shares[[READINGS.index("of the cameras"), READINGS.index("none")]] = 0
    best = 0 if shares[0] >= least else int(np.argmax(shares))
    return best if shares[best] >= least else None


def judge_surfaces(checks: Sequence[SurfaceCheck], *, wrong: str = "") -> Finding:
    """Whether the stated motion holds on the background and on each object; ``wrong`` names what forbids to ask."""
    if wrong:
        return Finding(ROW, "not decidable", f"the {wrong} is wrong", f"put the {wrong} right, then check again")
    background, sky = sum(check.background for check in checks), sum(check.sky for check in checks)
    holds = [f"object {i}" for i in _objects(checks, held=True)]
    lost = _objects(checks, held=False)
    numbers: dict[str, float] = {"objects": len(holds) + len(lost)}
    follows = sum(check.sky_agree[0] for check in checks) / sky if sky else 1.0
    if sky:
        numbers["background"] = round(float(follows), 4)
    static = proved(checks) == 0
    if lost:
        one = next(iter(lost))
        x, y = lost[one]
        others = f"motion holds on {some([*(['what stands still'] if static else []), *holds]) or 'nothing else'}; "
        found = (
            f"{others}object {some(lost)} was not where its motion says: object {one} ({x:+.0f}, {y:+.0f}) px off it"
        )
        fix = (
            f"object {some(lost)} has no motion of its own, or a wrong one: let the renderer write motion for all that "
            "moves (skinned, scripted and deforming meshes too)"
        )
        return Finding(ROW, "wrong", found, fix, numbers)
    if static and sky >= max(PIXELS, 0.1 * background) and follows < FOLLOWS:
        found = (
            f"motion holds on what stands still; the background does not follow the cameras ({follows:.0%} of it does)"
        )
        fix = (
            "nobody wrote the motion of the background: take it from the cameras at import (recipe: unwritten "
            "'background' in [motion])"
        )
        return Finding(ROW, "wrong", found, fix, numbers)
    if not sky and sum(check.unmoved for check in checks) > max(PIXELS, 0.5 * background):
        found = (
            "the background holds no motion although surfaces move, and there are no cameras to say what it should be"
        )
        return Finding(ROW, "warning", found, "give the cameras at import ([files] metadata)", numbers)
    if not holds and not sky and not static:
        return Finding(ROW, "not decidable", "no ids of moving objects, and no cameras", "", numbers)
    names = [*(["what stands still"] if static else []), *(["the background"] if sky else []), *holds]
    return Finding(ROW, "ok", f"motion holds on {some(names, 6)}" if names else "nothing moves", "", numbers)


def _objects(checks: Sequence[SurfaceCheck], *, held: bool) -> Mapping[int, np.ndarray]:
    """Objects that are where the motion says, or that are not, -> how far off, of those seen in two frames or more."""
    found = {}
    for identity in sorted({i for check in checks for i in check.seen}):
        seen = sum(check.seen.get(identity, 0) for check in checks)
        table = np.sum([check.objects[identity] for check in checks if identity in check.objects], axis=0)
        displaced = [
            row
            for row, (share, gain, pixels, blocks) in zip(table, ELSEWHERE, strict=True)
            if row[0] > blocks * seen and row[2] < share * row[1] and row[1] - row[2] >= gain * row[0]
            if np.hypot(*row[3:]) >= pixels * row[0]
        ]
        if seen >= 2 and bool(displaced) != held:
            found[identity] = displaced[0][3:] / displaced[0][0] if displaced else np.zeros(2)
    return found
