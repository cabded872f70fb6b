"""The ``essjax`` command: make, import and check datasets. ``essjax --help`` lists the commands."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from essjax.builtin import generate, plan
from essjax.data import Dataset, ImportReport, import_dataset
from essjax.data.check import CheckReport, check_dataset
from essjax.data.guess import guess_recipe, to_toml
from essjax.data.importing.draft import CERTAIN, LIKELY, UNKNOWN
from essjax.data.json_files import write_json
from essjax.data.layout import read_dataset
from essjax.files import atomic
from essjax.kernels import check_platform
from essjax.scenes import Rendering
from essjax.sizes import Scale, check_scale, describe_scale
from essjax.stopping import stoppable

_console = Console()


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar of frames; yields a function of (done, total)."""
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=_console) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def parse_size(text: str, option: str = "--size") -> tuple[int, int]:
    """``"128x72"`` as (width, height)."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if width < 1 or height < 1:
        raise ValueError(f"{option}: expected WIDTHxHEIGHT such as 128x72, got {text!r}.")
    return width, height


def parse_scale(text: str) -> Scale:
    """``"1.5"`` or ``"1920x1080"``."""
    if "x" in text.lower():
        return parse_size(text, "--scale")
    try:
        return check_scale(float(text))
    except ValueError as error:
        raise ValueError(f"--scale: expected a number >= 1, or WIDTHxHEIGHT, got {text!r}.") from error


def parse_range(text: str, option: str) -> tuple[int, int]:
    """``"8:19"`` as (8, 19): first and last frame, both included."""
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        first, last = 0, -1
    if last < first:
        raise ValueError(f"{option}: expected FIRST:LAST such as 8:19, both included, got {text!r}.")
    return first, last


def parse_split(text: str, option: str) -> tuple[int, int] | list[str]:
    """``"8:19"`` as ``parse_range``; anything without a colon as names of sequences, separated by commas."""
    return parse_range(text, option) if ":" in text else [name.strip() for name in text.split(",")]


def _check_folder(path: Path, option: str) -> None:
    """Raise a ValueError unless a folder can take files, or can be made; before the work that fills it."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not there.is_dir():
        raise ValueError(f"{option}: expected a folder, but {there} is a file.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{option}: expected a folder that may be written to, got {path} ({there} may not).")


def _print_dataset(dataset: Dataset) -> None:
    info = dataset.info
    table = Table(
        title=f"{dataset.path}: {info.width}x{info.height} -> {describe_scale(info.scale)}", title_justify="left"
    )
    for column in ("split", "sequence", "frames", "scored from"):
        table.add_column(column)
    for split, segments in dataset.splits.items():
        for segment in segments:
            table.add_row(split, segment.sequence, f"{segment.first}-{segment.last}", str(segment.score_from))
    _console.print(table)
    native = [split for split in dataset.splits if dataset.has_native(split)]
    extra = (f"; native frames ({', '.join(native)})" if native else "") + ("; sample ranges" if info.ranges else "")
    _console.print(f"buffers: {', '.join(info.channels)}{extra}")


def scenes(
    out: tyro.conf.Positional[Path],
    /,
    split: Literal["train", "validation", "test"] = "train",
    sequences: int = 2,
    frames: int = 32,
    size: str = "128x72",
    scale: str = "2",
    spp: int = 64,
    families: str = "",
    native: bool = False,
    ranges: bool = False,
    seed: int = 0,
    mip_bias: float = 0.0,
    jitter: Literal["kronecker", "dlctus"] = "kronecker",
) -> None:
    """Render built-in scenes into a dataset. Interrupted, the same command resumes; other splits can be added.

    Args:
      out: The dataset's folder.
      split: Which seeds and families: those of different splits are disjoint.
      sequences: Sequences per family.
      frames: Frames per sequence.
      size: Size of the rendered frames, WIDTHxHEIGHT.
      scale: Size of the reference over that of the frames, such as 1.5, or its size, WIDTHxHEIGHT.
      spp: Samples per pixel of the reference.
      families: Only these, separated by commas; all of the split if empty.
      native: Also 1-sample frames at the reference's size, the input of native TAA.
      ranges: Also the ranges over the reference's samples, which a classifier is trained on.
      seed: Skip this many seeds of the split.
      mip_bias: Texture filter, log2 of its width over an output pixel's.
      jitter: Pattern of the sample positions: kronecker serves every rate, dlctus only all frames rendered.
    """
    width, height = parse_size(size)
    chosen = [name.strip() for name in families.split(",")] if families else None
    clips = plan(split, sequences, frames, spp=spp, native=native, families=chosen, start=seed)
    rendering = Rendering(scale=parse_scale(scale), ranges=ranges, mip_bias=mip_bias, jitter=jitter)
    with progress_bar("rendering") as progress:
        dataset = generate(out, clips, width, height, progress=progress, rendering=rendering)
    _print_dataset(dataset)


_COUNTS = {
    "mixed": ("mixed silhouette pixels", "motion from cameras"),
    "unwritten": ("pixels without a velocity", "motion from cameras"),
    "negative": ("negative colour values", "set to 0"),
    "infinite": ("infinite colour values", "clamped"),
    "repaired": ("NaN and infinite pixels", "set to the median of their neighbours"),
    "clamped": ("values beyond half's range", "clamped"),
    "outside": ("buffer values outside [0, 1]", "clipped"),
}


def _print_report(report: ImportReport) -> None:
    _print_dataset(report.dataset)
    totals, table = report.totals, Table(title="conversion", title_justify="left", show_header=False)
    table.add_row("frames", str(sum(len(report.dataset.sequences[name].frames) for name in report.imported)))
    table.add_row("background", f"{totals['background'] / totals['pixels']:.1%} of pixels, masked")
    for key, text in _COUNTS.items():
        if key in totals:
            table.add_row(text[0], f"{totals[key]}, {text[1]}")
    if "dynamic" in report.sequence.source:
        table.add_row("objects that move", ", ".join(map(str, report.dynamic)) or "none found")
    if report.sequence.source.get("reference") == "color":
        table.add_row("reference", "none in the dump: the colour itself, scale 1")
    _console.print(table)
    for warning in report.warnings:
        _console.print(f"warning: {warning}.", style="yellow", markup=False, highlight=False, soft_wrap=True)
    for name, frames in report.skipped.items():
        for number, reason in frames.items():
            text = f"left out, a cut follows: {name}, frame {number}: {reason}"
            _console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


def import_(
    source: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    preset: str = "blender",
    recipe: Path | None = None,
    reference: Path | None = None,
    train: str = "",
    validation: str = "",
    test: str = "",
    name: str = "",
    skip_broken: bool = False,
    repair: bool = False,
    guess: bool = False,
    yes: bool = False,
) -> None:
    """Import rendered frames into a dataset, converting their conventions. Interrupted, the same command resumes; a
    clip that has grown, or another clip, is added to the dataset.

    docs/guides/importing.md has an example of every preset.

    Args:
      source: The folder as the renderer wrote it.
      out: The dataset's folder.
      preset: The producer's conventions: blender, unreal, extranet, arm-nss, arm-gym, stssnet or generic.
      recipe: TOML that says a dump's files, channels and conventions, or changes a preset's; generic needs one.
      reference: Folder with the references, named as the preset's colour, where the dump itself has none.
      train: First and last frame to train on, such as 8:19, or names of sequences, such as a,b; give all three or none
        (60, 10 and 30 % in order, of the sequences if there are three or more).
        Clips below 10 frames are all test.
      validation: The same, to validate on; streamed from the clip's start.
      test: The same, to test on; streamed from the clip's start.
      name: Name of the sequence; as in the dump if empty.
      skip_broken: Leave out broken and missing frames (the next one becomes a cut) instead of stopping at them.
      repair: Mend single NaN and infinite pixels from their neighbours, counted, instead of stopping at their frame.
      guess: Find out what the dump is and write it to OUT.toml, with what is certain, likely and unknown.
      yes: With --guess: import by what was found, too; nothing is imported otherwise.
    """
    if guess:
        preset, recipe = _guess(source, out)
        if not yes:
            chosen = f"--preset {preset}" + ("" if recipe is None else f" --recipe {recipe}")
            _console.print(f"essjax import {source} {out} {chosen}", markup=False, soft_wrap=True)
            return
    _check_folder(out, "OUT")
    given = {"train": train, "validation": validation, "test": test}
    splits = {split: parse_split(text, f"--{split}") for split, text in given.items() if text}
    with progress_bar("importing") as progress:
        report = import_dataset(
            source,
            out,
            preset,
            recipe=recipe,
            reference=reference,
            splits=splits or None,
            name=name or None,
            skip_broken=skip_broken,
            repair=repair,
            on_frame=progress,
        )
    _print_report(report)


SURE_STYLES = {CERTAIN: "green", LIKELY: "cyan", UNKNOWN: "bold yellow"}


def _guess(source: Path, out: Path) -> tuple[str, Path | None]:
    """Write and print what a dump seems to be; its preset and recipe."""
    path = out.with_name(f"{out.name}.toml")
    if path.exists():
        raise ValueError(
            f"{path}: it is there already. Import with it (--recipe {path}), or delete it and guess again."
        )
    if not source.is_dir():
        raise ValueError(f"{source}: expected the dump's folder.")
    with _console.status("trying conventions on the pictures"):
        found = guess_recipe(source)
    table = Table(title=f"{source}: {found.preset}", title_justify="left")
    for column in ("key", "value", "sure", "because"):
        table.add_column(column)
    for name, (sure, why) in found.notes.items():
        group, _, key = name.partition(".")
        value = found.content.get(group, {}).get(key, "") if key else found.preset
        table.add_row(escape(name), escape(str(value)), f"[{SURE_STYLES[sure]}]{sure}[/]", escape(why))
    _console.print(table)
    if found.preset != "generic":
        return found.preset, None
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        temporary.write_text(to_toml(found.content, found.notes), encoding="utf-8")
    _console.print(f"wrote {path}: look at what is unknown, then:", markup=False, soft_wrap=True)
    return found.preset, path


VERDICT_STYLES = {"ok": "green", "not decidable": "cyan", "warning": "yellow", "wrong": "bold red"}


def _print_check(report: CheckReport, path: Path) -> None:
    title = f"{path}: {report.verdict}; looked at {report.looked_at} of {report.frames} frames"
    table = Table(title=title, title_justify="left")
    for column in ("check", "verdict", "found"):
        table.add_column(column)
    for finding in report.findings:
        style = VERDICT_STYLES[finding.verdict]
        table.add_row(finding.check, f"[{style}]{finding.verdict}[/]", escape(finding.found))
    _console.print(table)
    fixes = {finding.fix: finding.check for finding in reversed(report.findings) if finding.fix}
    for fix, name in reversed(fixes.items()):
        _console.print(f"{name}: {fix}", markup=False, soft_wrap=True)


def check(
    dataset: tyro.conf.Positional[Path],
    /,
    pairs: int = 24,
    json: Path | None = None,
    pictures: Path | None = None,
) -> int:
    """Prove a dataset's conventions on its own pictures; exit code 1 if something is wrong.

    Args:
      dataset: The dataset's folder.
      pairs: Pairs of neighbouring frames per sequence to look at, evenly spread; 0 for all.
      json: Also write the findings to this file.
      pictures: Also write pictures to this folder: the previous reference warped, the present one, the difference.
    """
    opened = read_dataset(dataset)
    if pictures is not None:
        _check_folder(pictures, "--pictures")
    if json is not None:
        if json.is_dir() or not json.parent.is_dir():
            raise ValueError(f"--json: expected a file in a folder that is there, got {json}.")
        _check_folder(json.parent, "--json")
    with progress_bar("checking") as progress:
        report = check_dataset(opened, pairs=pairs, pictures=pictures, progress=progress)
    _print_check(report, dataset)
    if json is not None:
        write_json(json, report.as_json())
    for path in report.pictures:
        _console.print(f"wrote {path}", markup=False, soft_wrap=True)
    return int(report.verdict == "wrong")


COMMANDS: dict[str, Callable[..., int | None]] = {"scenes": scenes, "import": import_, "check": check}
"""Command name -> function; its arguments and docstring are the command's. It may return an exit code."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; bad input and a failing disk print one line and return 2, Ctrl-C returns 130, SIGTERM 143."""

    def command() -> int:
        check_platform()
        return tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="essjax", description=__doc__, args=argv) or 0

    try:
        return stoppable(command, _say_waiting, _say_stopped)
    except ValueError as error:
        _console.print(f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        return 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        text = f"error: {where}{error.strerror or error}. Is it the right path, may it be used, is the disk full?"
        _console.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        _say_stopped()
        return 130


def _say_waiting() -> None:
    _console.print("stopping after the frames in hand; once more to stop at once", soft_wrap=True)


def _say_stopped(text: str = "") -> None:
    _console.show_cursor()  # progress bars hide it
    _console.print(f"interrupted; {text or 'run the same command again to resume.'}", markup=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
