"""The losses of ExtraSS's two stages.

A clip is unrolled once per phase, each time a frame later, so that frames are predicted as SS and as ESS, each from the
history that the schedule gives it at inference (ExtraSS section 4.5; docs/deviations.md says why not from one shared
history). FRNet's losses are on log(1 + x), those of ExtraSSNet on what a viewer sees (docs/deviations.md).
"""

import jax
import jax.numpy as jnp

from essjax.color import display, display_of_log1p, expm1, expose, log1p
from essjax.frames import Sequence, rendered_color, select_time
from essjax.interfaces import Method, Network
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
from essjax.train.objectives.common import (
    Objective,
    Phase,
    Recurrent,
    by_kind,
    every_phase,
    follow_every_phase,
    frame_mean,
    mean_of,
    since_cut,
    start_every_phase,
    whole_periods,
)
from essjax.typing import Array, Callable, PyTree
from essjax.warp import nearest_upsample


def frnet_objective(method: Method, *, feature_weight: float = 0.001, period: int = 2) -> Objective:
    """L_FR of ExtraSS eq 7-9: Charbonnier + census on the half-size output, census on features.

    Of frames that are extrapolated from two rendered ones of their shot: before, the two that FRNet compares are one
    and the same. Of a clip that is too short for such a frame, all.

    Args:
      method: ``extrass_e``; the encoder of its FRNet makes the ground truth's features.
      feature_weight: lambda of eq 9.
      period: one frame in so many is rendered; the means over its ``period - 1`` distances.
    """
    network = method.network("frnet")

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        clip = whole_periods(clip, period=period)
        keep = lambda aux: {name: aux[name] for name in ("extrapolated", "exposure") if name in aux}  # noqa: E731
        phases, state = every_phase(method, variables, clip, keep, period=period)
        terms = [_frnet_terms(network, variables, clip, phase, period, feature_weight) for phase in phases[1:]]
        return {name: mean_of(each[name] for each in terms) for name in terms[0]}, state

    return objective


def _frnet_terms(
    network: Network, variables: PyTree, clip: Sequence, phase: Phase, period: int, feature_weight: float
) -> dict[str, Array]:
    """Terms of the frames of one distance."""
    first = phase.distance + period  # the first frame of a shot that has two rendered ones
    skipped = first - phase.frames.start if first < phase.frames.stop else 0
    frames, kept = slice(phase.frames.start + skipped, phase.frames.stop), select_time(phase.kept, slice(skipped, None))
    predicted, color = kept["extrapolated"], rendered_color(clip.frames, "frnet")[frames]
    counts = since_cut(clip.frames.cut)[frames] >= (first if skipped else phase.distance)
    target = log1p(halve(expose(color, kept["exposure"])))
    # The target's features are given: learned from this side too, they shrink until nothing differs.
    features, _ = network.apply(jax.lax.stop_gradient(variables["frnet"]), target, method="encode")
    distances = [feature_census(a, b) for a, b in zip(predicted.features, features, strict=True)]
    return {
        "charbonnier": frame_mean(charbonnier(predicted.half, target), counts),
        "census": frame_mean(census(predicted.half, target), counts),
        "feature_census": feature_weight * sum(frame_mean(distance, counts) for distance in distances),
    }


RAMP = 8
"""Frames after a start until a frame counts in full: before, the network has seen too little to do better."""


def extrass_objective(
    method: Method,
    *,
    occlusion_weight: float = 1.0,
    vgg_weight: float = 0.01,
    temporal_weight: float = 1.0,
    vgg_features: Callable | None = None,
    period: int = 2,
) -> Recurrent:
    """L of ExtraSS eq 11-14 over the frames of a clip in every phase; features: where both encoders see history.

    Frame n after a cut has the weight (n + 1) / 8, at most 1. ESS frames that nothing was rendered for since the cut
    are no targets, for they are made of nothing; a cut itself has no holes. The terms of ESS frames are means over
    their distances to the last rendered frame.

    Args:
      method: ``extrass``.
      occlusion_weight: lambda_occ of eq 12.
      vgg_weight: lambda_vgg of eq 12; unused without ``vgg_features``.
      temporal_weight: lambda_t of eq 14.
      vgg_features: from ``losses.vgg16_features``, or None to leave that term out.
      period: one frame in so many is rendered.
    """

    def keep(aux: dict) -> dict:
        return {name: aux[name] for name in ("log_image", "warped", "features", "exposure")}

    def start(clip: Sequence) -> PyTree:
        return start_every_phase(method, clip, period=period)

    def phase_terms(clip: Sequence, phase: Phase) -> dict[str, Array]:
        part, predicted = select_time(clip, phase.frames), phase.kept
        since, warped = since_cut(clip.frames.cut)[phase.frames], predicted["warped"]
        weight = jnp.minimum((since + 1) / RAMP, 1.0)
        pixels = weight[..., None, None, None]
        image, before = display_of_log1p(predicted["log_image"]), display_of_log1p(warped.log_image)
        reference = expose(part.reference, predicted["exposure"])
        target = display(reference)
        valid = warped.valid if part.valid is None else nearest_upsample(part.valid, clip.size)
        hole = (1 - valid) * (since > 0)[..., None, None, None]
        counts = jnp.where(since >= phase.distance, weight, 0.0)
        change = temporal_l1(image, before, warped.valid)
        terms = {
            "l1": frame_mean(l1(image, target), counts),
            "occlusion": occlusion_weight * masked_mean(occlusion(image, target, hole), pixels * hole),
            "temporal": temporal_weight * masked_mean(change, pixels * warped.valid),
        }
        if vgg_features is not None:
            levels = perceptual(expm1(predicted["log_image"]), reference, vgg_features)
            terms["vgg"] = vgg_weight * sum(frame_mean(level, counts) for level in levels)
        return terms

    def follow(variables: PyTree, clip: Sequence, history: PyTree) -> tuple[dict[str, Array], PyTree, PyTree]:
        phases, state, history = follow_every_phase(method, variables, clip, keep, history, period=period)
        found = [phase_terms(clip, phase) for phase in phases]
        features = temporal_weight * _features_term(clip, phases, period)
        return {**by_kind(found), "features": features}, state, history

    return Recurrent(start, follow, period)


def _features_term(clip: Sequence, phases: list[Phase], period: int) -> Array:
    """Eq 13, over the frames that are there in every phase: ESS against SS, the mean over distances."""
    common = slice(phases[-1].frames.start, phases[0].frames.stop)
    since = since_cut(clip.frames.cut)[common]
    # Without the first rendered frames of a shot: as SS they start a run, so E0 sees no history there, and E1 does.
    weight = jnp.where(since >= period, jnp.minimum((since + 1) / RAMP, 1.0), 0.0)
    levels = [
        [level[common.start - phase.distance : common.stop - phase.distance] for level in phase.kept["features"]]
        for phase in phases
    ]
    # E1 follows E0: drawn to each other, both shrink to zero (experiments/LOG.md).
    rendered = jax.lax.stop_gradient(levels[0])
    return mean_of([sum(frame_mean(level, weight) for level in feature_l1(rendered, each)) for each in levels[1:]])
