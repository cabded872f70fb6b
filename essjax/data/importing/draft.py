"""A first recipe for a dump that nobody described: which file is what, and what ranges of values say about encodings.

What the pictures have to decide (sign, axes and unit of motion, the kind of depth, jitter) starts at a default here,
and is tried by ``essjax.data.guess``.
"""

import dataclasses
from collections.abc import Set
from typing import Any

import numpy as np

from essjax.data.importing import convert
from essjax.data.importing.inventory import COUNTS, Group, Inventory

CERTAIN, LIKELY, UNKNOWN = "certain", "likely", "unknown"
SHARE = 0.005
"""Share of the pixels that hold exactly the same extreme value: a background."""


@dataclasses.dataclass
class Draft:
    """A recipe in the making.

    Attributes:
      content: as in the TOML.
      notes: ``table.key`` -> (how sure, why).
    """

    content: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: dict[str, tuple[str, str]] = dataclasses.field(default_factory=dict)

    def set(self, table: str, key: str, value: Any, sure: str = "", why: str = "") -> None:
        """Set a key; with ``sure``, say how sure and why."""
        self.content.setdefault(table, {})[key] = value
        if sure:
            self.notes[f"{table}.{key}"] = (sure, why)


def _fraction(plane: np.ndarray) -> np.ndarray:
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(plane.dtype, 1)
    return np.asarray(plane, np.float32) / full


def _roughness(plane: np.ndarray) -> float:
    """Mean difference of neighbours: high bytes of a packed number are smooth, low ones are noise."""
    values = np.asarray(plane, np.float64)
    return float(np.abs(np.diff(values, axis=1)).mean())


def _choose(inventory: Inventory) -> dict[str, Group]:
    """Image -> its channels: by name, what is left by size and number."""
    chosen: dict[str, Group] = {}
    pictures = [
        group for group in inventory.groups if group.role in ("color", "reference", "") and len(group.planes) >= 3
    ]
    for group in inventory.groups:
        if group.role and group.role not in ("color", "reference") and len(group.planes) >= COUNTS.get(group.role, 1):
            chosen.setdefault(group.role, group)
    named = [group for group in pictures if group.role == "color"] or [g for g in pictures if g.role == ""] or pictures
    if named:
        chosen["color"] = min(named, key=lambda group: group.size[0])
        others = [g for g in pictures if g is not chosen["color"] and g.size[0] % chosen["color"].size[0] == 0]
        named = [g for g in others if g.role == "reference"] or [g for g in others if g.size > chosen["color"].size]
        if named:
            chosen["reference"] = max(named, key=lambda group: group.size[0])
    return chosen


def make_draft(inventory: Inventory) -> Draft:
    """Make the first recipe.

    Raises:
      ValueError: colour, depth or motion is not found; says which files there are.
    """
    draft, chosen = Draft(), _choose(inventory)
    missing = [image for image in ("color", "depth", "motion") if image not in chosen]
    if missing:
        there = ", ".join(sorted({group.pattern for group in inventory.groups}))
        raise ValueError(
            f"no name says which file is {' and which '.join(missing)}; there are {there}. Rename them (depth, motion, "
            "color), or write the recipe by hand: docs/guides/importing.md has one."
        )
    for image, group in chosen.items():
        draft.set("files", image, group.pattern, CERTAIN if group.role == image else LIKELY, "by its name")
    if inventory.metadata:
        draft.set("files", "metadata", inventory.metadata, CERTAIN, "the JSON with frames")
    for image, group in chosen.items():
        _channels(draft, image, group)
    _motion(draft, chosen["motion"])
    _depth(draft, chosen["depth"], inventory.fields)
    _colors(draft, chosen)
    if "normal" in chosen:
        _normals(draft, chosen["normal"])
    for image in ("roughness", "metallic", "specular", "n_dot_v"):
        if image in chosen and float(_fraction(chosen[image].planes[0]).max()) > 1.5:
            draft.set("scale", image, 1 / 255, LIKELY, "values up to 255")
    optional = [image for image in chosen if image not in ("color", "depth", "motion", "reference")]
    if optional:
        draft.content["optional"] = optional
    return draft


def _channels(draft: Draft, image: str, group: Group) -> None:
    draft.set("channels", image, list(group.channels[: COUNTS.get(image, 1)]))


def _packing(group: Group, components: int) -> tuple[list[str], list[int]] | None:
    """Channels, high byte first, and D, D' of a number in bytes; None: it is not packed."""
    count = len(group.planes) // components if components > 1 else len(group.planes)
    planes = group.planes[: components * count]
    flat = all(np.array_equal(planes[0], plane) for plane in planes[1:])
    if not group.bytes or count < 2 or flat:
        return None
    names = list(group.channels[: components * count])
    if components == 1 and np.asarray(planes[-1]).min() == 255:  # an alpha that says nothing
        names, planes, count = names[:-1], planes[:-1], count - 1
    if components == 1 and _roughness(planes[-1]) < _roughness(planes[0]):
        names, planes = names[::-1], planes[::-1]
    low = [plane for start in range(0, len(planes), count) for plane in planes[start + 1 : start + count]]
    base = 256 if any((plane == 255).any() for plane in low) else 255  # of base 255, 254 is the largest digit
    return names, [base, base]


def _motion(draft: Draft, group: Group) -> None:
    for key, value in (("sign", "previous-current"), ("y", "down"), ("unit", "pixels")):
        draft.set("motion", key, value)
    packed = _packing(group, 2)
    if packed is not None:
        names, packing = packed
        draft.set("channels", "motion", names, LIKELY, "bytes of x, then of y, high one first")
        draft.set("motion", "packing", packing, LIKELY, "by the largest low byte")
        values = convert.unpack(np.stack(group.planes, axis=-1), 2, *packing)
    else:
        values = np.stack([_fraction(plane) for plane in group.planes[:2]], axis=-1)
    low, high, middle = float(values.min()), float(values.max()), float(np.median(values))
    if low >= 0 and high <= 1 and abs(middle - 0.5) < 0.2:
        draft.set(
            "motion", "zero", 0.5, CERTAIN if low < 0.5 < high else LIKELY, f"values {low:.3f} to {high:.3f} around 0.5"
        )


def _depth(draft: Draft, group: Group, known: Set[str]) -> None:
    packed = _packing(group, 1)
    if packed is not None:
        names, packing = packed
        draft.set("channels", "depth", names, LIKELY, "bytes, high one first")
        draft.set("depth", "packing", packing, LIKELY, "by the largest low byte")
        values = convert.unpack(np.stack([group.planes[group.channels.index(n)] for n in names], -1), 1, *packing)[
            ..., 0
        ]
    else:
        values = _fraction(group.planes[0])
    finite = values[np.isfinite(values)]
    low, high, middle = float(finite.min()), float(finite.max()), float(np.median(finite))
    if high <= 0 and low < 0:
        draft.set("depth", "scale", -1.0, CERTAIN, "values are negative")
        low, high, finite = -high, -low, -finite
    if high > 1.0 + 1e-6 or not np.isfinite(values).all():
        draft.set("depth", "kind", "linear", LIKELY, f"values {low:.3g} to {high:.3g}")
        top = finite >= high
        if SHARE < top.mean() < 1 and high > 1.5 * np.max(finite[~top], initial=0):
            draft.set(
                "depth", "background", float(f"{0.99 * high:.4g}"), CERTAIN, f"{top.mean():.0%} of it is {high:.6g}"
            )
        if (finite == 0).mean() > SHARE:
            draft.set("depth", "zero_is_background", True, LIKELY, f"{(finite == 0).mean():.0%} of it is 0")
        return
    kind = "reversed" if middle < 0.5 else "forward"
    if (finite == 0).mean() > SHARE or (finite == 1).mean() > SHARE:
        kind = "reversed" if (finite == 0).mean() > (finite == 1).mean() else "forward"
    clear = middle < 0.3 if kind == "reversed" else middle > 0.7
    draft.set(
        "depth", "kind", kind, LIKELY if clear else UNKNOWN, f"values {low:.3g} to {high:.3g}, half below {middle:.3g}"
    )
    if "near" not in known:
        draft.set("depth", "near", 0.1, UNKNOWN, "the near plane, which no picture shows: all depths scale with it")


def _colors(draft: Draft, chosen: dict[str, Group]) -> None:
    group = chosen["color"]
    top = max(float(np.nanmax(np.where(np.isfinite(plane), plane, 0))) for plane in group.planes[:3])
    if group.bytes:
        draft.set("color", "encoding", "srgb", LIKELY, "8 bits: pictures of 8 bits are as good as always sRGB")
    elif top > 1 and group.planes[0].dtype != np.uint16:
        draft.set("color", "encoding", "linear", LIKELY, f"radiance up to {top:.3g}")
    else:
        draft.set("color", "encoding", "linear", UNKNOWN, "nothing exceeds 1: it may be tone mapped or sRGB")
    if "base_color" in chosen:
        encoding = "srgb" if chosen["base_color"].bytes else "linear"
        draft.set("base_color", "encoding", encoding, UNKNOWN, "both look alike; bytes are mostly sRGB, floats linear")
        if max(float(_fraction(plane).max()) for plane in chosen["base_color"].planes[:3]) > 1.5:
            draft.set("scale", "base_color", 1 / 255, LIKELY, "values up to 255")


def _normals(draft: Draft, group: Group) -> None:
    vectors = np.stack([_fraction(plane) for plane in group.planes[:3]], axis=-1)
    there = np.abs(vectors).max(axis=-1) > 1e-3
    signed, unsigned = (np.linalg.norm(v, axis=-1)[there] for v in (vectors, 2 * vectors - 1))
    off = [float(np.median(np.abs(length - 1))) if length.size else 1.0 for length in (signed, unsigned)]
    encoding = "signed" if off[0] <= off[1] else "unsigned"
    sure = CERTAIN if min(off) < 0.02 < 0.1 < max(off) else LIKELY
    draft.set("normal", "encoding", encoding, sure, f"then half of them are within {min(off):.2g} of unit length")
