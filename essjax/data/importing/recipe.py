"""A recipe says what a dump's files, channels and conventions are: a small TOML, read and checked here.

The presets are recipes too (``recipes/*.toml``); a user's recipe may change single keys of one. Every table of the
TOML is one dataclass below; docs/guides/importing.md shows a complete one.
"""

import dataclasses
import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

from essjax.buffers import BUFFERS

RECIPES = Path(__file__).parent / "recipes"
REQUIRED = ("color", "depth", "motion")
"""Images without which there is no dataset."""
IMAGES = tuple(BUFFERS)


def _choice(*values: str, default: str | None = None) -> Any:
    given: Any = {} if default is None else {"default": default}
    return dataclasses.field(metadata={"choices": values}, **given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionRule:
    """``[motion]``: ``channels.motion`` names x first.

    Attributes:
      sign: which difference of positions is stored.
      y: where a positive y points.
      unit: "uv" is of the image's size, "ndc" of half of it.
      x: where a positive x points.
      scale: what the stored values are multiplied with first.
      resolution: (width, height) of the image whose pixels the unit "pixels" means; None: its own.
      encoding: "plain": none. "unreal4", "unreal5": the velocity texture of that engine, the second with a square root;
        pixels it left out move with the cameras. "unreal-mrq": Movie Render Queue's MotionVectors pass.
      jittered: the difference of the two frames' jitter is in it, and is taken out.
      dilated: each pixel holds its nearest neighbour's motion. It cannot be undone; it is recorded.
    """

    sign: str = _choice("previous-current", "current-previous")
    y: str = _choice("down", "up")
    unit: str = _choice("pixels", "uv", "ndc")
    x: str = _choice("right", "left", default="right")
    scale: float = 1.0
    resolution: tuple[int, int] | None = None
    encoding: str = _choice("plain", "unreal4", "unreal5", "unreal-mrq", default="plain")
    jittered: bool = False
    dilated: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthRule:
    """``[depth]``.

    Attributes:
      kind: "linear": view-space z; "distance": along the pixel's ray; "reversed": near plane 1, far plane 0; "forward":
        near plane 0, far plane 1; "metadata": one of the last two, as the metadata says.
      near: near plane of the last two, in the dump's unit; the metadata's, if it has one, goes first.
      far: far plane; infinite by default.
      scale: metres per unit of the dump; negative where z is negative in front of the camera.
      background: metres from which on it is background (sky); it becomes +inf. So does 65504, where half ends, of the
        first two kinds.
      zero_is_background: of the first two kinds, 0 is background too.
    """

    kind: str = _choice("linear", "distance", "reversed", "forward", "metadata")
    near: float | None = None
    far: float = float("inf")
    scale: float = 1.0
    background: float = float("inf")
    zero_is_background: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class JitterRule:
    """``[jitter]``.

    Attributes:
      source: "none"; "metadata": per frame; "halton": Halton (2, 3), ``first`` the element of the frame numbered 0,
        starting again after ``length`` frames.
      sign: "sample": the samples lie at pixel centre + jitter; "image": the image was shifted by it.
      y: where a positive y points.
      unit: as of motion.
      first: see source.
      length: see source.
    """

    source: str = _choice("none", "metadata", "halton", default="none")
    sign: str = _choice("sample", "image", default="sample")
    y: str = _choice("down", "up", default="down")
    unit: str = _choice("pixels", "uv", "ndc", default="pixels")
    first: int = 1
    length: int = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColorRule:
    """``[color]``, for colour and reference.

    Attributes:
      encoding: the transfer curve.
      pre_exposed: colour was multiplied with the metadata's exposure, and is divided by it.
    """

    encoding: str = _choice("linear", "srgb", default="linear")
    pre_exposed: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class NormalRule:
    """``[normal]``: ``encoding`` "signed", in [-1, 1], or "unsigned", in [0, 1]."""

    encoding: str = _choice("signed", "unsigned", default="signed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseColorRule:
    """``[base_color]``: ``encoding``, the transfer curve."""

    encoding: str = _choice("linear", "srgb", default="linear")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScaleRule:
    """``[scale]``: what stored values are multiplied with first, by image; ``color`` is also that of the reference."""

    color: float = 1.0
    base_color: float = 1.0
    roughness: float = 1.0
    metallic: float = 1.0
    specular: float = 1.0
    n_dot_v: float = 1.0
    reactive: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorldRule:
    """``[world]``, for normals and positions.

    Attributes:
      scale: metres per unit of the dump.
      handedness: of the dump's world; y is negated where it is "left". Cameras are given right-handed.
    """

    scale: float = 1.0
    handedness: str = _choice("right", "left", default="right")


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
    "base_color": BaseColorRule, "scale": ScaleRule, "world": WorldRule,
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
        if not isinstance(pattern, str) or (key != "metadata" and "{frame}" not in pattern):
            raise ValueError(f"{where} {key}: expected a path with {{frame}} in it, got {pattern!r}.")
        if PurePath(pattern).is_absolute() or not pattern:
            raise ValueError(f"{where} {key}: expected a path below the dump's folder, got {pattern!r}.")
    if "frame" not in files and "color" not in files:
        raise ValueError(f"{where}: expected a pattern for frame (all images in one file) or for color.")
    return files


def _channels(where: str, content: Any) -> dict[str, tuple[str, ...]]:
    channels = {}
    for image, names in _strings(where, content, (*IMAGES, "reference")).items():
        count = 3 if image == "reference" else BUFFERS[image].channels
        if not (isinstance(names, list) and len(names) == count and all(isinstance(n, str) for n in names)):
            raise ValueError(f"{where} {image}: expected a list of {count} channel names, got {names!r}.")
        channels[image] = tuple(names)
    missing = [image for image in REQUIRED if image not in channels]
    if missing:
        raise ValueError(f"{where}: {', '.join(missing)} missing. Every dataset needs color, depth and motion.")
    channels.setdefault("reference", channels["color"])
    return channels


def make_recipe(content: Mapping[str, Any], where: str) -> Recipe:
    """A recipe from the content of its TOML.

    Raises:
      ValueError: begins with ``where``; names the table and key, what was expected and what came.
    """
    known = {"files", "channels", "optional", *_TABLES}
    unknown = [key for key in content if key not in known]
    if unknown:
        raise ValueError(f"{where}: there is no table {unknown[0]!r}; there are {', '.join(sorted(known))}.")
    channels = _channels(f"{where}: [channels]", content.get("channels"))
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
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise ValueError(f"{path}: expected a recipe in TOML, cannot read it ({error}).") from error


def load_recipe(preset: str, recipe: str | os.PathLike | None = None) -> Recipe:
    """The recipe of a preset, with the keys that ``recipe`` changes; ``generic`` is ``recipe`` alone.

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
