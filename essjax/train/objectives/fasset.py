"""Objective of FASSET (section 3.4): every inner frame of a clip as SS and as ESS, see ``both_kinds``."""

from essjax.color import expose, log1p
from essjax.frames import Sequence
from essjax.interfaces import Method
from essjax.losses import hardest, l1, masked_mean, occlusion
from essjax.networks.blocks import nearest_upsample
from essjax.rollout import ESS
from essjax.train.objectives.common import Objective, both_kinds, frame_mean, odd_length, since_cut
from essjax.typing import Array, PyTree


def fasset_objective(
    method: Method, *, hole_weight: float = 5.0, hard_weight: float = 1.0, share: float = 0.1
) -> Objective:
    """L of FASSET eq 5 on log(1 + x), against the anti-aliased reference.

    Args:
      method: ``fasset`` at the reference's scale.
      hole_weight: W_hole of eq 5. Holes are the renderer's exact ones, else the network's own, at output size. A cut
        has none, and is no ESS target: it is made of nothing.
      hard_weight: W_hard of eq 5; eq 4 divides by all pixels, not by k.
      share: k of eq 4 over the number of pixels.
    """

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        clip = odd_length(clip)
        keep = lambda aux: {name: aux[name] for name in ("log_image", "valid", "exposure")}  # noqa: E731
        kinds, state = both_kinds(method, variables, clip, keep)
        age = since_cut(clip.frames.cut)[1:-1]
        terms: dict[str, Array] = {}
        for kind, predicted in kinds.items():
            target = log1p(expose(clip.reference[1:-1], predicted["exposure"]))
            errors = l1(predicted["log_image"], target)
            valid = predicted["valid"] if clip.valid is None else clip.valid[1:-1]
            hole = (1.0 - nearest_upsample(valid, clip.scale)) * (age > 0)[..., None, None, None]
            counts = age >= (kind == ESS)
            terms[f"l1_{kind}"] = frame_mean(errors, counts)
            terms[f"hole_{kind}"] = hole_weight * masked_mean(occlusion(predicted["log_image"], target, hole), hole)
            terms[f"hard_{kind}"] = hard_weight * frame_mean(errors * hardest(errors, share=share), counts)
        return terms, state

    return objective
