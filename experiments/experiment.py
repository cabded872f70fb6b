"""One experiment, whether of one variant (``experiments.run``) or of several (``experiments.compare``).

Data, training, tuning of the baselines, evaluation, report: each part resumes where an interrupted run left off.
"""

import contextlib
import dataclasses
import itertools
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from essjax.data import Dataset
from essjax.data.layout import read_json
from essjax.deploy import method_cost
from essjax.typing import PyTree
from experiments import datasets, health
from experiments import environment as machine
from experiments.ahead import Ahead
from experiments.alarm import no_alarm
from experiments.checks import check_dataset, check_settings
from experiments.classes import QUESTIONS, class_remark, evaluate_classes
from experiments.comparison import Trained, make_runners, notes, owner_of, table_references
from experiments.config import Config
from experiments.evaluate import Clip, Clips, Runner, evaluate
from experiments.holes import mask_remark, mask_scores
from experiments.progress import Phases, TrainingProgress
from experiments.report import print_table, write_report
from experiments.report.classes import write_class_sheet
from experiments.tensorboard import Events, check_installed
from experiments.training import initial_variables, read_losses, restore_stages, train_stages
from experiments.variants import VARIANTS, compared, stages_of, trained_as
from experiments.variants.classifier import thresholds


def default_folder(name: str, preset: str, data: str | None) -> Path:
    """Where a run goes without ``--out``: ``runs/NAME-PRESET``, with ``--data`` ``runs/NAME-PRESET-`` and its name."""
    return Path("runs") / "-".join([name, preset, *([Path(data).resolve().name] if data else [])])


def check_folder(out: Path, wanted: Mapping[str, Any], *, resume: bool, eval_only: bool) -> None:
    """Refuse to mix two runs in ``out`` or to start over one that can be resumed; ``out / "run.json"`` says what it is.

    Nothing is written: a run that finds no data leaves nothing that stands in the way of the next.

    Raises:
      ValueError: ``out`` is no folder, holds another run, or one that was not asked to continue.
    """
    path, wanted = out / "run.json", json.loads(json.dumps(wanted))
    file = next((folder for folder in (out, *out.parents) if folder.exists() and not folder.is_dir()), None)
    if file:
        raise ValueError(f"--out {out}: expected a folder, but {file} is a file. Choose another --out.")
    if path.exists():
        found = read_json(path)
        if not (resume or eval_only):
            raise ValueError(
                f"{out} already holds a run. Continue it with --resume, evaluate it with --eval-only, "
                "or choose another --out."
            )
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            pairs = ", ".join(f"{key} was {found.get(key)}, now {wanted[key]}" for key in different)
            raise ValueError(f"{out} holds a run with other settings: {pairs}. Use the same ones, or another --out.")
    elif eval_only:
        raise ValueError(f"--eval-only: {out} holds no run. Give the --out of a trained one.")


def run_experiment(
    names: Sequence[str],
    configs: Mapping[str, Config],
    folders: Mapping[str, Path],
    *,
    preset: str,
    overrides: Sequence[str],
    data: str | None,
    out: Path,
    wanted: Mapping[str, Any],
    eval_only: bool,
    console: Console,
    tensorboard: bool = False,
) -> dict[str, Any]:
    """Run everything and write ``out / "metrics.json"`` and ``out / "report"``.

    Args:
      names: the variants.
      configs: variant -> its settings; all agree in everything but training.
      folders: variant -> where its checkpoints and logs lie.
      preset: name of the preset, for the record.
      overrides: of the command line on top of it, for the record.
      data: a dataset's folder, or None to render the built-in scenes into ``out``.
      out: folder of the results.
      wanted: what ``check_folder`` found to fit; kept in ``out / "run.json"`` as soon as there is data.
      eval_only: do not train, restore.
      console: where progress and tables are printed.
      tensorboard: write TensorBoard events into the variants' folders.

    Returns:
      The content of ``metrics.json``.

    Raises:
      ValueError: settings or data that do not fit, or of which no frame would be scored.
    """
    if tensorboard:
        check_installed()
    if data is None:
        check_settings(names, configs)
    config, clock, seconds = configs[names[0]], time.monotonic(), {}

    def lap(name: str) -> None:
        nonlocal clock
        now = time.monotonic()
        seconds[name], clock = round(now - clock, 1), now

    with no_alarm(), Phases(console) as phases, contextlib.ExitStack() as stack:
        phases.show("data", text="reading" if data else "rendering")

        def on_frame(n: int, total: int) -> None:
            phases.show("data", n / total, f"{n}/{total}")

        classifiers = [name for name in names if any(stage.ranges for stage in stages_of(name, configs[name]))]
        native = all(VARIANTS[name].method(configs[name]).info.native for name in names)
        first = next(iter(_trainings(names, configs)), None)
        steps = None
        if first and data is None and not (out / "run.json").exists():  # else stages may have been trained already
            stages = stages_of(first, configs[first])
            steps = stack.enter_context(contextlib.closing(Ahead(stages, configs[first]))).steps
        dataset = datasets.prepare(config, data, out, on_frame, ranges=bool(classifiers), native=native)
        # Labels depend on the size of the image: a user's data has its own.
        size = (dataset.info.width, dataset.info.height)
        configs = {name: dataclasses.replace(each, size=size) for name, each in configs.items()}
        config = configs[names[0]]
        phases.show("data", 1.0, f"{len(dataset.sequences)} sequences")
        console.print(datasets.describe(dataset), soft_wrap=True)
        check_dataset(names, configs, dataset)
        # What training would refuse is refused here.
        initial = {
            name: initial_variables(stages_of(name, configs[name]), dataset, configs[name])
            for name in _trainings(names, configs)
        }
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / "run.json", wanted)  # from here on there is something to resume
        lap("data")

        trained = _train_all(names, configs, folders, dataset, initial, eval_only, phases, steps, tensorboard)
        reports = stage_reports(trained)
        lap("training")
        # Of all sessions: the clock above saw only this one, which may have restored everything.
        for part, key in {
            "compilation": "compile_seconds",
            "training": "seconds",
            "validation": "validation_seconds",
        }.items():
            seconds[part] = round(sum(report[key] for report in reports.values()), 1)

        phases.show("tuning", text="reading")
        methods = [VARIANTS[row].method(config) for row in compared(names)]
        native = any(method.info.native for method in methods) and dataset.has_native("validation", "test")
        options = {"native": native, "ranges": bool(classifiers)}
        validation, clips = (Clips(dataset, split, config.warmup, **options) for split in ("validation", "test"))
        runners, settings = make_runners(
            names, config, trained, validation, out, lambda text: phases.show("tuning", text=text)
        )
        phases.show("tuning", 1.0)
        del validation  # and the memory of what it kept
        lap("tuning")
        done = itertools.count()
        result = evaluate(
            runners,
            clips,
            pictures=config.pictures,
            on_step=lambda text: phases.show("evaluation", next(done) / (len(runners) * len(clips)), text),
        )
        classes = _evaluate_classes({name: runners[name] for name in classifiers}, configs, clips, out)
        hole_scores = mask_scores(clips)
        dead = health.still_stages(reports) + _dead_methods(names, runners, trained, result["rows"], clips[0])
        phases.show("evaluation", 1.0)
        lap("evaluation")
    metrics = {
        "schema": 1,
        "variant": ", ".join(names),
        "preset": preset,
        "overrides": list(overrides),
        "configs": {name: dataclasses.asdict(each) for name, each in configs.items()},
        "dataset": datasets.describe(dataset),
        "environment": environment(config, reports),
        "settings": {name: setting._asdict() for name, setting in settings.items()},
        "seconds": seconds,
        "training": {stage: {**found, "terms": {}} for stage, found in reports.items()},
        "dead": dead,
        "warnings": health.few_steps(reports) + health.no_gain(reports),
        "costs": costs(runners, dataset),
        "rows": result["rows"],
    }
    if classes:
        metrics["classes"] = classes
    if hole_scores:
        metrics["hole_mask"] = hole_scores
    references = table_references(runners, dataset.info.scale)
    remarks = [f"Dead network: {text}" for text in dead] + [f"Warning: {text}" for text in metrics["warnings"]]
    remarks += health.training_note(reports)
    urgent = len(dead) + len(metrics["warnings"])
    remarks += notes(names, dataset, [clips.outline(n) for n in range(len(clips))], settings, config)
    remarks += [mask_remark(hole_scores)] if hole_scores else []
    remarks += [class_remark(name, scores) for name, scores in classes.items()]
    losses = _losses(_trainings(names, configs), trained, folders)
    page = write_report(
        out, metrics, curves=result["curves"], pictures=result["pictures"], notes=remarks, references=references,
        training={stage: {**found, "loss": losses[stage]} for stage, found in reports.items()},
    )  # fmt: skip
    lap("report")
    metrics["seconds"] = {**seconds, "total": round(sum(seconds.values()), 1)}
    write_json(out / "metrics.json", metrics)
    print_table(metrics, references=references, console=console)
    for number, remark in enumerate(remarks):
        console.print(remark, style="yellow" if number < urgent else "dim", markup=False, soft_wrap=True)
    spent = ", ".join(f"{name} {value:.0f} s" for name, value in metrics["seconds"].items())
    console.print(f"{spent}\nmetrics: {out / 'metrics.json'}\nreport:  {page}", markup=False, soft_wrap=True)
    return metrics


def _trainings(names: Sequence[str], configs: Mapping[str, Config]) -> dict[str, str]:
    """The variants to be trained, in order, each with the one that it has its weights from, which is trained once."""
    found: dict[str, str] = {}
    for name in names:
        if stages_of(name, configs[name]) and trained_as(name) not in found.values():
            found[name] = trained_as(name)
    return found


def _train_all(
    names: Sequence[str],
    configs: Mapping[str, Config],
    folders: Mapping[str, Path],
    dataset: Dataset,
    initial: Mapping[str, PyTree],
    eval_only: bool,
    phases: Phases,
    first_steps: Mapping[str, Any] | None,
    tensorboard: bool,
) -> dict[str, Trained]:
    """Train (or restore) each variant that ``names`` take their weights from, once; the first with ``first_steps``."""
    trained: dict[str, Trained] = {}
    for name, base in _trainings(names, configs).items():
        config, stages, folder = configs[name], stages_of(name, configs[name]), folders[name]
        if eval_only:
            variables, report = restore_stages(stages, dataset, config, folder, initial[name])
        else:
            if not config.vgg and any(stage.vgg for stage in stages):
                phases.console.print(
                    "VGG term off: give torchvision-layout VGG-16 weights with --set vgg=PATH to switch it on.",
                    soft_wrap=True,
                )
            steps = None if trained else first_steps
            events = Events(folder / "tensorboard") if tensorboard else None
            watcher = TrainingProgress(phases, "" if len(names) == 1 else f"{base}: ", events)
            with contextlib.closing(watcher):
                variables, report = train_stages(stages, dataset, config, folder, initial[name], watcher, steps)
        trained[base] = Trained(initial[name], variables, config, report)
    return trained


def stage_reports(trained: Mapping[str, Trained], only: str | None = None) -> dict[str, dict[str, Any]]:
    """Stage -> what training it gave, of all variants or one; of several variants "variant/stage"."""
    return {
        stage if len(trained) == 1 else f"{base}/{stage}": report
        for base, found in trained.items()
        for stage, report in found.report.items()
        if only in (None, base)
    }


def _dead_methods(
    names: Sequence[str],
    runners: Mapping[str, Runner],
    trained: Mapping[str, Trained],
    rows: Sequence[Mapping[str, Any]],
    clip: Clip,
) -> list[str]:
    """A message for each method whose pictures say that its network does nothing."""
    # After a few steps hardly anything is seen; that they were few is said.
    learned = {base for base, found in trained.items() if not health.has_few_steps(found.report)}
    owners = {row: owner_of(row, names, trained) for row in runners}
    owners = {row: owner if owner in learned else None for row, owner in owners.items()}
    messages = health.same_rows(rows, owners)
    for row in names:
        owner = owners.get(row)
        if owner:
            messages += health.unchanged(row, runners[row], trained[owner].initial, clip)
    return messages


def _losses(
    trainings: Mapping[str, str], trained: Mapping[str, Trained], folders: Mapping[str, Path]
) -> dict[str, list[tuple[int, float]]]:
    """Stage, as in ``stage_reports``, -> step and loss of each of its steps."""
    return {
        key: read_losses(folders[name], stage)
        for name, base in trainings.items()
        for key, stage in zip(stage_reports(trained, base), trained[base].report, strict=True)
    }


def costs(runners: Mapping[str, Runner], dataset: Dataset) -> dict[str, dict[str, Any]]:
    """Method -> parameters, multiply-adds per frame of each kind at this dataset's size, latency in frames."""
    found = {}
    for name, runner in runners.items():
        enlarged = dataset.info.scale if runner.method.info.native else 1
        cost = method_cost(runner.method, dataset.info.width * enlarged, dataset.info.height * enlarged)
        found[name] = cost._asdict()
    return found


def _evaluate_classes(
    runners: Mapping[str, Runner], configs: Mapping[str, Config], clips: Sequence[Clip], out: Path
) -> dict[str, Any]:
    """Scores of each classifier against the automatic labels, and its maps as pictures beside the report."""
    found = {}
    for name, runner in runners.items():
        limits = thresholds(configs[name])
        scores, maps = evaluate_classes(runner.method, runner.variables, clips, limits, configs[name].compiler_options)
        if scores:
            found[name] = scores
        for each in maps:
            title = f"{each.sequence}, frame {each.frame}"
            write_class_sheet(out / "report", title, each.reference, each.predicted, each.automatic, QUESTIONS)
    return found


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write or replace ``path`` at once, never half."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)


def environment(config: Config, reports: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Commit, device, versions, seed and the steps of each stage in ``reports``."""
    steps = {stage: found["steps"] for stage, found in reports.items()}
    return {**machine.environment(), "seed": config.seed, "steps": steps}
