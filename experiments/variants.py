"""What ``--variant`` can name: each a method with its training stages, and what a run compares it with."""

import dataclasses
from collections.abc import Callable
from typing import Any

from essjax import methods
from essjax.interfaces import Method
from essjax.losses import vgg16_features
from essjax.networks import frnet
from essjax.train import Budget, extrass_objective, frnet_objective
from essjax.train.objective import Objective
from experiments.config import Config


@dataclasses.dataclass(frozen=True)
class Stage:
    """One training stage of a variant.

    Attributes:
      name: also the entry of the variables that it trains; the others are frozen.
      method: the method that is unrolled.
      objective: what is minimised.
      batch: clips per step.
      learning_rate: its peak.
      budget: when it ends.
    """

    name: str
    method: Method
    objective: Objective
    batch: int
    learning_rate: float
    budget: Budget


@dataclasses.dataclass(frozen=True)
class Variant:
    """One name of ``--variant``.

    Attributes:
      summary: one line for ``--list``.
      method: from the settings of a run.
      stages: its training, in order; none for a heuristic.
      tuned: its alpha, sigma and clamp are chosen on the validation frames.
    """

    summary: str
    method: Callable[..., Method]
    stages: Callable[[Config], list[Stage]] = lambda config: []
    tuned: bool = False


def _extrass_e(config: Config) -> Method:
    return methods.extrass_e(width=config.frnet_width)


def _extrass(config: Config) -> Method:
    return methods.extrass(width=config.width, frnet_width=config.frnet_width, scale=config.scale)


def _frnet_stage(config: Config) -> Stage:
    method = _extrass_e(config)
    return Stage(
        "frnet",
        method,
        frnet_objective(method, frnet(config.frnet_width), feature_weight=config.feature_weight),
        config.frnet_batch,
        config.frnet_learning_rate,
        Budget(config.frnet_steps, config.frnet_seconds),
    )


def _extrass_stage(config: Config) -> Stage:
    method = _extrass(config)
    objective = extrass_objective(
        method,
        occlusion_weight=config.occlusion_weight,
        vgg_weight=config.vgg_weight,
        temporal_weight=config.temporal_weight,
        vgg_features=vgg16_features(config.vgg) if config.vgg else None,
    )
    budget = Budget(config.steps, config.seconds)
    return Stage("extrassnet", method, objective, config.batch, config.learning_rate, budget)


VARIANTS: dict[str, Variant] = {
    "extrass": Variant(
        "ExtraSS: G-buffer guided warp, FRNet, ExtraSSNet; every frame at twice the size from half of the frames",
        _extrass,
        lambda config: [_frnet_stage(config), _extrass_stage(config)],
    ),
    "extrass-e": Variant(
        "guided warp + FRNet, extrapolates at low resolution", _extrass_e, lambda config: [_frnet_stage(config)]
    ),
    "extrass-w": Variant("G-buffer guided warp only, extrapolates at low resolution", lambda c: methods.extrass_w()),
    "warp": Variant("plain warp of the last rendered frame, low resolution", lambda c: methods.warp()),
    "warp-blur": Variant(
        "the same of a frame blurred by 0.5 px: what denoising alone is worth", lambda c: methods.warp(blur=0.5)
    ),
    "bilinear": Variant("bilinear upscaling of each rendered frame", lambda c: methods.bilinear(c.scale)),
    "bicubic": Variant("bicubic upscaling of each rendered frame", lambda c: methods.bicubic(c.scale)),
    "jau": Variant("jitter-aligned bilinear upscaling", lambda c: methods.jau(c.scale)),
    "taau": Variant(
        "temporal anti-aliasing with upsampling on every frame (twice the input)",
        lambda c, **settings: methods.taau(c.scale, **settings),
        tuned=True,
    ),
    "taau-half": Variant(
        "the same on rendered frames, its output warped in between",
        lambda c, **settings: methods.taau_half(c.scale, **settings),
        tuned=True,
    ),
    "taa": Variant(
        "temporal anti-aliasing at native resolution (the reference that costs four times the pixels)",
        lambda c, **settings: methods.taa(**settings),
        tuned=True,
    ),
}
"""Every variant by name."""

BASELINES = ("warp", "warp-blur", "extrass-w", "bilinear", "bicubic", "jau", "taau-half", "taau", "taa")
"""Rows of every table; ``extrass`` adds ``extrass-e``, whose FRNet is part of it."""
PARTS = {"extrass": ("extrass-e",)}
"""Variants whose variables a trained one contains."""
REFERENCES = {
    "taau": "gets every frame rendered: twice the input",
    "taa": "gets every frame rendered at native resolution: eight times the input",
}
"""Rows that are not on equal terms, and why."""


def get_variant(name: str) -> Variant:
    """The variant called ``name``.

    Raises:
      ValueError: unknown; lists the valid names.
    """
    if name not in VARIANTS:
        raise ValueError(f"unknown variant {name!r}; choose one of {', '.join(VARIANTS)}.")
    return VARIANTS[name]


def compared(name: str) -> tuple[str, ...]:
    """Names of all rows of a run of ``name``, itself last."""
    get_variant(name)
    return tuple(n for n in (*BASELINES, *PARTS.get(name, ())) if n != name) + (name,)


def describe() -> dict[str, Any]:
    """Name -> summary, for ``--list``."""
    return {name: variant.summary for name, variant in VARIANTS.items()}
