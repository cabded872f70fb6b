"""Variants: a method with its training, and what ``docs/methods.md`` says about it."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from essjax.buffers import OPTIONAL_GBUFFERS
from essjax.interfaces import Method
from essjax.train import Budget, Objective, Recurrent, constant, cosine
from experiments.settings import Settings, StageSettings, Table, arguments, make_settings


class Task(NamedTuple):
    """Clips of one kind, of which a stage's batches are.

    Attributes:
      objective: what is minimised.
      period: one frame in so many is rendered.
      without: optional buffers that its frames lack.
    """

    objective: Objective | Recurrent
    period: int = 2
    without: tuple[str, ...] = ()

    @property
    def recurrent(self) -> bool:
        """Its clips follow each other."""
        return isinstance(self.objective, Recurrent)


@dataclasses.dataclass(frozen=True)
class Stage:
    """One training stage, ready to be run.

    Attributes:
      name: also the entry of the variables that it trains; the others are frozen.
      method: the method that is validated.
      tasks: by name; their batches take turns.
      settings: batch, crop, learning rate, budget.
      decay: of the learning rate, ``progress -> factor``.
      ranges: its objective needs the clips' sample ranges.
      vgg: its loss has a perceptual term, which needs the weights that ``training.vgg`` names.
    """

    name: str
    method: Method
    tasks: Mapping[str, Task]
    settings: StageSettings
    decay: Callable[[float], float]
    ranges: bool
    vgg: bool

    @property
    def budget(self) -> Budget:
        """When it ends."""
        return Budget(self.settings.steps, self.settings.seconds)


@dataclasses.dataclass(frozen=True)
class StageRecipe:
    """How one entry of a method's variables is trained.

    Attributes:
      objective: ``(method, **arguments) -> Objective``; arguments with defaults that are plain values are settings.
      method: of the run's settings, where it is not the variant's own: a part that is trained first.
      unrolls: the same, where the objective's method is not the one that holds the variables.
      given: arguments of the objective that are no settings, from the run's settings.
      decay: of the learning rate, unless ``training.anneal`` is false.
      ranges: see ``Stage``.
      vgg: ``path -> features``, for an objective that takes ``vgg_features``.
    """

    objective: Callable[..., Any]
    method: Callable[[Settings], Method] | None = None
    unrolls: Callable[[Settings], Method] | None = None
    given: Callable[[Settings], Mapping[str, Any]] = lambda settings: {}
    decay: Callable[[float], float] = cosine
    ranges: bool = False
    vgg: Callable[[str], Any] | None = None

    def stage(self, name: str, settings: Settings, whole: Method) -> Stage:
        """Make the stage called ``name`` of a variant whose method is ``whole``.

        Raises:
          ValueError: it is trained at one rate alone, and ``training.rates`` names others; or ``training.without``
            names what is no buffer, or one that it cannot do without.
        """
        method = self.method(settings) if self.method else whole
        given = {**vars(settings.stages[name].loss), **self.given(settings)}
        if self.vgg and settings.training.vgg:
            given["vgg_features"] = self.vgg(settings.training.vgg)
        objective = functools.partial(self.objective, self.unrolls(settings) if self.unrolls else method, **given)
        rates = settings.training.rates
        if "period" in inspect.signature(self.objective).parameters:
            tasks = {f"1:{period}": Task(objective(period=period), period) for period in rates}
        elif rates == (2,):
            tasks = {"1:2": Task(objective())}
        else:
            raise ValueError(
                f"--set training.rates: {name} is not trained at several rates; expected [2], got {list(rates)}. Leave "
                "it out, or say VARIANT:training.rates=... for the others."
            )
        tasks = {
            f"{rate} without {missing}" if missing else rate: task._replace(without=split_names(missing, method))
            for rate, task in tasks.items()
            for missing in settings.training.without
        }
        decay = self.decay if settings.training.anneal else constant
        return Stage(name, method, tasks, settings.stages[name], decay, self.ranges, self.vgg is not None)


def split_names(missing: str, method: Method) -> tuple[str, ...]:
    """Read an entry of ``training.without``: names with "+" between.

    Raises:
      ValueError: no optional buffer has that name, or ``method`` needs it.
    """
    names = tuple(name for name in missing.split("+") if name)
    wrong = [name for name in names if name not in OPTIONAL_GBUFFERS or name in method.info.requires]
    if wrong:
        possible = [name for name in OPTIONAL_GBUFFERS if name not in method.info.requires]
        raise ValueError(
            f'--set training.without: expected entries like "base_color+normal", of '
            f"{', '.join(possible) or 'no buffer'} ({method.info.name} needs the others), got {', '.join(wrong)}."
        )
    return names


class Page(NamedTuple):
    """Parts of docs/methods.md about a method that cannot be computed.

    Attributes:
      paper: where it comes from.
      idea: one or two sentences.
      chosen: what the paper does not say and what we chose, in short.
      reactive: what becomes of a reactive pixel in an extrapolated frame.
    """

    paper: str
    idea: str
    chosen: str = "–"
    reactive: str = "–"


class Found(NamedTuple):
    """Measurements of a variant beyond images: ``scores`` for ``metrics.json``, ``remark`` for the reader."""

    scores: Mapping[str, Any]
    remark: str


@dataclasses.dataclass(frozen=True)
class Variant:
    """One name of ``--variant``.

    Attributes:
      summary: one line for ``--list``.
      factory: of its method; its arguments that are plain values with defaults are the settings ``method.*``.
      stages: its training, in order; none for a heuristic. Each stage's variables contain those of the stages before.
      presets: path of a setting -> its value in each preset, on top of ``settings.COMMON``.
      page: its row in docs/methods.md; ablations have none.
      tuned: its alpha, sigma and clamp are chosen on the validation frames.
      weights: the variant whose training and settings it takes, where only its steps differ.
      parts: variants whose variables it contains, each with its arguments that are called otherwise here (its name ->
        ours): a run shows their rows too.
      inspect: measures more than images, on the test clips, and may write pictures into the report's folder;
        what its ``key`` says are its ``Found.scores`` in ``metrics.json``.
      key: of ``inspect``.
    """

    summary: str
    factory: Callable[..., Method]
    stages: Mapping[str, StageRecipe] = dataclasses.field(default_factory=dict)
    presets: Table = dataclasses.field(default_factory=dict)
    page: Page | None = None
    tuned: bool = False
    weights: str | None = None
    parts: Mapping[str, Mapping[str, str]] = dataclasses.field(default_factory=dict)
    inspect: Callable[[Method, Any, Sequence, Settings, Path], Found | None] | None = None
    key: str = ""

    def settings(self, preset: str, overrides: Mapping[str, Any]) -> Settings:
        """Those of a run: see ``make_settings``."""
        objectives = {name: recipe.objective for name, recipe in self.stages.items()}
        return make_settings(preset, overrides, method=self.factory, objectives=objectives, table=self.presets)

    def method(self, settings: Settings, renamed: Mapping[str, str] | None = None) -> Method:
        """Its method from settings, its own or those of a variant that holds its variables.

        Args:
          settings: those arguments that they do not have keep the factory's defaults.
          renamed: argument -> what it is called there.
        """
        theirs = {name: (renamed or {}).get(name, name) for name in arguments(self.factory).__dataclass_fields__}
        given = {
            name: getattr(settings.method, there) for name, there in theirs.items() if hasattr(settings.method, there)
        }
        if "scale" in inspect.signature(self.factory).parameters:
            given["scale"] = settings.data.scale
        return self.factory(**given)
