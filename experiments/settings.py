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
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, Union, get_args, get_origin

PRESETS = ("smoke", "quick", "paper")
"""smoke: every part runs once, two minutes on two cores. quick: the default, ten minutes. paper: the papers' settings
(an epoch: one crop from each of 120 sequences' 60 frames, 900 batches of 8 or 600 of 12)."""
Table = Mapping[str, tuple[Any, Any, Any]]
"""Path -> its value in each of ``PRESETS``."""


@dataclasses.dataclass(frozen=True)
class Data:
    """Scenes to render; ignored with ``--data``. Lengths in frames, sizes in LR pixels, sequences per family.

    scale: reference size over ``size``, any number >= 1, or the reference's (width, height).
    ``train_spp`` is also validation's, ``test_frames`` too. mip_bias (thesis 002): 0 for its dataset 1, -1 for its
    dataset 2. jitter: "dlctus" where every frame is rendered. fresh: new train scenes after so many steps, rendered in
    the meantime; None: always those on disk.
    """

    size: tuple[int, int]
    scale: float | tuple[int, int]
    train_sequences: int
    validation_sequences: int
    test_sequences: int
    train_frames: int
    test_frames: int
    train_spp: int
    test_spp: int
    mip_bias: float
    jitter: Literal["kronecker", "dlctus"]
    fresh: int | None


@dataclasses.dataclass(frozen=True)
class Training:
    """Settings that all stages share.

    rates: one frame in so many is rendered, [2] as in the papers; of several, batches of each take turns. without:
    G-buffers that batches lack, in turn: ["", "base_color", "base_color+normal"] drops none in one of three.
    optimizer: of ``essjax.train.OPTIMIZERS``. anneal: the learning rates decay. save_every: seconds between
    checkpoints. average: decay of a moving average of the weights over the steps; None: the last weights. validations:
    how often after the start of each stage, equally apart in its budget, the averaged weights play a few frames of each
    validation clip: the best are kept; None: never, the last are. vgg: path of VGG-16 weights.
    """

    rates: tuple[int, ...]
    without: tuple[str, ...]
    optimizer: Literal["muon", "adam"]
    anneal: bool
    save_every: float
    average: float | None
    validations: int | None
    vgg: str | None


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """rates: one frame in so many is rendered, [2] as in the papers; the first one's results are the table, of several
    or of more than 2 there is a second table by distance to the rendered frame. tune: search the TAA family's settings
    on validation frames, else their defaults. warmup: frames that are not scored at the start and after a cut.
    pictures: chosen frames per sequence.
    """

    rates: tuple[int, ...]
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
    "data.jitter":               ("kronecker",) * 3,
    "data.fresh":                (None,     None,     None),
    "training.rates":            ((2,),     (2,),     (2,)),
    "training.without":          (("",),    ("",),    ("",)),
    "training.optimizer":        ("muon",   "muon",   "adam"),
    "training.anneal":           (True,     True,     True),
    "training.save_every":       (30.0,     30.0,     300.0),
    "training.average":          (0.99,     0.99,     0.999),
    "training.validations":      (2,        5,        100),
    "training.vgg":              (None,     None,     None),
    "evaluation.rates":          ((2,),     (2,),     (2,)),
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
    groups: dict[str, type] = {"": Settings, "data.": Data, "training.": Training, "evaluation.": Evaluation}
    groups["method."] = arguments(method)
    stages = {f"stages.{name}.": objective for name, objective in (objectives or {}).items()}
    for stage, objective in stages.items():
        groups |= {stage: StageSettings, f"{stage}loss.": arguments(objective)}
    fields = {above + field.name: field for above, kind in groups.items() for field in dataclasses.fields(kind)}
    fields = {path: field for path, field in fields.items() if _plain(field.type)}  # the others are the groups
    values = {path: None if field.default is dataclasses.MISSING else field.default for path, field in fields.items()}
    chosen = {path: row[PRESETS.index(preset)] for path, row in {**COMMON, **(table or {})}.items()}
    for path, value in (*chosen.items(), *(overrides or {}).items()):
        values |= dict.fromkeys(_paths(path, fields, list(stages)), value)
    _check(values, {path: field.type for path, field in fields.items()})

    def group(above: str, **inner: Any) -> Any:
        names = [field.name for field in dataclasses.fields(groups[above])]
        return groups[above](**{name: values[above + name] for name in names if above + name in values}, **inner)

    inner = {name: group(f"{name}.") for name in ("data", "training", "evaluation", "method")}
    inner["stages"] = {stage.split(".")[1]: group(stage, loss=group(f"{stage}loss.")) for stage in stages}
    return group("", **inner)


def _paths(path: str, known: Collection[str], stages: Collection[str]) -> list[str]:
    """Find what ``path`` means: one setting, or the same one of every stage.

    Raises:
      ValueError: there is no such setting; the names at that level are listed.
    """
    first, _, rest = path.partition(".")
    full = f"stages.{path}" if f"stages.{first}." in stages else path
    if full in known:
        return [full]
    every = [stage + rest for stage in stages]
    if first == "stages" and rest.split(".")[0] in StageSettings.__dataclass_fields__ and set(every) <= set(known):
        return every
    level = full
    while level and not _below(f"{level}.", known):
        level = level.rpartition(".")[0]
    names = _below(f"{level}." if level else "", known)
    if level == full:
        raise ValueError(f"{full} is a group of settings: {', '.join(names)}.")
    names += [stage.split(".")[1] for stage in stages if not level]
    last = full.split(".")[-1]
    meant = [one for one in known if one.split(".")[-1] in (last, last.removeprefix("first_"))]
    raise ValueError(
        f"unknown setting {full!r}; {level or 'the top level'} has {', '.join(names)}."
        + (f" Did you mean {' or '.join(meant)}?" if meant else "")
    )


def _below(level: str, known: Collection[str]) -> list[str]:
    """List the names at a level."""
    return list(dict.fromkeys(path.removeprefix(level).split(".")[0] for path in known if path.startswith(level)))


@functools.cache
def arguments(function: Callable) -> type:
    """Make a frozen dataclass of those arguments of ``function`` that are settings: plain values with a default.

    What a ``functools.partial`` has settled is none, nor are ``scale``, which is ``data.scale``, and ``period``, of
    which ``training.rates`` says which ones are trained.
    """
    settled = {"scale", "period", *(function.keywords if isinstance(function, functools.partial) else ())}
    found = [
        (parameter.name, parameter.annotation, parameter.default)
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is not parameter.empty and parameter.name not in settled and _plain(parameter.annotation)
    ]
    return dataclasses.make_dataclass("Arguments", found, frozen=True)


def _plain(kind: Any) -> bool:
    if get_origin(kind) in (Union, types.UnionType, tuple):
        return all(part is Ellipsis or _plain(part) for part in get_args(kind))
    return get_origin(kind) is Literal or kind in (int, float, bool, str, type(None))


def with_data(settings: Settings, **changes: Any) -> Settings:
    """Return the settings with other values in ``data``."""
    return dataclasses.replace(settings, data=dataclasses.replace(settings.data, **changes))


def flatten(tree: Any, above: str = "") -> dict[str, Any]:
    """Map the path of every setting to its value."""
    found = {}
    for name, value in (tree if isinstance(tree, Mapping) else vars(tree)).items():
        group = isinstance(value, Mapping) or dataclasses.is_dataclass(value)
        found |= flatten(value, f"{above}{name}.") if group else {above + name: value}
    return found


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


def _check(values: Mapping[str, Any], kinds: Mapping[str, Any]) -> None:
    """Refuse values of the wrong type or out of bounds, each under its path."""
    for path, value in values.items():
        kind = kinds[path]
        if not _fits(value, kind):
            expected = str(getattr(kind, "__name__", kind) if get_origin(kind) is None else kind)
            expected = expected.replace("tuple[int, int]", "[width,height]").replace("typing.", "")
            raise ValueError(f"--set {path}: expected {expected}, got {value!r}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check_number(path, number, is_int=not _fits(0.5, kind) and not _fits((0.5,), kind))
        if path.endswith(".steps") and value is None and values[f"{path.removesuffix('steps')}seconds"] is None:
            raise ValueError(f"--set: {path} and seconds are both null; give one of them.")


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
    "seed": (0, 2**31), "scale": (1, math.inf),
    "train_frames": (2, math.inf), "test_frames": (2, math.inf), "clip": (2, math.inf),
    "rates": (2, 9), "mip_bias": (-math.inf, math.inf), "average": (0, 1), "warmup": (0, math.inf),
    "pictures": (0, math.inf),
}  # fmt: skip
"""Bounds other than 1 (integers) or 0 (others) and infinity: the least value, and what it is below."""
