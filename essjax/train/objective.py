"""What each stage minimises: ``Objective = (variables, clip) -> {term: weighted scalar}``.

A clip is unrolled twice, one frame apart, so that every inner frame is predicted as SS and as ESS, each from the
history that the alternation gives it at inference (ExtraSS section 4.5; docs/deviations.md says why not from one shared
history). Losses are on log(1 + x).
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p
from essjax.frames import Sequence, rendered_color
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
    sum_of_means,
    temporal_l1,
)
from essjax.methods.extrass import halve
from essjax.networks.blocks import nearest_upsample
from essjax.rollout import ESS, SS, alternate, unroll
from essjax.typing import Array, Callable, PyTree

Objective = Callable[[PyTree, Sequence], dict[str, Array]]


def both_kinds(method: Method, variables: PyTree, clip: Sequence, keep: Callable[[dict], PyTree]) -> dict[str, PyTree]:
    """Unroll ``clip`` twice, the second time from frame 1, side by side in one scan; both alternate SS, ESS, SS, ...

    Where one run renders the other extrapolates, so frames 1 ... T-2 are predicted as both kinds.

    Returns:
      kind -> ``keep(aux)`` of frames 1 ... T-2, time-major.
    """
    length = clip.frames.motion.shape[0]
    if length < 3 or length % 2 == 0:
        raise ValueError(f"clip: expected an odd number of frames >= 3 (SS/ESS pairs from 0 and from 1), got {length}.")
    runs = jax.tree.map(lambda leaf: jnp.stack([leaf[:-1], leaf[1:]], axis=1), clip.frames)
    runs = dataclasses.replace(runs, cut=runs.cut.at[0].set(True))
    rollout = unroll(method, variables, runs, alternate(0), train=True, keep=keep)

    def interleave(leaf: Array, first: int) -> Array:
        """Frames 1, 2, ...: from run ``first`` the pair k, then from the other run the pair k + 1 (or k)."""
        odd, even = leaf[:, first], leaf[:, 1 - first]
        # Run 0 renders frames 0, 2, ... and extrapolates 1, 3, ...; run 1 renders 1, 3, ... and extrapolates 2, 4, ...
        even = even[1:] if first == 1 else even[:-1]
        pairs = jnp.stack([odd[:-1], even], axis=1).reshape(-1, *odd.shape[1:])
        return jnp.concatenate([pairs, odd[-1:]])

    ordered = {SS: 1, ESS: 0}  # the run that has frame 1 as this kind
    return {kind: jax.tree.map(partial(interleave, first=run), rollout.aux[kind]) for kind, run in ordered.items()}


def frnet_objective(method: Method, network: Network, *, feature_weight: float = 0.001) -> Objective:
    """L_FR of ExtraSS eq 7-9: Charbonnier + census on the half-size output, census on features.

    Args:
      method: ``extrass_e``.
      network: its FRNet, whose encoder makes the ground truth's features.
      feature_weight: lambda of eq 9.
    """

    def objective(variables: PyTree, clip: Sequence) -> dict[str, Array]:
        predicted = both_kinds(method, variables, clip, keep=lambda aux: aux.get("extrapolated", {}))[ESS]
        target = log1p(halve(rendered_color(clip.frames, "frnet")[1:-1]))
        # The target's features are given: learned from this side too, they shrink until nothing differs.
        features, _ = network.apply(jax.lax.stop_gradient(variables["frnet"]), target, method="encode")
        distances = [feature_census(a, b) for a, b in zip(predicted.features, features, strict=True)]
        return {
            "charbonnier": jnp.mean(charbonnier(predicted.half, target)),
            "census": jnp.mean(census(predicted.half, target)),
            "feature_census": feature_weight * sum_of_means(distances),
        }

    return objective


def extrass_objective(
    method: Method,
    *,
    occlusion_weight: float = 1.0,
    vgg_weight: float = 0.01,
    temporal_weight: float = 1.0,
    vgg_features: Callable | None = None,
) -> Objective:
    """L of ExtraSS eq 11-14 over both kinds of every frame but the first.

    Args:
      method: ``extrass``.
      occlusion_weight: lambda_occ of eq 12.
      vgg_weight: lambda_vgg of eq 12; unused without ``vgg_features``.
      temporal_weight: lambda_t of eq 14.
      vgg_features: from ``losses.vgg16_features``, or None to leave that term out.
    """

    def keep(aux: dict) -> dict:
        return {name: aux[name] for name in ("log_image", "warped", "features")}

    def objective(variables: PyTree, clip: Sequence) -> dict[str, Array]:
        kinds = both_kinds(method, variables, clip, keep)
        target = log1p(clip.reference[1:-1])
        terms: dict[str, Array] = {}
        for kind, predicted in kinds.items():
            image, warped = predicted["log_image"], predicted["warped"]
            valid = warped.valid if clip.valid is None else nearest_upsample(clip.valid[1:-1], clip.scale)
            terms[f"l1_{kind}"] = jnp.mean(l1(image, target))
            terms[f"occlusion_{kind}"] = occlusion_weight * masked_mean(occlusion(image, target, 1 - valid), 1 - valid)
            history = temporal_l1(image, warped.log_image, warped.valid)
            terms[f"temporal_{kind}"] = temporal_weight * masked_mean(history, warped.valid)
            if vgg_features is not None:
                difference = perceptual(expm1(image), expm1(target), vgg_features)
                terms[f"vgg_{kind}"] = vgg_weight * sum_of_means(difference)
        # E1 follows E0: drawn to each other, both shrink to zero (experiments/LOG.md).
        levels = feature_l1(jax.lax.stop_gradient(kinds[SS]["features"]), kinds[ESS]["features"])
        terms["features"] = temporal_weight * sum_of_means(levels)
        return terms

    return objective
