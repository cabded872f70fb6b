"""Objective of FASSET (section 3.4): every frame of a clip as SS and as ESS, see ``every_phase``."""

from essjax.color import expose, log1p
from essjax.frames import Sequence, select_time
from essjax.interfaces import Method
from essjax.losses import hardest, l1, masked_mean, occlusion
from essjax.train.objectives.common import (
    Objective,
    Phase,
    by_kind,
    every_phase,
    frame_mean,
    since_cut,
    whole_periods,
)
from essjax.typing import Array, PyTree
from essjax.warp import nearest_upsample


def fasset_objective(
    method: Method,
    *,
    hole_weight: float = 5.0,
    hard_weight: float = 1.0,
    share: float = 0.1,
    period: int = 2,
) -> Objective:
    """L of FASSET eq 5 on log(1 + x), against the anti-aliased reference; of ESS frames the mean over distances.

    Args:
      method: ``fasset`` at the reference's scale.
      hole_weight: W_hole of eq 5. Holes are the renderer's exact ones, else the network's own, at output size. A cut
        has none, and ESS frames for which nothing was rendered since are no targets: they are made of nothing.
      hard_weight: W_hard of eq 5; eq 4 divides by all pixels, not by k.
      share: k of eq 4 over the number of pixels.
      period: one frame in so many is rendered.
    """

    def phase_terms(clip: Sequence, phase: Phase) -> dict[str, Array]:
        part, predicted = select_time(clip, phase.frames), phase.kept
        age = since_cut(clip.frames.cut)[phase.frames]
        target = log1p(expose(part.reference, predicted["exposure"]))
        errors = l1(predicted["log_image"], target)
        valid = predicted["valid"] if part.valid is None else part.valid
        hole = (1.0 - nearest_upsample(valid, clip.size)) * (age > 0)[..., None, None, None]
        counts = age >= phase.distance
        return {
            "l1": frame_mean(errors, counts),
            "hole": hole_weight * masked_mean(occlusion(predicted["log_image"], target, hole), hole),
            "hard": hard_weight * frame_mean(errors * hardest(errors, share=share), counts),
        }

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        clip = whole_periods(clip, period=period)
        keep = lambda aux: {name: aux[name] for name in ("log_image", "valid", "exposure")}  # noqa: E731
        phases, state = every_phase(method, variables, clip, keep, period=period)
        found = [phase_terms(clip, phase) for phase in phases]
        return by_kind(found), state

    return objective
