"""One experiment, whether of one variant (``experiments.run``) or of several (``experiments.compare``).

Prepare, train, tune, evaluate, report, over the members of the run: each part resumes where an interrupted run left
off.
"""

import contextlib
import dataclasses
import itertools
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from essjax.data import Dataset, read_dataset
from essjax.data.json_files import write_json
from essjax.deploy import method_cost
from essjax.files import only_writer
from essjax.methods import save
from essjax.typing import PyTree
from experiments import datasets, health
from experiments import environment as machine
from experiments.ahead import Ahead
from experiments.alarm import no_alarm
from experiments.checks import check_dataset, check_settings
from experiments.comparison import Trained, make_runners, notes, table_references
from experiments.evaluate import Clip, Clips, Runner, evaluate
from experiments.holes import mask_remark, mask_scores
from experiments.members import Member, all_settings, resolve
from experiments.progress import Phases, TrainingProgress
from experiments.report import print_table, write_report
from experiments.request import Request, check_folder, run_record
from experiments.settings import Settings, with_data
from experiments.tensorboard import Events, check_installed
from experiments.training import initial_variables, read_losses, restore_member, train_member
from experiments.tuning import Setting
from experiments.variants import VARIANTS
from experiments.variants.base import Found


class Run(NamedTuple):
    """A run that was prepared.

    Attributes:
      request: what was asked for.
      members: all rows, in the order of the table.
      dataset: train, validation and test frames.
      initial: owner -> initial variables of its training.
      steps: stage -> step of the first training, where it is being compiled already.
    """

    request: Request
    members: dict[str, Member]
    dataset: Dataset
    initial: dict[str, PyTree]
    steps: Mapping[str, Any] | None

    @property
    def wanted(self) -> list[Member]:
        """The members that were asked for."""
        return [self.members[name] for name in self.request.names]

    @property
    def settings(self) -> Settings:
        """Return those of the first one: what all have in common is there."""
        return self.wanted[0].settings


class Tuned(NamedTuple):
    """Runners of all rows that fit the data, the chosen settings of the TAA family, and the test clips."""

    runners: dict[str, Runner]
    chosen: dict[str, Setting]
    clips: Clips


class Evaluated(NamedTuple):
    """The results of ``evaluate``, of variants beyond it, the hole mask's scores, dead networks."""

    images: dict[str, Any]
    found: dict[str, Found]
    holes: dict[str, Any]
    dead: list[str]


class Clock:
    """Seconds of each part of a run."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._since = time.monotonic()

    def lap(self, name: str) -> None:
        """Part ``name`` ends now."""
        now = time.monotonic()
        self.seconds[name], self._since = round(now - self._since, 1), now


def run_experiment(request: Request, console: Console) -> dict[str, Any]:
    """Run everything, write ``metrics.json``, ``weights`` and ``report`` into ``out``; returns the first's content.

    Raises:
      ValueError: unknown variant, preset or setting, settings or data that do not fit, or of which no frame would be
        scored, or ``out`` holds another run or is being written by another command.
    """
    settings = all_settings(request.names, request.preset, request.overrides)
    with only_writer(request.out):
        return _run_experiment(request, settings, console)


def _run_experiment(request: Request, settings: Mapping[str, Settings], console: Console) -> dict[str, Any]:
    record, clock = run_record(request, settings), Clock()
    check_folder(request.out, record, resume=request.resume, eval_only=request.eval_only)
    if request.tensorboard:
        check_installed()
    with no_alarm(), Phases(console) as phases, contextlib.ExitStack() as stack:
        run = _prepare(request, settings, phases, stack)
        request.out.mkdir(parents=True, exist_ok=True)
        write_json(request.out / "run.json", record)  # from here on there is something to resume
        clock.lap("data")
        trained = _train(run, phases)
        clock.lap("training")
        # Of all sessions: the clock saw only this one, which may have restored everything.
        for part, key in _SPENT.items():
            clock.seconds[part] = round(sum(report[key] for report in stage_reports(trained).values()), 1)
        tuned = _tune(run, trained, phases)
        clock.lap("tuning")
        evaluated = _evaluate(run, trained, tuned, phases)
        clock.lap("evaluation")
    return _report(run, trained, tuned, evaluated, clock, console)


_SPENT = {"compilation": "compile_seconds", "training": "seconds", "validation": "validation_seconds"}


def _prepare(request: Request, settings: Mapping[str, Settings], phases: Phases, stack: contextlib.ExitStack) -> Run:
    """Resolve the members, read or render the data, refuse what does not fit."""
    phases.show("data", text="reading" if request.data else "rendering")
    opened = read_dataset(request.data) if request.data is not None else None
    if opened:  # labels and outputs depend on the sizes of the images: a user's data has its own
        found: dict[str, Any] = {"size": (opened.info.width, opened.info.height)}
        if opened.info.scale != 1:  # else it has no references: what supersamples is refused
            found["scale"] = opened.info.scale
        settings = {name: with_data(own, **found) for name, own in settings.items()}
    members = resolve(settings, request.preset, request.out)
    wanted, steps = [members[name] for name in request.names], None
    if opened is None:
        check_settings(wanted)
    trainings = trainings_of(wanted)
    fresh = not (request.out / "run.json").exists()  # else stages may have been trained already
    if trainings and fresh and opened is None:
        first = next(iter(trainings.values()))
        steps = stack.enter_context(contextlib.closing(Ahead(first))).steps
    dataset = datasets.prepare(
        wanted[0].settings,
        opened,
        request.out,
        lambda n, total: phases.show("data", n / total, f"{n}/{total}"),
        ranges=_needs_ranges(wanted),
        native=all(member.method.info.native for member in wanted),
        trained=bool(trainings),
    )
    phases.show("data", 1.0, f"{len(dataset.sequences)} sequences")
    phases.console.print(datasets.describe(dataset), soft_wrap=True)
    check_dataset(wanted, dataset)
    # What training would refuse is refused here.
    initial = {owner: initial_variables(member, dataset) for owner, member in trainings.items()}
    return Run(request, members, dataset, initial, steps)


def trainings_of(wanted: Sequence[Member]) -> dict[str, Member]:
    """Owner -> the first member with variables of its training, which is made once."""
    found: dict[str, Member] = {}
    for member in wanted:
        if member.owner:
            found.setdefault(member.owner, member)
    return found


def _needs_ranges(members: Sequence[Member]) -> bool:
    return any(stage.ranges for member in members for stage in member.stages)


def _train(run: Run, phases: Phases) -> dict[str, Trained]:
    """Train (or restore) what the wanted members take their variables from."""
    trained: dict[str, Trained] = {}
    for owner, member in trainings_of(run.wanted).items():
        initial = run.initial[owner]
        if run.request.eval_only:
            variables, report = restore_member(member, run.dataset, initial)
        else:
            if not member.settings.training.vgg and any(stage.vgg for stage in member.stages):
                phases.console.print(
                    "VGG term off: give torchvision-layout VGG-16 weights with --set training.vgg=PATH to switch it "
                    "on.",
                    soft_wrap=True,
                )
            events = Events(member.folder / "tensorboard") if run.request.tensorboard else None
            watcher = TrainingProgress(phases, "" if len(run.wanted) == 1 else f"{owner}: ", events)
            with contextlib.closing(watcher):
                steps = None if trained else run.steps  # those are of the first one
                variables, report = train_member(member, run.dataset, initial, watcher, steps)
        trained[owner] = Trained(initial, variables, report)
    return trained


def _tune(run: Run, trained: Mapping[str, Trained], phases: Phases) -> Tuned:
    phases.show("tuning", text="reading")
    native = any(member.method.info.native for member in run.members.values())
    splits = datasets.evaluated_splits(run.dataset)
    native = native and run.dataset.has_native(*splits)
    options = {"native": native, "ranges": _needs_ranges(run.wanted)}
    warmup = run.settings.evaluation.warmup
    of_split = {split: Clips(run.dataset, split, warmup, **options) for split in splits}
    validation, clips = of_split.get("validation"), of_split["test"]
    runners, chosen = make_runners(
        run.members,
        run.request.names,
        trained,
        clips,
        validation,
        run.request.out,
        lambda text: phases.show("tuning", text=text),
    )
    for name in run.request.names:
        save(weights_file(run.request.out, name), runners[name].method, runners[name].variables)
    phases.show("tuning", 1.0)
    return Tuned(runners, chosen, clips)


def weights_file(out: Path, name: str) -> Path:
    """Return where a run keeps what ``essjax.methods.load`` reads of variant ``name``."""
    return out / "weights" / f"{name}.safetensors"


def _evaluate(run: Run, trained: Mapping[str, Trained], tuned: Tuned, phases: Phases) -> Evaluated:
    done, (runners, _, clips) = itertools.count(), tuned
    images = evaluate(
        runners,
        clips,
        rates=run.settings.evaluation.rates,
        pictures=run.settings.evaluation.pictures,
        on_step=lambda text: phases.show("evaluation", next(done) / (len(runners) * len(clips)), text),
    )
    found = {}
    for member in run.wanted:
        inspect, runner = VARIANTS[member.name].inspect, runners[member.name]
        each = inspect and inspect(runner.method, runner.variables, clips, member.settings, run.request.out / "report")
        found |= {member.name: each} if each else {}
    holes = mask_scores(clips)
    dead = health.still_stages(stage_reports(trained)) + _dead_methods(run, trained, runners, images["rows"], clips[0])
    phases.show("evaluation", 1.0)
    return Evaluated(images, found, holes, dead)


def _dead_methods(
    run: Run,
    trained: Mapping[str, Trained],
    runners: Mapping[str, Runner],
    rows: Sequence[Mapping[str, Any]],
    clip: Clip,
) -> list[str]:
    """Name each method whose pictures say that its network does nothing."""
    # After a few steps hardly anything is seen; that they were few is said.
    learned = {owner for owner, found in trained.items() if not health.has_few_steps(found.report)}
    owners = {row: run.members[row].owner if run.members[row].owner in learned else None for row in runners}
    messages = health.same_rows(rows, owners)
    for row in run.request.names:
        owner = owners.get(row)
        if owner:
            messages += health.unchanged(row, runners[row], trained[owner].initial, clip)
    return messages


def _report(
    run: Run, trained: Mapping[str, Trained], tuned: Tuned, evaluated: Evaluated, clock: Clock, console: Console
) -> dict[str, Any]:
    """Write metrics and report, print the table."""
    (names, preset, overrides, _, out, *_), reports = run.request, stage_reports(trained)
    metrics: dict[str, Any] = {
        "schema": 1,
        "variant": ", ".join(names),
        "preset": preset,
        "overrides": list(overrides),
        "configs": {member.name: dataclasses.asdict(member.settings) for member in run.wanted},
        "dataset": datasets.describe(run.dataset),
        "environment": environment(run.settings, reports),
        "settings": {name: setting._asdict() for name, setting in tuned.chosen.items()},
        "seconds": clock.seconds,
        "training": {stage: {**found, "terms": {}} for stage, found in reports.items()},
        "dead": evaluated.dead,
        "warnings": health.few_steps(reports) + health.no_gain(reports),
        "costs": costs(tuned.runners, run.dataset),
        "rows": evaluated.images["rows"],
        "rates": evaluated.images["rates"],
    }
    for name, found in evaluated.found.items():
        metrics.setdefault(VARIANTS[name].key, {})[name] = found.scores
    if evaluated.holes:
        metrics["hole_mask"] = evaluated.holes
    references = table_references(tuned.runners, math.prod(run.dataset.info.output) / math.prod(run.dataset.info.size))
    urgent = [f"Dead network: {text}" for text in evaluated.dead] + [f"Warning: {text}" for text in metrics["warnings"]]
    outlines = [tuned.clips.outline(n) for n in range(len(tuned.clips))]
    remarks = [*urgent, *health.training_note(reports), *notes(run.members, names, outlines, tuned.chosen)]
    remarks += [mask_remark(evaluated.holes)] if evaluated.holes else []
    remarks += [found.remark for found in evaluated.found.values()]
    losses = _losses(trainings_of(run.wanted), trained)
    page = write_report(
        out, metrics, curves=evaluated.images["curves"], pictures=evaluated.images["pictures"], notes=remarks,
        references=references, training={stage: {**found, "loss": losses[stage]} for stage, found in reports.items()},
    )  # fmt: skip
    clock.lap("report")
    metrics["seconds"] = {**clock.seconds, "total": round(sum(clock.seconds.values()), 1)}
    write_json(out / "metrics.json", metrics)
    print_table(metrics, references=references, console=console)
    for number, remark in enumerate(remarks):
        console.print(remark, style="yellow" if number < len(urgent) else "dim", markup=False, soft_wrap=True)
    spent = ", ".join(f"{name} {value:.0f} s" for name, value in metrics["seconds"].items())
    files = f"metrics: {out / 'metrics.json'}\nweights: {out / 'weights'}\nreport:  {page}"
    console.print(f"{spent}\n{files}", markup=False, soft_wrap=True)
    return metrics


def stage_reports(trained: Mapping[str, Trained], only: str | None = None) -> dict[str, dict[str, Any]]:
    """Stage -> what training it gave, of all variants or one; of several variants "variant/stage"."""
    return {
        stage if len(trained) == 1 else f"{owner}/{stage}": report
        for owner, found in trained.items()
        for stage, report in found.report.items()
        if only in (None, owner)
    }


def _losses(trainings: Mapping[str, Member], trained: Mapping[str, Trained]) -> dict[str, list[tuple[int, float]]]:
    """Stage, as in ``stage_reports``, -> step and loss of each of its steps."""
    return {
        key: read_losses(member.folder, stage)
        for owner, member in trainings.items()
        for key, stage in zip(stage_reports(trained, owner), trained[owner].report, strict=True)
    }


def costs(runners: Mapping[str, Runner], dataset: Dataset) -> dict[str, dict[str, Any]]:
    """Count, method by method, parameters, multiply-adds of each kind of frame at the dataset's size, latency."""
    found = {}
    for name, runner in runners.items():
        height, width = dataset.info.output if runner.method.info.native else dataset.info.size
        cost = method_cost(runner.method, width, height)
        found[name] = cost._asdict()
    return found


def environment(settings: Settings, reports: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Commit, device, versions, seed and the steps of each stage in ``reports``."""
    steps = {stage: found["steps"] for stage, found in reports.items()}
    return {**machine.environment(), "seed": settings.seed, "steps": steps}
