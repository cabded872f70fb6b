"""The rows of a run, each variant resolved once: its settings, its method, its training."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from essjax.interfaces import Method
from experiments.settings import SHARED, Settings, parse_override
from experiments.variants import VARIANTS, Stage, compared, get_variant, trained_as


class Member(NamedTuple):
    """One row of a run.

    Attributes:
      name: of the variant.
      settings: of its training; of a part, those of the variant that it is part of.
      method: what is run.
      stages: that its variables come from, in order; none for a heuristic.
      folder: of the run, or where the checkpoints and logs of its training lie.
      owner: the variant in whose training its variables are made; "" for a heuristic.
    """

    name: str
    settings: Settings
    method: Method
    stages: tuple[Stage, ...]
    folder: Path
    owner: str = ""


def settings_of(name: str, preset: str, overrides: Sequence[str] = (), others: Sequence[str] = ()) -> Settings:
    """Resolve the settings of a run of ``name``: the preset, what the variant changes in it, then ``--set``.

    Args:
      name: of the variant.
      preset: its name.
      overrides: of the command line, ``[VARIANT:]path=value``; those of other variants are left out.
      others: variants in the same run.

    Raises:
      ValueError: unknown variant, preset or path, or a bad value.
    """
    base = trained_as(name)
    values = {}
    for override in overrides:
        variant, path, value = parse_override(override)
        if variant and variant not in {base, *map(trained_as, others)}:
            raise ValueError(
                f"--set {override}: {variant!r} is not trained in this run; expected one of "
                f"{', '.join(dict.fromkeys((base, *map(trained_as, others))))}."
            )
        if variant and path.split(".")[0] in SHARED:
            raise ValueError(f"--set {override}: all variants of a run have this in common. Leave {variant}: away.")
        if variant in ("", base):
            values[path] = value
    try:
        return get_variant(base).settings(preset, values)
    except ValueError as error:
        hint = f" To set it for one variant alone: VARIANT:path=value. ({base})" if others else ""
        raise ValueError(f"{error}{hint}") from error


def all_settings(names: Sequence[str], preset: str, overrides: Sequence[str]) -> dict[str, Settings]:
    """Resolve those of each variant of a run, see ``settings_of``."""
    return {name: settings_of(name, preset, overrides, [other for other in names if other != name]) for name in names}


def resolve(settings: Mapping[str, Settings], preset: str, out: Path) -> dict[str, Member]:
    """Every row of a run, in the order of its table.

    Args:
      settings: variant -> its settings, of those that must have a row.
      preset: its name, for the rows that they are compared with.
      out: folder of the run; several variants train in ``out / "variants" / NAME``.
    """
    wanted: dict[str, Member] = {}
    for name, own in settings.items():
        base, folder = trained_as(name), out if len(settings) == 1 else out / "variants" / trained_as(name)
        stages = next((member.stages for member in wanted.values() if member.owner == base), None)
        wanted[name] = _member(name, own, folder, stages)
    shared = next(iter(settings.values()))
    return {
        row: wanted[row] if row in wanted else _compared(row, wanted, shared, preset, out)
        for row in compared(list(wanted))
    }


def _member(name: str, settings: Settings, folder: Path, stages: tuple[Stage, ...] | None = None) -> Member:
    variant, base = VARIANTS[name], VARIANTS[trained_as(name)]
    method = variant.method(settings)
    if stages is None:
        whole = base.method(settings) if variant.weights else method
        stages = tuple(recipe.stage(entry, settings, whole) for entry, recipe in base.stages.items())
    return Member(name, settings, method, stages, folder, trained_as(name) if stages else "")


def _compared(row: str, wanted: Mapping[str, Member], shared: Settings, preset: str, out: Path) -> Member:
    """Make a row that nobody asked for: of a training's variables, a part, a baseline, or an untrained part."""
    variant = VARIANTS[row]
    for member in wanted.values():
        renamed = VARIANTS[member.name].parts.get(row)
        if member.owner and (member.owner == variant.weights or renamed is not None):
            entries = VARIANTS[trained_as(row)].stages
            stages = tuple(stage for stage in member.stages if stage.name in entries)
            return Member(
                row, member.settings, variant.method(member.settings, renamed), stages, member.folder, member.owner
            )
    own = variant.settings(preset, {})
    same: dict[str, Any] = {group: getattr(shared, group) for group in SHARED}
    return _member(row, dataclasses.replace(own, **same), out)._replace(stages=(), owner="")
