"""Which of several readings of the data explains the pictures best: pairwise, where the two differ."""

import dataclasses
import math
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from essjax.data.check.finding import Finding
from essjax.typing import Array

DIFFERENT = 0.25
"""Pixels of the rendered frame: where two readings look less far apart than this, no picture can tell them apart."""
ENOUGH = 400
"""Pixels, over all frames, in which two readings must differ."""
PIXELS = 65536
"""Pixels of the frames that are compared in full; of larger ones every second, third, ... row and column is."""
REGION, CLEAR = 40, 0.2
"""Pixels that a part of the picture needs to have an opinion, and dB that make one."""
AGREEMENT, WORSE, SUBSTANTIAL = 0.75, 2.0, 0.08
"""Share of the opinions (by pixels) that must be for another reading; by how many dB, in what share of the pixels, it
must not be worse."""
MARGIN = 0.5
"""dB by which one reading must beat another. Right ones beat wrong ones by 1 to 20 dB on real and built-in clips."""


def decibel(error: float, other: float) -> float:
    """By how much ``error`` is below ``other``, both absolute errors, dB."""
    return float(20 * np.log10((other + 1e-9) / (error + 1e-9)))


@jax.jit
def _pairwise(errors: Array, x: Array, y: Array, usable: Array) -> tuple[Array, Array]:
    """``count`` and ``error`` of one frame ``[N, H, W]``."""

    def against_all(a: Array) -> tuple[Array, Array]:
        apart = jnp.maximum(jnp.abs(x - x[a]), jnp.abs(y - y[a])) >= DIFFERENT
        where = apart & usable & usable[a]
        return where.sum(axis=(1, 2)), jnp.where(where, errors[a], 0.0).sum(axis=(1, 2))

    return jax.lax.map(against_all, jnp.arange(errors.shape[0]))


@dataclasses.dataclass
class Comparison:
    """Sums over frames of the errors of N readings; the first one is what the dataset states.

    Errors are absolute, not squared, so that the few pixels that nothing explains (disocclusions, moving shadows,
    mirror images) do not outweigh the many that the right reading explains.

    Attributes:
      names: of the readings.
      count: ``[N, N]`` pixels where two readings look at different places, both of them inside the image.
      error: ``[N, N]`` ``error[a, b]``: sum over those pixels of a's error.
      regions: part of the picture -> ``[3, N]``: pixels in which the stated reading and another one differ, the errors
        of the stated one there, and of the other one.
    """

    names: tuple[str, ...]
    count: np.ndarray = dataclasses.field(init=False)
    error: np.ndarray = dataclasses.field(init=False)
    regions: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        shape = (len(self.names), len(self.names))
        self.count, self.error = np.zeros(shape), np.zeros(shape)

    def add(
        self, errors: np.ndarray, lookups: np.ndarray, usable: np.ndarray, regions: np.ndarray | None = None
    ) -> None:
        """Add one frame.

        Args:
          errors: ``[N, H, W]`` absolute error of each reading.
          lookups: ``[N, H, W, 2]`` where each reading looks, pixels of the rendered frame.
          usable: ``[N, H, W]`` bool, where the reading has something to look at.
          regions: ``[H, W]`` int, parts of the picture; None: it is not divided.
        """
        stride = max(1, math.isqrt(usable[0].size // PIXELS))
        thin = lambda image: np.ascontiguousarray(image[:, ::stride, ::stride])
        errors, x, y, usable = thin(errors), thin(lookups[..., 0]), thin(lookups[..., 1]), thin(usable)
        count, error = _pairwise(errors, x, y, usable)
        self.count += np.asarray(count)
        self.error += np.asarray(error)
        if regions is not None:
            self._add_regions(errors, np.maximum(abs(x - x[0]), abs(y - y[0])), usable, thin(regions[None])[0])

    def _add_regions(self, errors: np.ndarray, apart: np.ndarray, usable: np.ndarray, regions: np.ndarray) -> None:
        names, index = np.unique(regions, return_inverse=True)
        index = index.ravel()
        for other in np.flatnonzero(usable.any(axis=(1, 2))):
            with np.errstate(invalid="ignore"):
                where = ((apart[other] >= DIFFERENT) & usable[other] & usable[0]).ravel()
            weights = [where, *(where * np.nan_to_num(errors[which].ravel()) for which in (0, other))]
            sums = [np.bincount(index, weight, minlength=len(names)) for weight in weights]
            for name, row in zip(names, np.stack(sums, axis=-1), strict=True):
                self.regions.setdefault(int(name), np.zeros((3, len(self.names))))[:, other] += row

    def supported(self, other: int) -> bool:
        """Whether the parts of the picture agree that another reading is better, and no well-textured one is worse."""
        rows = np.array([table[:, other] for table in self.regions.values()])
        rows = rows[rows[:, 0] >= REGION] if len(rows) else rows
        if not len(rows):
            return True
        margins = np.array([decibel(error, stated) for _, stated, error in rows])
        weights = rows[:, 0] / rows[:, 0].sum()
        better, worse = weights[margins >= CLEAR].sum(), weights[margins <= -CLEAR].sum()
        textured = (margins <= -WORSE) & (weights >= SUBSTANTIAL)
        return bool(better >= AGREEMENT * (better + worse) and not textured.any())

    def decidable(self, a: int, b: int) -> bool:
        """Whether the two readings differ in enough pixels."""
        return self.count[a, b] >= ENOUGH

    def margin(self, a: int, b: int) -> float:
        """How much better reading a is than b, dB, on the pixels where they differ; 0 if those are too few."""
        return decibel(self.error[a, b], self.error[b, a]) if self.decidable(a, b) else 0.0

    def best(self) -> int:
        """Return the stated reading if none beats it; else, of those that do, the first un- or least beaten one."""
        n = len(self.names)
        better = [a for a in range(1, n) if self.margin(a, 0) >= MARGIN]
        worst = {a: min(self.margin(a, b) for b in range(n) if b != a) for a in better}
        unbeaten = [a for a in better if worst[a] > -MARGIN]
        return unbeaten[0] if unbeaten else max(better, key=lambda a: worst[a], default=0)

    def rivals(self) -> list[int]:
        """List the readings that can be told from the stated one, closest first."""
        return sorted((b for b in range(1, len(self.names)) if self.decidable(0, b)), key=lambda b: self.margin(0, b))


def total(comparisons: Iterable[Comparison]) -> Comparison:
    """Add the comparisons of several sequences up."""
    comparisons = list(comparisons)
    result = Comparison(comparisons[0].names)
    result.count = np.sum([c.count for c in comparisons], axis=0)
    result.error = np.sum([c.error for c in comparisons], axis=0)
    for comparison in comparisons:
        for name, table in comparison.regions.items():
            result.regions[name] = result.regions.get(name, 0) + table
    return result


def judge(
    check: str,
    comparisons: Iterable[Comparison],
    fixes: Mapping[str, str],
    nothing: str,
    *,
    ignore: tuple[str, ...] = (),
    right: int | None = None,
    proof: str = "",
) -> Finding:
    """Judge several sequences together.

    Args:
      check: name of the row.
      comparisons: one per sequence.
      fixes: reading -> what to do if it is the right one.
      nothing: what to say if no reading can be told from the stated one.
      ignore: readings whose being different does not make the stated one decidable.
      right: the reading that is known to be right; None: the pictures are asked.
      proof: how it is known.
    """
    comparison = total(comparisons)
    names, rivals, best = comparison.names, comparison.rivals(), comparison.best()
    numbers = {names[b]: round(comparison.margin(0, b), 2) for b in rivals}
    if right:
        found = f"'{names[right]}' is right: {proof}"
        if best == right:
            found += f"; it explains the pictures better by {comparison.margin(best, 0):.1f} dB"
        return Finding(check, "wrong", found, fixes[names[right]], numbers)
    if best and right == 0:
        gain = comparison.margin(best, 0)
        found = (
            f"{proof}; '{names[best]}' explains the pictures better by {gain:.1f} dB, as mirror images, shadows and "
            "what is seen beside silhouettes can"
        )
        return Finding(check, "ok", found, "", numbers)
    if best and not comparison.supported(best):
        found = f"parts of the picture disagree on '{names[best]}' ({comparison.margin(best, 0):.1f} dB in all)"
        return Finding(check, "not decidable", found, "look at the warped pictures (--pictures)", numbers)
    if best:
        found = (
            f"'{names[best]}' explains the pictures better than what is stated, by {comparison.margin(best, 0):.1f} dB"
        )
        return Finding(check, "wrong", found, fixes[names[best]], numbers)
    if not [b for b in rivals if names[b] not in ignore]:  # nothing to tell it from, even if it is proved
        return Finding(check, "not decidable", nothing, "", numbers)
    closest = rivals[0]
    if comparison.margin(0, closest) < MARGIN and right == 0:
        return Finding(check, "ok", proof, "", numbers)
    if comparison.margin(0, closest) < MARGIN:
        found = f"as stated and '{names[closest]}' explain the pictures equally well (within {MARGIN} dB)"
        return Finding(check, "not decidable", found, "check a clip with more texture and motion", numbers)
    found = (
        f"as stated beats {len(rivals)} alternatives, the next ('{names[closest]}') by {numbers[names[closest]]:.1f} dB"
    )
    unknown = [name for name in ("x flipped", "y flipped") if name not in numbers]
    if unknown:
        found += f"; too little motion to tell '{unknown[0]}' from it"
    return Finding(check, "ok", found, "", numbers)
