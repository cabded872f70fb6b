"""A recipe says what a dump's files, channels and conventions are: a small TOML, read and checked here.

The presets are recipes too (``recipes/*.toml``); a user's recipe may change single keys of one. Every table of the
TOML is one dataclass of ``rules``.
"""

import dataclasses
import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

from essjax.buffers import BUFFERS
from essjax.data.importing.planes import STACKS
from essjax.data.importing.rules import (
    BaseColorRule,
    ColorRule,
    DepthRule,
    JitterRule,
    MotionRule,
    NormalRule,
    ReactiveRule,
    ScaleRule,
    WorldRule,
)

RECIPES = Path(__file__).parent / "recipes"
REQUIRED = ("color", "depth", "motion")
"""Images without which there is no dataset."""
IMAGES = (*BUFFERS, "written")
"""Images whose files and channels a recipe may name, "reference" aside; "written" is a mask, see ``MotionRule``."""
PACKED = ("motion", "depth")
"""Images that may be packed into bytes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """A whole recipe.

    Attributes:
      files: "frame" (where every image is that has no entry of its own), image names, "reference", "metadata" (JSON)
        -> path below the dump's folder, with {sequence} and {frame}.
      channels: image or "reference" -> channel names.
      optional: images that are left out where the dump does not have them.
    """

    files: Mapping[str, str]
    channels: Mapping[str, tuple[str, ...]]
    motion: MotionRule
    depth: DepthRule
    optional: tuple[str, ...] = ()
    jitter: JitterRule = JitterRule()
    color: ColorRule = ColorRule()
    normal: NormalRule = NormalRule()
    base_color: BaseColorRule = BaseColorRule()
    scale: ScaleRule = ScaleRule()
    world: WorldRule = WorldRule()
    reactive: ReactiveRule = ReactiveRule()

    @property
    def packings(self) -> dict[str, tuple[int, int]]:
        """Images that are packed into bytes -> D and D' of ``convert.unpack``."""
        found = {"motion": self.motion.packing, "depth": self.depth.packing}
        return {image: packing for image, packing in found.items() if packing is not None}

    def stacked(self, image: str) -> bool:
        """Whether one file holds all frames of an image."""
        return "{frame}" not in self.pattern(image)

    def pattern(self, image: str) -> str:
        """Where an image is; a reference without an entry is named as colour is."""
        default = self.files.get("color", self.files.get("frame", "")) if image == "reference" else ""
        return self.files.get(image, default or self.files.get("frame", ""))

    def record(self) -> dict[str, Any]:
        """All of it, as a dataset keeps it: JSON types."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: plain(item) for key, item in value.items()}
            return str(value) if value == float("inf") else value

        return plain(dataclasses.asdict(self))


POSITIVE = ("near", "far", "background", *(field.name for field in dataclasses.fields(ScaleRule)))
_TABLES = {
    "motion": MotionRule, "depth": DepthRule, "jitter": JitterRule, "color": ColorRule, "normal": NormalRule,
    "base_color": BaseColorRule, "scale": ScaleRule, "world": WorldRule, "reactive": ReactiveRule,
}  # fmt: skip


def _value(where: str, field: dataclasses.Field, value: Any) -> Any:
    choices = field.metadata.get("choices")
    if choices and value not in choices:
        raise ValueError(f"{where}: expected one of {', '.join(choices)}, got {value!r}.")
    if choices:
        return value
    if field.name == "resolution":
        if not (isinstance(value, list) and len(value) == 2 and all(type(v) is int and v > 0 for v in value)):
            raise ValueError(f"{where}: expected [width, height] in pixels, got {value!r}.")
        return tuple(value)
    if field.name == "packing":
        if not (isinstance(value, list) and len(value) == 2 and all(v in (255, 256) for v in value)):
            raise ValueError(f"{where}: expected [D, D'], each 255 or 256: (high + low / D) / D', got {value!r}.")
        return tuple(value)
    expected = bool if field.type is bool else int if field.type is int else float
    if isinstance(value, bool) != (expected is bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{where}: expected a {'true or false' if expected is bool else 'number'}, got {value!r}.")
    if expected is bool:
        return value
    number = _number(where, value, infinite=field.name in ("far", "background"))
    if expected is int and number != int(number):
        raise ValueError(f"{where}: expected a whole number, got {value!r}.")
    if field.name == "scale" and number == 0:
        raise ValueError(f"{where}: expected another number than 0.")
    lowest = 1 if field.name == "length" else 0
    if (field.name in ("first", "length") and number < lowest) or (field.name in POSITIVE and number <= 0):
        above = f"at least {lowest}" if expected is int else "above 0"
        raise ValueError(f"{where}: expected a number {above}, got {value!r}.")
    return expected(value)


def _number(where: str, value: int | float, *, infinite: bool) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if math.isnan(number) or (math.isinf(number) and not infinite):
        raise ValueError(f"{where}: expected a {'' if infinite else 'finite '}number, got {value!r}.")
    return number


def _rule(where: str, rule: type, content: Any) -> Any:
    if not isinstance(content, dict):
        raise ValueError(f"{where}: expected a table, got {content!r}.")
    fields = {field.name: field for field in dataclasses.fields(rule)}
    for key in content:
        if key not in fields:
            raise ValueError(f"{where}: there is no key {key!r}; the keys are {', '.join(fields)}.")
    for name, field in fields.items():
        if name not in content and field.default is dataclasses.MISSING:
            choices = ", ".join(field.metadata["choices"])
            raise ValueError(f"{where} {name}: missing. Say which it is, nothing is assumed: {choices}.")
    return rule(**{key: _value(f"{where} {key}", fields[key], value) for key, value in content.items()})


def _strings(where: str, content: Any, keys: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{where}: missing. Expected a table whose keys are among {', '.join(keys)}.")
    unknown = [key for key in content if key not in keys]
    if unknown:
        raise ValueError(f"{where}: there is no key {unknown[0]!r}; the keys are {', '.join(keys)}.")
    return content


def _files(where: str, content: Any) -> dict[str, str]:
    files = dict(_strings(where, content, ("frame", *IMAGES, "reference", "metadata")))
    for key, pattern in files.items():
        whole = isinstance(pattern, str) and (key == "metadata" or pattern.endswith(STACKS))
        if not isinstance(pattern, str) or ("{frame}" not in pattern and not whole):
            raise ValueError(
                f"{where} {key}: expected a path with {{frame}} in it, got {pattern!r}. Only {', '.join(STACKS)} may "
                "hold all frames."
            )
        if PurePath(pattern).is_absolute() or ".." in PurePath(pattern).parts or not pattern:
            raise ValueError(f"{where} {key}: expected a path below the dump's folder, got {pattern!r}.")
    if "frame" not in files and "color" not in files:
        raise ValueError(f"{where}: expected a pattern for frame (all images in one file) or for color.")
    return files


def _counts(image: str, content: Mapping[str, Any]) -> tuple[int, ...]:
    """How many channels of an image a recipe may name."""
    if image in PACKED and isinstance(content.get(image), dict) and "packing" in content[image]:
        return tuple(bytes_ * BUFFERS[image].channels for bytes_ in (2, 3, 4))
    if image == "reactive" and isinstance(content.get(image), dict) and content[image].get("kind") == "radiance":
        return (3,)
    return (1,) if image == "written" else (3,) if image == "reference" else (BUFFERS[image].channels,)


def _channels(where: str, content: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    channels = {}
    for image, names in _strings(where, content.get("channels"), (*IMAGES, "reference")).items():
        counts = _counts(image, content)
        if not (isinstance(names, list) and len(names) in counts and all(isinstance(n, str) for n in names)):
            count = " or ".join(map(str, counts))
            raise ValueError(f"{where} {image}: expected a list of {count} channel names, got {names!r}.")
        channels[image] = tuple(names)
    missing = [image for image in REQUIRED if image not in channels]
    if missing:
        raise ValueError(f"{where}: {', '.join(missing)} missing. Every dataset needs color, depth and motion.")
    channels.setdefault("reference", channels["color"])
    return channels


def make_recipe(content: Mapping[str, Any], where: str) -> Recipe:
    """Make a recipe from the content of its TOML.

    Raises:
      ValueError: begins with ``where``; names the table and key, what was expected and what came.
    """
    known = {"files", "channels", "optional", *_TABLES}
    unknown = [key for key in content if key not in known]
    if unknown:
        raise ValueError(f"{where}: there is no table {unknown[0]!r}; there are {', '.join(sorted(known))}.")
    channels = _channels(f"{where}: [channels]", content)
    optional = content.get("optional", [])
    names = [image for image in channels if image not in REQUIRED]
    if not isinstance(optional, list) or any(image not in names for image in optional):
        raise ValueError(f"{where}: optional: expected a list of images of [channels] but {', '.join(REQUIRED)}.")
    rules = {
        name: _rule(f"{where}: [{name}]", rule, content.get(name, {}))
        for name, rule in _TABLES.items()
        if name in content or name in ("motion", "depth")
    }
    files = _files(f"{where}: [files]", content.get("files"))
    recipe = Recipe(files=files, channels=channels, optional=tuple(optional), **rules)
    _check(recipe, where)
    return recipe


def _check(recipe: Recipe, where: str) -> None:
    for image in recipe.channels:
        if not recipe.pattern(image):
            raise ValueError(f"{where}: [files]: no pattern for {image}. Name its file, or give one for frame.")
    wants_metadata = recipe.jitter.source == "metadata" or recipe.color.pre_exposed
    if wants_metadata and "metadata" not in recipe.files:
        raise ValueError(f"{where}: [files] metadata: missing. jitter.source or color.pre_exposed ask for it.")
    if recipe.stacked("color") and any(not recipe.stacked(image) for image in recipe.channels):
        raise ValueError(f"{where}: [files]: color holds all frames in one file, so every image must. Split them.")
    motion, depth = recipe.motion, recipe.depth
    if motion.resolution is not None and motion.unit != "pixels":
        raise ValueError(f"{where}: [motion] resolution: only for the unit pixels, got {motion.unit}. Leave it out.")
    if depth.near is not None and depth.near >= depth.far:
        raise ValueError(f"{where}: [depth] near: expected less than far, {depth.far:g}, got {depth.near:g}.")
    if depth.zero_is_background and depth.kind not in ("linear", "distance"):
        raise ValueError(
            f"{where}: [depth] zero_is_background: only for the kinds linear and distance, got {depth.kind}, in which "
            "0 is the far plane (reversed) or the near one (forward). Leave it out."
        )


def _merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in change.items():
        old = base.get(key)
        merged[key] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise ValueError(f"{path}: expected a recipe in TOML, cannot read it ({error!s:.200}).") from error


def load_recipe(preset: str, recipe: str | os.PathLike | None = None) -> Recipe:
    """Load the recipe of a preset, with the keys that ``recipe`` changes; ``generic`` is ``recipe`` alone.

    Raises:
      ValueError: a file cannot be read, or a table or key is wrong or missing.
    """
    shipped = RECIPES / f"{preset}.toml"
    content = _read_toml(shipped) if preset != "generic" else {}
    if recipe is None:
        if preset == "generic":
            raise ValueError("the preset generic needs a recipe: --recipe my.toml (docs/guides/importing.md has one).")
        return make_recipe(content, preset)
    path = Path(recipe)
    return make_recipe(_merge(content, _read_toml(path)), str(path))
