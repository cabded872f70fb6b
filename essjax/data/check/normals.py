"""Normals: whether they stand on the surfaces of depth and cameras, and if not, how they were meant."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from essjax.cameras import pixel_positions, unproject
from essjax.data.check.finding import Finding
from essjax.data.check.pairs import Step
from essjax.data.check.surfaces import interior

ROW = "normals"
AGREES, AGREES_BETTER, GAIN = 0.93, 0.93, 0.06
"""Median cosine between stated normals and those of the surface below which they are questioned; that of a reading that
is believed; and by how much it must be better."""
ENOUGH = 200
"""Pixels."""
FIXES = {
    "as stated": "",
    "unsigned": "normals are encoded in [0, 1]: n = 2 v - 1 at import (recipe: encoding 'unsigned' in [normal])",
    "signed": "normals are in [-1, 1], and were decoded as if in [0, 1]: take them as they are (recipe: encoding "
    "'signed' in [normal])",
    "negated": "normals point into the surfaces: negate them at import",
    "y negated": "normals are of a left-handed world: negate y at import (recipe: handedness in [world])",
    "z up": "normals have y and z exchanged (a world with z up, cameras with y up): (x, z, -y) at import",
    "y up": "normals have y and z exchanged (a world with y up, cameras with z up): (x, -z, y) at import",
    "of the camera": "normals are in camera space: turn them by camera_to_world at import",
}
"""Reading -> what to do if it fits the surfaces best."""


def readings(normal: np.ndarray, pose: np.ndarray) -> dict[str, list[np.ndarray]]:
    """Map each reading to what the normals ``[n, 3]`` then are; two candidates where a length is lost."""
    x, y, z = normal.T
    total = normal.sum(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(total**2 - 2)
        # m = (n + 1) / 2 of length s, of which m / s is stored: |2 s m' - 1| = 1 has two solutions s.
        unsigned = [(total + sign * root) * normal - 1 for sign in (1, -1)]
        # m = 2 n - 1 of length t, of which m / t is stored: |(t m' + 1) / 2| = 1.
        signed = [0.5 * ((np.sqrt(total**2 + 1) - total) * normal + 1)]
    return {
        "as stated": [normal],
        "unsigned": unsigned,
        "signed": signed,
        "negated": [-normal],
        "y negated": [normal * [1, -1, 1]],
        "z up": [np.stack([x, z, -y], axis=-1)],
        "y up": [np.stack([x, -z, y], axis=-1)],
        "of the camera": [normal @ pose[:3, :3].T],
    }


@dataclasses.dataclass
class NormalCheck:
    """Over the frames of one sequence: reading -> cosines with the normals of the surfaces."""

    cosines: dict[str, list[np.ndarray]] = dataclasses.field(default_factory=dict)

    def add(self, step: Step) -> None:
        """Compare the normals of a frame with the slope of the surfaces that its depth describes."""
        normal, camera = step.now.gbuffers.normal, step.now.camera
        if normal is None or camera is None:
            return
        positions = pixel_positions(*step.size, jnp.asarray(step.now.jitter))
        points = np.asarray(unproject(camera, positions, jnp.asarray(step.now.gbuffers.depth)))
        right, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
        slope = np.cross(down, right)  # y points down in the image: towards the camera
        length = np.linalg.norm(slope, axis=-1)
        where = interior(step.now.gbuffers) & (length > 1e-9) & (np.asarray(normal) != 0).any(axis=-1)
        where &= np.isfinite(step.now.gbuffers.depth[..., 0])
        where[:2], where[-2:], where[:, :2], where[:, -2:] = False, False, False, False
        slope = slope[where] / length[where][:, None]
        for name, candidates in readings(np.asarray(normal)[where], np.asarray(camera.camera_to_world)).items():
            cosine = [np.nan_to_num((candidate * slope).sum(axis=-1), nan=-1.0) for candidate in candidates]
            self.cosines.setdefault(name, []).append(np.max(cosine, axis=0))


def judge_directions(checks: Sequence[NormalCheck]) -> Finding | None:
    """Judge whether the normals fit the surfaces; None if they do, or nothing can tell."""
    names = [name for name in FIXES if any(name in check.cosines for check in checks)]
    if not names:
        return None
    joined = {name: np.concatenate([c for check in checks for c in check.cosines.get(name, [])]) for name in names}
    if joined["as stated"].size < ENOUGH:
        return None
    fit = {name: float(np.median(cosines)) for name, cosines in joined.items()}
    best = max(fit, key=lambda name: fit[name])
    numbers = {name: round(value, 3) for name, value in fit.items()}
    if fit["as stated"] >= AGREES or fit[best] < AGREES_BETTER or fit[best] < fit["as stated"] + GAIN:
        return None
    found = (
        f"'{best}' fits the surfaces (median cosine {fit[best]:.2f}), as stated they do not ({fit['as stated']:.2f})"
    )
    return Finding(ROW, "wrong", found, FIXES[best], numbers)
