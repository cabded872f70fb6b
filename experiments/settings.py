"""Settings of a run: nested, each with a value per preset in a table, and ``--set path=value`` on top of them.

A path names a setting: ``data.size``, ``method.width``, ``stages.frnet.batch``. A stage's name may stand alone
(``frnet.batch``), and be left out to mean every stage (``stages.batch``).
"""

import dataclasses
import functools
import inspect
import json
import math
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

PRESETS = ("smoke", "quick", "paper")
"""smoke: every part runs once, two minutes on two cores. quick: the default, ten minutes. paper: the papers' settings
(an epoch: one crop from each of 120 sequences' 60 frames, 900 batches of 8 or 600 of 12)."""
Table = Mapping[str, tuple[Any, Any, Any]]
"""Path -> its value in each of ``PRESETS``."""


@dataclasses.dataclass(frozen=True)
class Data:
    """Scenes to render; ignored with ``--data``. Lengths in frames, sizes in LR pixels, sequences per family.

    ``train_spp`` is also validation's, ``test_frames`` too. mip_bias (thesis 002): 0 for its dataset 1, -1 for its
    dataset 2. jitter: "dlctus" where every frame is rendered. fresh: new train scenes after so many steps, rendered in
    the meantime; None: always those on disk.
    """

    size: tuple[int, int]
    scale: int
    train_sequences: int
    validation_sequences: int
    test_sequences: int
    train_frames: int
    test_frames: int
    train_spp: int
    test_spp: int
    mip_bias: float
    jitter: Literal["halton", "dlctus"]
    fresh: int | None


@dataclasses.dataclass(frozen=True)
class Training:
    """Settings that all stages share.

    optimizer: of ``essjax.train.OPTIMIZERS``. anneal: the learning rates decay. save_every: seconds between
    checkpoints. average: decay of a moving average of the weights over the steps; None: the last weights. validations:
    how often after the start of each stage, equally apart in its budget, the averaged weights play a few frames of each
    validation clip: the best are kept; None: never, the last are. vgg: path of VGG-16 weights.
    """

    optimizer: Literal["muon", "adam"]
    anneal: bool
    save_every: float
    average: float | None
    validations: int | None
    vgg: str | None


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """tune: search the TAA family's settings on validation frames, else their defaults. warmup: frames that are not
    scored at the start and after a cut. pictures: chosen frames per sequence.
    """

    tune: bool
    warmup: int
    pictures: int


@dataclasses.dataclass(frozen=True)
class StageSettings:
    """One stage of training.

    batch: clips per step. clip: their frames. crop: (width, height) in LR pixels; one number: the side of a square in
    *output* pixels. learning_rate: its peak. steps, seconds: when it ends, whichever is first; None: no limit. loss:
    the arguments of its objective.
    """

    batch: int
    clip: int
    crop: tuple[int, int] | int
    learning_rate: float
    steps: int | None
    seconds: float | None
    loss: Any


@dataclasses.dataclass(frozen=True)
class Settings:
    """Every setting of a run.

    seed: of the scenes and of the initial weights. optimize: false compiles in half the time for slower code. method:
    the arguments of its factory. stages: name -> its settings, in order.
    """

    seed: int
    optimize: bool
    data: Data
    training: Training
    evaluation: Evaluation
    method: Any
    stages: Mapping[str, StageSettings]

    @property
    def compiler_options(self) -> dict[str, Any] | None:
        """For ``jax.jit`` of train and streaming steps."""
        return None if self.optimize else {"xla_backend_optimization_level": 0}


COMMON: Table = {
    #                             smoke     quick     paper
    "seed":                      (0,        0,        0),
    "optimize":                  (False,    True,     True),
    "data.size":                 ((48, 28), (96, 54), (960, 540)),
    "data.scale":                (2,        2,        2),
    "data.train_sequences":      (1,        2,        20),
    "data.validation_sequences": (1,        1,        2),
    "data.test_sequences":       (1,        1,        2),
    "data.train_frames":         (7,        32,       60),
    "data.test_frames":          (8,        12,       60),
    "data.train_spp":            (4,        8,        64),
    "data.test_spp":             (8,        32,       64),
    "data.mip_bias":             (0.0,      0.0,      0.0),
    "data.jitter":               ("halton", "halton", "halton"),
    "data.fresh":                (None,     None,     None),
    "training.optimizer":        ("muon",   "muon",   "adam"),
    "training.anneal":           (True,     True,     True),
    "training.save_every":       (30.0,     30.0,     300.0),
    "training.average":          (0.99,     0.99,     0.999),
    "training.validations":      (2,        5,        100),
    "training.vgg":              (None,     None,     None),
    "evaluation.tune":           (False,    True,     True),
    "evaluation.warmup":         (2,        5,        5),
    "evaluation.pictures":       (1,        1,        2),
    "stages.batch":              (2,        4,        8),
    "stages.clip":               (3,        7,        9),
    "stages.crop":               ((32, 24), (48, 48), (128, 128)),
    "stages.learning_rate":      (3e-3,     1e-3,     1e-3),
    "stages.steps":              (6,        None,     None),
    "stages.seconds":            (None,     290.0,    None),
}  # fmt: skip
"""Values that every variant begins with."""

SHARED = ("seed", "optimize", "data", "evaluation")
"""Groups that all variants of a run have in common."""


def make_settings(
    preset: str,
    overrides: Mapping[str, Any] | None = None,
    *,
    method: Callable = lambda: None,
    objectives: Mapping[str, Callable] | None = None,
    table: Table | None = None,
) -> Settings:
    """Make the settings of a variant.

    Args:
      preset: its name.
      overrides: path -> value, of the command line.
      method: factory of its method: its arguments are settings, with its own defaults where no table says more.
      objectives: stage -> factory of its objective, for ``loss`` alike.
      table: what the variant changes in ``COMMON``.

    Raises:
      ValueError: unknown preset or path (the valid ones are listed), or a value of the wrong type or size.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    stages = {
        name: _blank(StageSettings, loss=arguments(objective)()) for name, objective in (objectives or {}).items()
    }
    groups = {name: _blank(kind) for name, kind in (("data", Data), ("training", Training), ("evaluation", Evaluation))}
    settings = _blank(Settings, **groups, method=arguments(method)(), stages=stages)
    for path, values in {**COMMON, **(table or {})}.items():
        settings = with_value(settings, path, values[PRESETS.index(preset)])
    for path, value in (overrides or {}).items():
        settings = with_value(settings, path, value)
    check(settings)
    return settings


def _blank(kind: type, **values: Any) -> Any:
    """Make a dataclass whose other fields are None for now: tables fill them, ``check`` sees which they forget."""
    return kind(**dict.fromkeys(field.name for field in dataclasses.fields(kind)) | values)


@functools.cache
def arguments(function: Callable) -> type:
    """Make a frozen dataclass of those arguments of ``function`` that are settings: plain values with a default.

    What a ``functools.partial`` has settled is none, nor is ``scale``, which is ``data.scale``.
    """
    settled = {"scale", *(function.keywords if isinstance(function, functools.partial) else ())}
    found = [
        (parameter.name, parameter.annotation, parameter.default)
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is not parameter.empty and parameter.name not in settled and _plain(parameter.annotation)
    ]
    return dataclasses.make_dataclass("Arguments", found, frozen=True)


def _plain(kind: Any) -> bool:
    if get_origin(kind) in (Union, types.UnionType, tuple):
        return all(part is Ellipsis or _plain(part) for part in get_args(kind))
    return kind in (int, float, bool, str, type(None))


def with_value(settings: Settings, path: str, value: Any) -> Settings:
    """Return the settings with another value at ``path``; see the top of the module for what a path is.

    Raises:
      ValueError: there is no such setting; the names at that level are listed.
    """
    names = path.split(".")
    if names[0] in settings.stages:
        names = ["stages", *names]
    fields = {field.name for field in dataclasses.fields(StageSettings)}
    if len(names) > 1 and names[0] == "stages" and names[1] in fields:
        for stage in settings.stages:
            settings = _replaced(settings, ["stages", stage, *names[1:]], value, settings)
        return settings
    return _replaced(settings, names, value, settings)


def _replaced(node: Any, names: Sequence[str], value: Any, settings: Settings, above: str = "") -> Any:
    (name, *rest), children = names, _children(node)
    if name not in children or bool(rest) != _is_group(children[name]):
        raise ValueError(_unknown(above + ".".join(names), above + name, children, name, settings))
    child = _replaced(children[name], rest, value, settings, f"{above}{name}.") if rest else value
    return {**node, name: child} if isinstance(node, Mapping) else dataclasses.replace(node, **{name: child})


def _unknown(path: str, at: str, children: Mapping[str, Any], name: str, settings: Settings) -> str:
    if name in children and _is_group(children[name]):
        return f"{path} is a group of settings: {', '.join(_children(children[name])) or 'none here'}."
    level = at.rpartition(".")[0]
    valid = [*children, *(() if level else settings.stages)]
    if name in children:
        return f"{at} is one setting: there is no {path}."
    message = f"unknown setting {path!r}; {level or 'the top level'} has {', '.join(valid) or 'none'}."
    old = name.removeprefix("first_")
    meant = [each for each in flatten(settings) if each.split(".")[-1] in (name, old)]
    return message + (f" Did you mean {' or '.join(meant)}?" if meant else "")


def _children(node: Any) -> dict[str, Any]:
    return dict(node) if isinstance(node, Mapping) else vars(node)


def _is_group(node: Any) -> bool:
    return isinstance(node, Mapping) or dataclasses.is_dataclass(node)


def flatten(settings: Settings) -> dict[str, Any]:
    """Path -> value of every setting."""
    return {path: value for path, value, _ in _leaves(settings)}


def _leaves(node: Any, above: str = "", kinds: Mapping[str, Any] | None = None) -> Iterator[tuple[str, Any, Any]]:
    """Path, value and type of each setting."""
    if dataclasses.is_dataclass(node):
        kinds = {field.name: field.type for field in dataclasses.fields(node)}
    for name, child in _children(node).items():
        if _is_group(child):
            yield from _leaves(child, f"{above}{name}.")
        else:
            yield above + name, child, (kinds or {})[name]


def parse_override(text: str) -> tuple[str, str, Any]:
    """``[VARIANT:]path=value`` as variant (or ""), path and value: JSON (``[128,72]``, ``null``) or plain words.

    Raises:
      ValueError: there is no "=".
    """
    key, separator, written = text.partition("=")
    if not separator:
        raise ValueError(f"--set {text}: expected path=value.")
    variant, _, path = key.rpartition(":")
    try:
        value = json.loads(written)
    except json.JSONDecodeError:
        value = written
    return variant, path, _as_tuple(value)


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(part) for part in value) if isinstance(value, list) else value


def check(settings: Settings) -> None:
    """Refuse values of the wrong type or out of bounds.

    Raises:
      ValueError: names the first one.
    """
    for path, value, kind in _leaves(settings):
        if not _fits(value, kind):
            expected = str(getattr(kind, "__name__", kind) if get_origin(kind) is None else kind)
            expected = expected.replace("tuple[int, int]", "[width,height]").replace("typing.", "")
            raise ValueError(f"--set {path}: expected {expected}, got {value!r}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check_number(path, number, is_int=kind in (int, int | None, tuple[int, int], tuple[int, int] | int))
    for name, stage in settings.stages.items():
        if stage.steps is None and stage.seconds is None:
            raise ValueError(f"--set: stages.{name}.steps and seconds are both null; give one of them.")


def _fits(value: Any, kind: Any) -> bool:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if origin is tuple:
        parts = parts[:1] * len(value) if isinstance(value, tuple) and parts[-1] is Ellipsis else parts
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(_fits, value, parts))
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is kind


def _check_number(path: str, number: float, *, is_int: bool) -> None:
    name = path.split(".")[-1]
    least, most = _BOUNDS.get(name, (1 if is_int else 0, math.inf))
    if not (least <= number < most and math.isfinite(number)):
        bound = f"at least {least:g}" if least > -math.inf else "a finite number"
        bound += f" and less than {most:g}" if most < math.inf else ""
        raise ValueError(f"--set {path}: expected {bound}, got {number}.")
    if name in ("learning_rate", "seconds") and not number > 0:
        raise ValueError(f"--set {path}: expected a number above 0, got {number}.")


_BOUNDS = {
    "seed": (0, math.inf), "train_frames": (2, math.inf), "test_frames": (2, math.inf), "clip": (2, math.inf),
    "mip_bias": (-math.inf, math.inf), "average": (0, 1), "warmup": (0, math.inf), "pictures": (0, math.inf),
}  # fmt: skip
"""Bounds other than 1 (integers) or 0 (others) and infinity: the least value, and what it is below."""
