"""Depth and cameras: whether they belong together, and what hides lies in front of what is hidden."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from essjax.cameras import Camera, camera_rays, pixel_positions
from essjax.data.check.finding import Finding
from essjax.data.check.motion import Look, rendered_errors
from essjax.data.check.normals import NormalCheck, judge_directions
from essjax.data.check.pairs import Step
from essjax.data.check.readings import camera_motion, jitter_step

AGREES = 0.01
"""Relative difference of two distances that counts as equal."""
NEARER = 0.1
"""Relative difference of depth that counts as in front of."""
ENOUGH = 100
"""Pixels for a verdict on depth."""
CLEAR = 0.58
"""Share of pixels for a verdict on the order of depth: 0.65 to 0.83 on real and built-in clips (silhouettes mix)."""
UNIT = 0.02
"""By which a normal's length may differ from 1."""
FAR = 1e6
"""Metres: a finite depth beyond it is a renderer's way to say background."""
STATIC = 0.1
"""Pixels: motion this close to that of the cameras agrees with it."""
MOST, HALF = 0.9, 0.5
"""Shares of the still pixels whose motion must be that of the cameras: below the first odd, below the second wrong."""
ROWS = ("depth", "cameras", "normals")


@dataclasses.dataclass
class GeometryCheck:
    """Over the frames of one sequence.

    Attributes:
      counts: pixels by what was found, see the functions that count.
      distances: one record per frame that has cameras and world positions, see ``compare_distances``.
      has_stencil: whether moving objects are marked.
      normals: their directions against the surfaces.
    """

    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    distances: list[dict[str, float]] = dataclasses.field(default_factory=list)
    has_stencil: bool = False
    normals: NormalCheck = dataclasses.field(default_factory=NormalCheck)

    def _count(self, found: Mapping[str, np.ndarray | int]) -> None:
        for name, where in found.items():
            self.counts[name] = self.counts.get(name, 0) + int(np.sum(where))

    def add_frame(self, step: Step) -> None:
        """Look at the buffers of one frame."""
        self.has_stencil = step.now.gbuffers.stencil is not None
        self._count(depth_defects(step.raw["depth"][..., 0]))
        camera, gbuffers = step.now.camera, step.now.gbuffers
        if camera is not None and gbuffers.world_position is not None:
            found = compare_distances(camera, np.asarray(gbuffers.world_position), np.asarray(gbuffers.depth)[..., 0])
            self.distances += [found] if found else []
        if gbuffers.normal is not None:
            self._count(normal_defects(np.asarray(gbuffers.normal), camera))
            self.normals.add(step)

    def add_pair(self, step: Step, looked: Look) -> None:
        """Look at what hides what in the frame before, and at motion against cameras."""
        self._count(occlusion_order(step, looked.motions[0] + jitter_step(step)))
        expected = camera_motion(step)
        if expected is None:
            return
        off = np.linalg.norm(expected - looked.motions[0], axis=-1) > STATIC
        static = np.isfinite(step.now.gbuffers.depth[..., 0])
        if step.now.gbuffers.stencil is not None:
            static &= step.now.gbuffers.stencil[..., 0] == 0
        self._count({"static": static, "off camera": static & off})


def depth_defects(depth: np.ndarray) -> dict[str, np.ndarray]:
    """Masks: all pixels, depth < 0, depth <= 0, finite depth beyond ``FAR``."""
    return {
        "pixels": np.ones_like(depth, bool),
        "negative": depth < 0,
        "not positive": depth <= 0,
        "far": np.isfinite(depth) & (depth > FAR),
    }


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    rank = lambda values: values.argsort().argsort().astype(np.float64)
    return float(np.corrcoef(rank(a), rank(b))[0, 1])


def compare_distances(camera: Camera, position: np.ndarray, depth: np.ndarray) -> dict[str, float]:
    """Depth against the distance of world positions along the optical axis.

    Returns:
      ``order``: rank correlation, -1 if near is large; ``ratio``: median of depth over distance; shares of pixels
      that agree: ``same``, ``scaled`` (after division by the ratio), ``along ray`` (with the distance to the camera's
      centre). Empty if there are too few pixels.
    """
    pose = np.asarray(camera.camera_to_world)
    offset = position - pose[:3, 3]
    distance, length = -(offset @ pose[:3, 2]), np.linalg.norm(offset, axis=-1)
    surface = np.isfinite(depth) & (np.abs(position).max(axis=-1) > 0) & (distance > 0) & (depth > 0)
    if surface.sum() < ENOUGH:
        return {}
    depth, distance, length = depth[surface], distance[surface], length[surface]
    ratio = float(np.median(depth / distance))
    share = lambda expected: float((np.abs(depth / expected - 1) < AGREES).mean())
    return {
        "order": _rank_correlation(depth, distance),
        "ratio": ratio,
        "same": share(distance),
        "scaled": share(distance * ratio),
        "along ray": share(length),
    }


def normal_defects(normal: np.ndarray, camera: Camera | None) -> dict[str, np.ndarray]:
    """Masks: normals that are not zero, off unit length, with a negative component, and towards or off the camera."""
    length = np.linalg.norm(normal, axis=-1)
    there = length > 0
    found = {
        "normals": there,
        "off length": there & (np.abs(length - 1) > UNIT),
        "negative component": there & (normal < -0.01).any(axis=-1),
    }
    if camera is not None:
        rays = np.asarray(camera_rays(camera, pixel_positions(*normal.shape[:2])))
        towards = -(rays @ np.asarray(camera.camera_to_world)[:3, :3].T)
        cosine = (normal * towards).sum(axis=-1) / np.linalg.norm(towards, axis=-1)
        found |= {"seen": there, "faces away": there & (cosine < -0.1)}
    return found


def occlusion_order(step: Step, lookup: np.ndarray) -> dict[str, int]:
    """Ask of pixels that two surfaces of this frame come from whether the one that they show is the nearer one.

    Colour says which one it shows. Depths of one frame are compared, so a moving camera does not matter.

    Args:
      step: with a frame before.
      lookup: ``[H, W, 2]`` motion between the jittered frames, pixels.
    """
    (height, width), depth = step.size, np.asarray(step.now.gbuffers.depth)[..., 0].ravel()
    y, x = np.mgrid[:height, :width] + 0.5
    column, row = np.floor(x + lookup[..., 0]).astype(int).ravel(), np.floor(y + lookup[..., 1]).astype(int).ravel()
    pixels = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    source = (row * width + column)[pixels]
    order = np.lexsort((depth[pixels], source))
    pixels, source = pixels[order], source[order]
    starts = np.append(True, source[1:] != source[:-1])[: source.size]
    near, far = pixels[starts], pixels[np.roll(starts, -1)]  # of each group of one source
    apart = depth[far] > depth[near] * (1 + NEARER)
    error = rendered_errors(step, lookup).ravel()
    difference = (error[far] - error[near])[apart]
    return {"shows nearer": int((difference > 0).sum()), "shows farther": int((difference < 0).sum())}


def _sum(checks: Sequence[GeometryCheck], name: str) -> int:
    return sum(check.counts.get(name, 0) for check in checks)


REVERSED = (
    "depth is reversed (near is large): for a reversed infinite z-buffer, depth = near / value, at import (recipe: "
    "kind in [depth])"
)


def _judge_distances(records: list[dict[str, float]]) -> Finding:
    median = {key: float(np.median([record[key] for record in records])) for key in records[0]}
    numbers = {key: round(value, 4) for key, value in median.items()}
    row = lambda verdict, found, fix="": Finding(ROWS[0], verdict, found, fix, numbers)
    if median["same"] > 0.9:
        return row("ok", f"agrees with cameras and world positions in {median['same']:.1%} of the pixels")
    if median["order"] < -0.5:
        return row("wrong", f"falls with distance (rank correlation {median['order']:.2f})", REVERSED)
    if median["along ray"] > 0.9:
        return row(
            "wrong",
            "is the distance to the camera",
            "depth lies along the ray: multiply it by the ray's cosine (recipe: kind in [depth])",
        )
    if median["scaled"] > 0.9:
        found = f"is {median['ratio']:.4g} times the distance of the world positions"
        return row("wrong", found, f"depth and positions have different units: divide depth by {median['ratio']:.4g}")
    found = f"agrees with cameras and world positions in {median['same']:.1%} of the pixels only"
    if median["order"] > 0.9:
        return row("wrong", found, "depth is not linear: convert the z-buffer to view-space z at import")
    return row(
        "wrong", found, "are world positions and camera_to_world (looks along -Z, y up) of this frame, in metres?"
    )


def _judge_order(nearer: int, farther: int) -> Finding:
    numbers = {"nearer": nearer, "farther": farther}
    if nearer + farther < ENOUGH:
        return Finding(
            ROWS[0], "not decidable", "nothing hides anything, and there are no world positions", "", numbers
        )
    share = nearer / (nearer + farther)
    found = f"what hides is the nearer surface in {share:.0%} of {nearer + farther} pixels"
    if share < 1 - CLEAR:
        return Finding(ROWS[0], "wrong", found, REVERSED, numbers)
    if share < CLEAR:
        return Finding(
            ROWS[0], "not decidable", found, "is depth that of this frame? Check a clip with more motion", numbers
        )
    return Finding(ROWS[0], "ok", found, "", numbers)


def _judge_depth(checks: Sequence[GeometryCheck], motion_wrong: bool) -> Finding:
    records = [record for check in checks for record in check.distances]
    pixels, negative, not_positive = (_sum(checks, name) for name in ("pixels", "negative", "not positive"))
    if negative:
        fix = "depth is positive view-space z: negate it at import if -z is stored"
        return Finding(ROWS[0], "wrong", f"is negative in {negative / pixels:.1%} of the pixels", fix)
    if records:
        result = _judge_distances(records)
    elif motion_wrong:
        result = Finding(ROWS[0], "not decidable", "the motion is wrong", "put the motion right, then check again")
    else:
        result = _judge_order(_sum(checks, "shows nearer"), _sum(checks, "shows farther"))
    if result.verdict == "wrong":
        return result
    if not_positive:
        fix = "depth is positive view-space z: if 0 is the background, write it as +inf"
        return Finding(ROWS[0], "wrong", f"is 0 in {not_positive / pixels:.1%} of the pixels", fix, result.numbers)
    if _sum(checks, "far"):
        found = f"{_sum(checks, 'far') / pixels:.1%} of the pixels are beyond {FAR:g} m"
        return Finding(ROWS[0], "warning", found, "if this is the background, write it as +inf", result.numbers)
    return result


def _judge_cameras(checks: Sequence[GeometryCheck], depth: Finding, motion_wrong: bool) -> Finding:
    static, off = _sum(checks, "static"), _sum(checks, "off camera")
    if not static:
        return Finding(ROWS[1], "not decidable", "no cameras, or nothing that stands still")
    if motion_wrong or depth.verdict == "wrong":
        what = "motion" if motion_wrong else "depth"
        return Finding(ROWS[1], "not decidable", f"the {what} is wrong", f"put the {what} right, then check again")
    numbers = {"agreeing": round(1 - off / static, 4)}
    found = f"explain the motion of {1 - off / static:.1%} of the pixels that stand still, to {STATIC} px"
    agreeing, marked = 1 - off / static, all(check.has_stencil for check in checks)
    if agreeing >= MOST:
        return Finding(ROWS[1], "ok", found, "", numbers)
    fix = "" if marked else "nothing marks what moves by itself (stencil): is it that much of the picture? Else: "
    fix += (
        "is camera_to_world row-major, looking along -Z with y up? focal and center in LR pixels? motion and camera of "
        "the same frame?"
    )
    return Finding(ROWS[1], "wrong" if marked and agreeing < HALF else "warning", found, fix, numbers)


def _judge_normals(checks: Sequence[GeometryCheck], depth: Finding) -> Finding:
    there, off, seen = (_sum(checks, name) for name in ("normals", "off length", "seen"))
    if not there:
        return Finding(ROWS[2], "not decidable", "there are none")
    numbers = {"off length": round(off / there, 4)}
    if off > 0.05 * there:
        found = f"{off / there:.1%} of the normals are not of unit length"
        encoded = not _sum(checks, "negative component")
        fix = (
            "normals are encoded in [0, 1]: n = 2 v - 1 at import (recipe: encoding in [normal])"
            if encoded
            else "divide them by their length at import"
        )
        return Finding(ROWS[2], "wrong", found, fix, numbers)
    directions = None if depth.verdict == "wrong" else judge_directions([check.normals for check in checks])
    if directions is not None:
        return directions
    away = _sum(checks, "faces away")
    if seen and away > 0.2 * seen:
        found = f"{away / seen:.0%} look away from the camera"
        return Finding(ROWS[2], "warning", found, "are they in world space, in the axes of the cameras?", numbers)
    found = f"unit length in {1 - off / there:.1%}" + (f", {1 - away / seen:.1%} face the camera" if seen else "")
    return Finding(ROWS[2], "ok", found, "", numbers)


def judge_geometry(checks: Sequence[GeometryCheck], *, motion_wrong: bool) -> list[Finding]:
    """Judge depth, cameras and normals."""
    depth = _judge_depth(checks, motion_wrong)
    return [depth, _judge_cameras(checks, depth, motion_wrong), _judge_normals(checks, depth)]
