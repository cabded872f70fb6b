"""What ``--variant`` can name, by paper, and what a run compares it with."""

import dataclasses
from collections.abc import Sequence

from essjax.train import constant
from experiments.config import Config, make_config
from experiments.variants import baselines, classifier, dlctus, extranet, extrass, fasset, interpolation, nsrr
from experiments.variants.base import Stage, Variant

VARIANTS: dict[str, Variant] = {
    **extrass.VARIANTS,
    **extranet.VARIANTS,
    **fasset.VARIANTS,
    **dlctus.VARIANTS,
    **nsrr.VARIANTS,
    **interpolation.VARIANTS,
    **classifier.VARIANTS,
    **baselines.VARIANTS,
}
"""Every variant by name."""

BASELINES = ("warp", "warp-blur", "extrass-w", "bilinear", "bicubic", "jau", "taau-half", "taau", "taa")
"""Rows of every table."""


def get_variant(name: str) -> Variant:
    """The variant called ``name``.

    Raises:
      ValueError: unknown; lists the valid names.
    """
    if name not in VARIANTS:
        raise ValueError(f"unknown variant {name!r}; choose one of {', '.join(VARIANTS)}.")
    return VARIANTS[name]


def trained_as(name: str) -> str:
    """The variant whose training ``name`` takes: its own, unless only its steps differ."""
    return get_variant(name).weights or name


def stages_of(name: str, config: Config) -> list[Stage]:
    """The training stages behind a variant; without ``config.anneal`` their learning rates do not decay."""
    stages = get_variant(trained_as(name)).stages(config)
    return stages if config.anneal else [dataclasses.replace(stage, decay=constant) for stage in stages]


def config_of(name: str, preset: str, overrides: list[str]) -> Config:
    """The settings of a run of ``name``: the preset, what the variant changes in it, then ``--set``."""
    variant = get_variant(trained_as(name))
    config = make_config(preset, overrides, variant.presets)
    if preset not in variant.crops or any(override.startswith("crop=") for override in overrides):
        return config
    side = variant.crops[preset] // config.scale
    return dataclasses.replace(config, crop=(side, side))


def compared(names: Sequence[str]) -> tuple[str, ...]:
    """All rows of a run of ``names``: the baselines, the variants' parts, and themselves last."""
    parts = [part for name in names for part in get_variant(name).parts]
    return tuple(n for n in dict.fromkeys((*BASELINES, *parts)) if n not in names) + tuple(dict.fromkeys(names))


def describe() -> dict[str, str]:
    """Name -> summary, for ``--list``."""
    return {name: variant.summary for name, variant in VARIANTS.items()}
