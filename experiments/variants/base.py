"""What a variant is: a method with its training stages."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from essjax.interfaces import Method
from essjax.train import Budget, Objective, cosine
from experiments.config import Config


@dataclasses.dataclass(frozen=True)
class Stage:
    """One training stage of a variant.

    Attributes:
      name: also the entry of the variables that it trains; the others are frozen.
      method: the method that is unrolled.
      objective: what is minimised.
      batch: clips per step.
      learning_rate: its peak.
      budget: when it ends.
      decay: of the learning rate, ``progress -> factor``, unless ``Config.anneal`` is false.
      ranges: its objective needs the clips' sample ranges.
      vgg: its loss has a perceptual term, which needs the weights that ``Config.vgg`` names.
    """

    name: str
    method: Method
    objective: Objective
    batch: int
    learning_rate: float
    budget: Budget
    decay: Callable[[float], float] = cosine
    ranges: bool = False
    vgg: bool = False


@dataclasses.dataclass(frozen=True)
class Variant:
    """One name of ``--variant``.

    Attributes:
      summary: one line for ``--list``.
      method: from the settings of a run.
      stages: its training, in order; none for a heuristic. Each stage's variables contain those of the stages before.
      tuned: its alpha, sigma and clamp are chosen on the validation frames.
      weights: the variant whose training it takes, where only its steps differ; then ``stages`` is that one's.
      parts: variants whose variables it contains: a run shows their rows too.
      presets: preset -> settings of the training (``Config``) that this variant changes.
      crops: preset -> side of its crops in *output* pixels, where a paper gives it so: ``crop`` then follows ``scale``.
    """

    summary: str
    method: Callable[..., Method]
    stages: Callable[[Config], list[Stage]] = lambda config: []
    tuned: bool = False
    weights: str | None = None
    parts: tuple[str, ...] = ()
    presets: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    crops: Mapping[str, int] = dataclasses.field(default_factory=dict)


def main_budget(config: Config) -> Budget:
    """When the last (or only) stage ends."""
    return Budget(config.steps, config.seconds)


def first_budget(config: Config) -> Budget:
    """When the stage before it ends."""
    return Budget(config.first_steps, config.first_seconds)
