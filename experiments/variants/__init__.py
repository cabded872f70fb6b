"""Variants that ``--variant`` can name, by paper, and what a run compares them with."""

from collections.abc import Sequence

from experiments.variants import baselines, classifier, dlctus, extranet, extrass, fasset, interpolation, nsrr
from experiments.variants.base import Stage, Task, Variant

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
    """Find the variant called ``name``.

    Raises:
      ValueError: unknown; lists the valid names.
    """
    if name not in VARIANTS:
        raise ValueError(f"unknown variant {name!r}; choose one of {', '.join(VARIANTS)}.")
    return VARIANTS[name]


def trained_as(name: str) -> str:
    """Name the variant whose training and settings ``name`` takes: its own, unless only its steps differ."""
    return get_variant(name).weights or name


def compared(names: Sequence[str]) -> tuple[str, ...]:
    """All rows of a run of ``names``: the baselines, the variants' parts, and themselves last."""
    parts = [part for name in names for part in get_variant(name).parts]
    return tuple(n for n in dict.fromkeys((*BASELINES, *parts)) if n not in names) + tuple(dict.fromkeys(names))


__all__ = ["BASELINES", "VARIANTS", "Stage", "Task", "Variant", "compared", "get_variant", "trained_as"]
