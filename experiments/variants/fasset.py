"""FASSET, its ablations (Table 4), and what it is compared with (Table 2)."""

import dataclasses
from functools import partial

from essjax import methods
from essjax.interfaces import Method
from essjax.train import fasset_objective, halving
from essjax.train.objectives.extranet import reference_shading
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget
from experiments.variants.extranet import PRESETS as EXTRANET_PRESETS
from experiments.variants.extranet import extranet_stage
from experiments.variants.nsrr import nsrr_stage

EPOCHS, EPOCHS_PER_HALVING = 150, 30
"""Of the paper (section 3.4)."""
PRESETS = {
    "smoke": {"first_width": 16, "occlusion_weight": 5.0},
    "quick": {
        "batch": 2, "width": 12, "first_width": 32, "learning_rate": 2e-3, "occlusion_weight": 0.3, "seconds": 590.0,
    },
    "paper": {
        "batch": 8, "first_width": 128, "learning_rate": 1e-3, "occlusion_weight": 5.0, "steps": EPOCHS * 900,
    },
}  # fmt: skip
"""``first_width`` are RenderINR's neurons: at output size they are most of the work."""


def _variant(summary: str, **options: bool) -> Variant:
    def method(config: Config) -> Method:
        return methods.fasset(scale=config.scale, width=config.width, hidden=config.first_width, **options)

    def stages(config: Config) -> list[Stage]:
        objective = fasset_objective(method(config), hole_weight=config.occlusion_weight)
        decay = partial(halving, times=EPOCHS // EPOCHS_PER_HALVING)
        return [
            Stage("fasset", method(config), objective, config.batch, config.learning_rate, main_budget(config), decay)
        ]

    return Variant(summary, method, stages, presets=PRESETS)


TWO_STAGE_PRESETS = {
    "smoke": {"clip": 6},
    "quick": {
        "clip": 9, "first_batch": 8, "first_seconds": 145.0, "occlusion_weight": 1.0,
        "learning_rate": 1e-3, "vgg_weight": 0.1, "seconds": 145.0,
    },
    "paper": {
        "clip": 9, "first_learning_rate": 1e-3, "first_steps": EPOCHS * 900,
        "batch": 8, "width": 32, "learning_rate": 1e-4, "vgg_weight": 0.1, "steps": EPOCHS * 900,
    },
}  # fmt: skip
"""First ExtraNet, then NSRR; the paper trains both for as many epochs as its own network."""


def _extranet_nsrr(config: Config) -> Method:
    return methods.extranet_nsrr(scale=config.scale, width=config.width)


def _two_stages(config: Config) -> list[Stage]:
    first = dataclasses.replace(
        config,
        batch=config.first_batch,
        learning_rate=config.first_learning_rate,
        steps=config.first_steps,
        seconds=config.first_seconds,
    )
    return [
        extranet_stage(first, methods.extranet()),
        nsrr_stage(config, half=True, within=_extranet_nsrr(config)),
    ]


def _plus_stage(config: Config) -> list[Stage]:
    stage = extranet_stage(config, methods.extranet_plus(scale=config.scale), target_shading=reference_shading)
    return [dataclasses.replace(stage, name="extranet_plus")]


VARIANTS = {
    "fasset": _variant("FASSET: one network supersamples and extrapolates, at any output size"),
    "fasset-no-gencoder": _variant("FASSET whose RenderINR reads the G-buffers themselves", gencoder=False),
    "fasset-no-mask": _variant("FASSET without holes in rendered frames", mask_rendered=False),
    "fasset-no-sharing": _variant("FASSET with a FrameEncoder for each task", shared=False),
    "extranet+nsrr": Variant(
        "ExtraNet at low resolution, then NSRR on every frame",
        _extranet_nsrr,
        _two_stages,
        parts=("nsrr+extranet",),
        presets=TWO_STAGE_PRESETS,
    ),
    "nsrr+extranet": Variant(
        "NSRR on rendered frames, then ExtraNet at output resolution with upsampled G-buffers",
        lambda config: methods.nsrr_extranet(scale=config.scale, width=config.width),
        weights="extranet+nsrr",
    ),
    "extranet-plus": Variant(
        "ExtraNet at output resolution on zero-upsampled frames",
        lambda config: methods.extranet_plus(scale=config.scale),
        _plus_stage,
        presets={**EXTRANET_PRESETS, "quick": {**EXTRANET_PRESETS["quick"], "batch": 2}},
    ),
}
