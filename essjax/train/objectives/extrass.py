"""The losses of ExtraSS's two stages.

A clip is unrolled twice, one frame apart, so that every inner frame is predicted as SS and as ESS, each from the
history that the alternation gives it at inference (ExtraSS section 4.5; docs/deviations.md says why not from one shared
history). FRNet's losses are on log(1 + x), those of ExtraSSNet on what a viewer sees (docs/deviations.md).
"""

import jax
import jax.numpy as jnp

from essjax.color import display, display_of_log1p, expm1, expose, log1p
from essjax.frames import Sequence, rendered_color
from essjax.interfaces import Method
from essjax.losses import (
    census,
    charbonnier,
    feature_census,
    feature_l1,
    l1,
    masked_mean,
    occlusion,
    perceptual,
    temporal_l1,
)
from essjax.methods.extrass_low import halve
from essjax.networks.blocks import nearest_upsample
from essjax.rollout import ESS, SS
from essjax.train.objectives.common import (
    Objective,
    Recurrent,
    both_kinds,
    follow_both_kinds,
    frame_mean,
    odd_length,
    since_cut,
    start_both_kinds,
)
from essjax.typing import Array, Callable, PyTree

WITH_TWO_PICTURES = 3
"""The first frame of a shot that each run extrapolates from two rendered frames: at 1 and 2 both are the same one."""


def frnet_objective(method: Method, *, feature_weight: float = 0.001) -> Objective:
    """L_FR of ExtraSS eq 7-9: Charbonnier + census on the half-size output, census on features.

    From the fourth frame of a shot on: before, the two rendered frames that FRNet compares are one and the same. Of
    three frames, where only frame 1 is extrapolated, that one.

    Args:
      method: ``extrass_e``; the encoder of its FRNet makes the ground truth's features.
      feature_weight: lambda of eq 9.
    """
    network = method.network("frnet")

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        clip = odd_length(clip)
        keep = lambda aux: {name: aux[name] for name in ("extrapolated", "exposure") if name in aux}  # noqa: E731
        kinds, state = both_kinds(method, variables, clip, keep)
        length = clip.frames.motion.shape[0]
        first = WITH_TWO_PICTURES if length > WITH_TWO_PICTURES + 1 else 1
        kept = jax.tree.map(lambda leaf: leaf[first - 1 :], kinds[ESS])  # kinds begin at frame 1
        predicted, color = kept["extrapolated"], rendered_color(clip.frames, "frnet")[first:-1]
        counts = since_cut(clip.frames.cut)[first:-1] >= first
        target = log1p(halve(expose(color, kept["exposure"])))
        # The target's features are given: learned from this side too, they shrink until nothing differs.
        features, _ = network.apply(jax.lax.stop_gradient(variables["frnet"]), target, method="encode")
        distances = [feature_census(a, b) for a, b in zip(predicted.features, features, strict=True)]
        terms = {
            "charbonnier": frame_mean(charbonnier(predicted.half, target), counts),
            "census": frame_mean(census(predicted.half, target), counts),
            "feature_census": feature_weight * sum(frame_mean(distance, counts) for distance in distances),
        }
        return terms, state

    return objective


RAMP = 8
"""Frames after a start until a frame counts in full: before, the network has seen too little to do better."""


def extrass_objective(
    method: Method,
    *,
    occlusion_weight: float = 1.0,
    vgg_weight: float = 0.01,
    temporal_weight: float = 1.0,
    vgg_features: Callable | None = None,
) -> Recurrent:
    """L of ExtraSS eq 11-14 over both kinds of every inner frame of a clip; features: where both encoders see history.

    Frame n after a cut has the weight (n + 1) / 8, at most 1. A cut itself is no ESS target, for it is made of nothing,
    and has no holes.

    Args:
      method: ``extrass``.
      occlusion_weight: lambda_occ of eq 12.
      vgg_weight: lambda_vgg of eq 12; unused without ``vgg_features``.
      temporal_weight: lambda_t of eq 14.
      vgg_features: from ``losses.vgg16_features``, or None to leave that term out.
    """

    def keep(aux: dict) -> dict:
        return {name: aux[name] for name in ("log_image", "warped", "features", "exposure")}

    def start(clip: Sequence) -> PyTree:
        return start_both_kinds(method, clip)

    def follow(variables: PyTree, clip: Sequence, history: PyTree) -> tuple[dict[str, Array], PyTree, PyTree]:
        kinds, state, history = follow_both_kinds(method, variables, clip, keep, history)
        since = since_cut(clip.frames.cut)[1:-1]
        weight = jnp.minimum((since + 1) / RAMP, 1.0)
        pixels = weight[..., None, None, None]
        terms: dict[str, Array] = {}
        for kind, predicted in kinds.items():
            warped = predicted["warped"]
            image, before = display_of_log1p(predicted["log_image"]), display_of_log1p(warped.log_image)
            reference = expose(clip.reference[1:-1], predicted["exposure"])
            target = display(reference)
            valid = warped.valid if clip.valid is None else nearest_upsample(clip.valid[1:-1], clip.scale)
            hole = (1 - valid) * (since > 0)[..., None, None, None]
            counts = jnp.where(since > 0, weight, 0.0) if kind == ESS else weight
            terms[f"l1_{kind}"] = frame_mean(l1(image, target), counts)
            terms[f"occlusion_{kind}"] = occlusion_weight * masked_mean(occlusion(image, target, hole), pixels * hole)
            change = temporal_l1(image, before, warped.valid)
            terms[f"temporal_{kind}"] = temporal_weight * masked_mean(change, pixels * warped.valid)
            if vgg_features is not None:
                levels = perceptual(expm1(predicted["log_image"]), reference, vgg_features)
                terms[f"vgg_{kind}"] = vgg_weight * sum(frame_mean(level, counts) for level in levels)
        # Without the frame after a cut: as SS it starts a run, so E0 sees no history there, and E1 does.
        weight = jnp.where(since > 1, weight, 0.0)
        # E1 follows E0: drawn to each other, both shrink to zero (experiments/LOG.md).
        levels = feature_l1(jax.lax.stop_gradient(kinds[SS]["features"]), kinds[ESS]["features"])
        terms["features"] = temporal_weight * sum(frame_mean(level, weight) for level in levels)
        return terms, state, history

    return Recurrent(start, follow)
