"""Settings of a run: presets, and ``--set key=value`` on top of them, checked."""

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

from essjax.train import OPTIMIZERS


@dataclasses.dataclass(frozen=True)
class Config:
    """Every setting of a run. Lengths in frames, sizes in LR pixels, times in seconds; None = no limit or absent.

    Data that the renderer makes (ignored with ``--data``, but for ``clip`` and ``crop``):
      seed, size (width, height), scale, train_sequences / validation_sequences / test_sequences (per family),
      train_frames, test_frames (also of validation), train_spp (also of validation), test_spp, mip_bias (thesis
      002: 0 for its dataset 1, -1 for its dataset 2), jitter ("halton", or "dlctus" where every frame is rendered).
    Training: clip (frames per BPTT window), crop (width, height), and for the last (or only) stage batch, width,
      learning_rate, steps, seconds; first_* are the same of the stage before it (ExtraSS: FRNet;
      FASSET has none: first_width are RenderINR's neurons). optimizer ("muon" or "adam"), anneal (false:
      no stage's learning rate decays), fresh (new train scenes after so many steps, rendered in the meantime;
      None: always those on disk), save_every, the losses' weights of ExtraSS eq 9, 12, 14, vgg (path
      of VGG-16 weights); average (decay of a moving average of the weights over the steps; None: the last weights) and
      validations (how often after the start of each stage, equally apart in its budget, the averaged weights play a
      few frames of each validation clip: the best are kept; None: never, the last are).
    Evaluation: tune (search the TAA family's settings on validation frames, else their defaults), warmup (frames not
      scored at the start and after a cut), pictures (chosen frames per sequence).
    optimize: false compiles in half the time for slower code.
    """

    seed: int = 0
    size: tuple[int, int] = (96, 54)
    scale: int = 2
    train_sequences: int = 1
    validation_sequences: int = 1
    test_sequences: int = 1
    train_frames: int = 32
    test_frames: int = 12
    train_spp: int = 16
    test_spp: int = 32
    mip_bias: float = 0.0
    jitter: str = "halton"
    clip: int = 7
    crop: tuple[int, int] = (48, 48)
    first_batch: int = 4
    batch: int = 4
    first_width: int = 16
    width: int = 16
    first_learning_rate: float = 1e-3
    learning_rate: float = 3e-3
    first_steps: int | None = None
    first_seconds: float | None = 45.0
    steps: int | None = None
    seconds: float | None = 245.0
    optimizer: str = "muon"
    anneal: bool = True
    fresh: int | None = None
    save_every: float = 30.0
    feature_weight: float = 0.001
    occlusion_weight: float = 0.3
    vgg_weight: float = 0.01
    temporal_weight: float = 0.1
    vgg: str | None = None
    average: float | None = 0.99
    validations: int | None = 10
    tune: bool = True
    warmup: int = 5
    pictures: int = 1
    optimize: bool = True

    @property
    def compiler_options(self) -> dict[str, Any] | None:
        """For ``jax.jit`` of train and streaming steps."""
        return None if self.optimize else {"xla_backend_optimization_level": 0}


PRESETS: dict[str, Config] = {
    "smoke": Config(
        size=(48, 28), train_sequences=1, train_frames=7, test_frames=8, train_spp=4, test_spp=8, clip=3, crop=(32, 24),
        batch=2, first_batch=2, width=8, first_width=8, first_steps=4, steps=6, first_seconds=None, seconds=None,
        validations=2, warmup=2, tune=False, optimize=False,
    ),
    "quick": Config(),
    "paper": Config(
        size=(960, 540), train_sequences=20, validation_sequences=2, test_sequences=2, train_frames=60, test_frames=60,
        train_spp=64, test_spp=64, clip=9, crop=(128, 128), batch=12, first_batch=8, width=24, first_width=24,
        first_learning_rate=1e-4, learning_rate=4e-4, occlusion_weight=1.0, temporal_weight=1.0,
        first_steps=100 * 900, steps=120 * 600, first_seconds=None, seconds=None, save_every=300.0, average=0.999,
        validations=100, pictures=2, optimizer="adam",
    ),
}  # fmt: skip
"""smoke: every part runs once, two minutes on two cores. quick: the default, ten minutes. paper: the
papers' settings (an epoch: one crop from each of 120 sequences' 60 frames, 900 batches of 8 or 600 of 12)."""

PRESET_NAMES = tuple(PRESETS)


def make_config(preset: str, overrides: list[str], settings: Mapping[str, Mapping[str, Any]] | None = None) -> Config:
    """The preset with ``key=value`` overrides; values are JSON (``size=[128,72]``, ``steps=null``) or plain words.

    Args:
      preset: its name.
      overrides: of the command line.
      settings: preset -> what a variant changes in it (``Variant.presets``); ``overrides`` come on top.

    Raises:
      ValueError: unknown preset or key (the valid ones are listed), or a value of the wrong type.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    config = dataclasses.replace(PRESETS[preset], **(settings or {}).get(preset, {}))
    valid = {field.name: field for field in dataclasses.fields(Config)}
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator:
            raise ValueError(f"--set {override}: expected key=value.")
        if key not in valid:
            raise ValueError(f"--set: unknown key {key!r}; valid keys are {', '.join(valid)}.")
        config = dataclasses.replace(config, **{key: _parse(key, text, valid[key].type)})
    _check(config)
    return config


def _parse(key: str, text: str, kind: Any) -> Any:
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    value = tuple(value) if isinstance(value, list) else value
    optional = "None" in str(kind)
    if value is None and optional:
        return None
    if kind is bool or str(kind) == "bool":
        fits = isinstance(value, bool)
    elif kind is int or str(kind).startswith("int"):
        fits = isinstance(value, int) and not isinstance(value, bool)
    elif kind is float or str(kind).startswith("float"):
        fits = isinstance(value, int | float) and not isinstance(value, bool)
    elif "tuple" in str(kind):
        fits = isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, int) and v > 0 for v in value)
    else:
        value, fits = text, True
    if not fits:
        expected = "[width,height]" if "tuple" in str(kind) else getattr(kind, "__name__", str(kind))
        raise ValueError(f"--set {key}={text}: expected {expected}, got {text!r}.")
    return value


def _check(config: Config) -> None:
    for name in ("first", ""):
        steps, seconds = f"{name}_steps".lstrip("_"), f"{name}_seconds".lstrip("_")
        if getattr(config, steps) is None and getattr(config, seconds) is None:
            raise ValueError(f"--set: {steps} and {seconds} are both null; give one of them.")
    for name, (least, unit) in _LEAST.items():
        value = getattr(config, name)
        if value is not None and not least <= value < math.inf:  # nor NaN
            raise ValueError(f"--set {name}: expected at least {least}{unit}, got {value}.")
    for name in _POSITIVE:
        value = getattr(config, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"--set {name}: expected a number above 0, got {value}.")
    if config.average is not None and not 0 <= config.average < 1:
        raise ValueError(f"--set average: expected a decay in [0, 1), got {config.average}.")
    if config.optimizer not in OPTIMIZERS:
        raise ValueError(f"--set optimizer: expected one of {', '.join(sorted(OPTIMIZERS))}, got {config.optimizer!r}.")
    if not math.isfinite(config.mip_bias):
        raise ValueError(f"--set mip_bias: expected a finite number, got {config.mip_bias}.")


_LEAST = {
    "seed": (0, ""), "scale": (1, ""), "train_sequences": (1, ""), "validation_sequences": (1, ""),
    "test_sequences": (1, ""), "train_frames": (2, " frames"), "test_frames": (2, " frames"),
    "train_spp": (1, " sample"), "test_spp": (1, " sample"), "clip": (2, " frames"), "first_batch": (1, ""),
    "batch": (1, ""), "first_width": (1, " channel"), "width": (1, " channel"), "first_steps": (1, " step"),
    "steps": (1, " step"), "fresh": (1, " step on each round of scenes"), "save_every": (0, " seconds"),
    "feature_weight": (0, ""), "occlusion_weight": (0, ""), "vgg_weight": (0, ""), "temporal_weight": (0, ""),
    "validations": (1, " validation"), "warmup": (0, " frames"), "pictures": (0, ""),
}  # fmt: skip
"""The smallest value of a setting, and of what."""
_POSITIVE = ("first_learning_rate", "learning_rate", "first_seconds", "seconds")
