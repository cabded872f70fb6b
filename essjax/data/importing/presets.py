"""The presets by name, and the import itself: open the dump, write its clips, then ``dataset.json``."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from essjax.data.importing.arm import arm_facts, gym_facts
from essjax.data.importing.blender import open_blender
from essjax.data.importing.dump import MakeFacts, open_dump, unlisted_files
from essjax.data.importing.facts import Facts, generic_facts, no_facts
from essjax.data.importing.files import fill
from essjax.data.importing.recipe import Recipe, load_recipe
from essjax.data.importing.splits import Range, fit_segments, split_segments
from essjax.data.importing.stream import BrokenFrame, Clip, OnFrame, OpenClip, Written, hint, open_clip, write_clip
from essjax.data.importing.unreal import header_facts
from essjax.data.layout import (
    Dataset,
    SequenceInfo,
    check_agreement,
    read_index,
    read_sequence_info,
    write_dataset,
)
from essjax.files import only_writer


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """Everything that an import found and did.

    Attributes:
      dataset: the dataset that was written.
      totals: counts over all frames: ``pixels`` (LR), ``background`` pixels, ``negative`` colour values set to 0,
        ``clamped`` values beyond half's range; ``outside`` values of buffers in [0, 1], clipped; ``mixed`` silhouette
        pixels of static objects whose motion was taken from the cameras (blender); ``unwritten`` pixels likewise;
        ``still`` pixels of a background without motion of its own; ``infinite`` colour values; ``repaired`` pixels.
      skipped: sequence -> broken frame -> what is wrong with it, or first frame of a gap -> which frames are missing.
      imported: the sequences of this import; the dataset may hold others, imported before.
      warnings: what a user should look at.
    """

    dataset: Dataset
    totals: Mapping[str, int]
    skipped: Mapping[str, Mapping[int, str]]
    imported: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    @property
    def sequence(self) -> SequenceInfo:
        """The first sequence of this import."""
        return self.dataset.sequences[self.imported[0]]

    @property
    def dynamic(self) -> tuple[int, ...]:
        """Object ids that move by themselves (blender); others became stencil 0."""
        return tuple(self.sequence.source.get("dynamic", ()))


class Dump(NamedTuple):
    """A dump that is to be opened.

    Attributes:
      source: the dump's folder.
      recipe: a TOML that changes keys of the preset's, or None.
      reference: folder of the references, or None.
      skip_broken: whether broken and missing frames are left out.
      repair: whether single NaN and infinite pixels are mended.
      workers: threads; None: one per core.
    """

    source: Path
    recipe: Path | None
    reference: Path | None
    skip_broken: bool
    repair: bool
    workers: int | None


Preset = Callable[[Dump], tuple[Sequence[Clip], list[str]]]
"""Opens a dump: its clips, and what a user should know; a ValueError names the file and what is missing or wrong."""


def _blender(dump: Dump) -> tuple[Sequence[Clip], list[str]]:
    if dump.repair:
        raise ValueError("the preset blender does not mend pixels: leave --repair out.")
    if dump.recipe is not None or dump.reference is not None:
        raise ValueError("the preset blender takes neither a recipe nor a reference folder: meta.json says it all.")
    return [open_blender(dump.source, workers=dump.workers, skip_broken=dump.skip_broken)], []


def _by_recipe(name: str, facts_of: Callable[[Path, Recipe, str, int, int], Facts]) -> Preset:
    def open_(dump: Dump) -> tuple[Sequence[Clip], list[str]]:
        def facts(sequence: str, recipe: Recipe, width: int, height: int) -> Facts:
            return facts_of(dump.source, recipe, sequence, width, height)

        return _open_by_recipe(name, dump, facts)

    return open_


def _open_by_recipe(name: str, dump: Dump, facts: MakeFacts) -> tuple[Sequence[Clip], list[str]]:
    source, reference = dump.source, dump.reference
    clips = open_dump(source, load_recipe(name, dump.recipe), reference, facts, name, repair=dump.repair)
    missing = [path for clip in clips for path in clip.missing()]
    if missing and not dump.skip_broken:
        raise ValueError(
            f"{source}: {len(missing)} of the images are missing, the first is {missing[0]}. Dump or copy them; "
            "--skip-broken leaves their frames out."
        )
    folders = {"folder": str(source.resolve())}
    if reference is not None:
        folders["reference_folder"] = str(reference.resolve())
    if dump.repair:
        folders["repair"] = "single pixels"
    others = unlisted_files(clips)
    shown = ", ".join(others[:4]) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
    warnings = [f"not imported, because no pattern takes their names: {shown}"] if others else []
    return [dataclasses.replace(clip, source={**clip.source, **folders}) for clip in clips], warnings


def _metadata(read: Callable[[Path, int, int], Facts], otherwise: Callable[[int, int], Facts]) -> Any:
    """Facts from the file that the recipe names, or else ``otherwise``."""

    def facts(source: Path, recipe: Recipe, sequence: str, width: int, height: int) -> Facts:
        if "metadata" in recipe.files:
            return read(source / fill(recipe.files["metadata"], sequence), width, height)
        return otherwise(width, height)

    return facts


def _nothing(width: int, height: int) -> Facts:
    return no_facts


def _from_header(width: int, height: int) -> Facts:
    return lambda number, header: header_facts(header, width, height)


PRESETS: Mapping[str, Preset] = {
    "blender": _blender,
    "unreal": _by_recipe("unreal", _metadata(generic_facts, _from_header)),
    "extranet": _by_recipe("extranet", _metadata(generic_facts, _nothing)),
    "arm-nss": _by_recipe("arm-nss", _metadata(arm_facts, _nothing)),
    "arm-gym": _by_recipe("arm-gym", _metadata(gym_facts, _nothing)),
    "stssnet": _by_recipe("stssnet", _metadata(generic_facts, _nothing)),
    "generic": _by_recipe("generic", _metadata(generic_facts, _nothing)),
}
"""Producers whose conventions are known, by name."""


def import_dataset(
    source: str | os.PathLike,
    out: str | os.PathLike,
    preset: str,
    *,
    recipe: str | os.PathLike | None = None,
    reference: str | os.PathLike | None = None,
    splits: Mapping[str, Range] | None = None,
    name: str | None = None,
    skip_broken: bool = False,
    repair: bool = False,
    workers: int | None = None,
    on_frame: OnFrame = lambda done, total: None,
) -> ImportReport:
    """Import a dump into a dataset; running it again resumes where it was interrupted, or adds what is new.

    New are frames behind the last one, and sequences: those that the dataset holds already stay, and the splits are
    made again of all. What is there was made from the same files by the same recipe, or the import is refused.

    Args:
      source: the dump's folder.
      out: the dataset's folder.
      preset: one of ``PRESETS``.
      recipe: a TOML that changes keys of the preset's; all of it for ``generic``.
      reference: folder with the references, where the dump holds none: files named as the recipe says.
      splits: split -> frames or sequences, see ``splits.split_segments``.
      name: of the sequence, where there is one; None: as in the file names, or the folder's.
      skip_broken: leave broken frames out, with a cut behind them, instead of stopping.
      repair: mend single NaN and infinite pixels from their neighbours, and count them.
      workers: threads; None: one per core.
      on_frame: called with (frames done, frames in all).

    Raises:
      ValueError: names the file and what is missing or wrong, or what ``out`` holds that does not fit.
      OSError: a file cannot be read or written.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}.")
    recipe, reference = (None if path is None else Path(path) for path in (recipe, reference))
    clips, warnings = PRESETS[preset](Dump(Path(source), recipe, reference, skip_broken, repair, workers))
    if name is not None:
        if len(clips) > 1:
            raise ValueError(f"name: the dump has {len(clips)} sequences, which keep their names. Leave it out.")
        clips = [dataclasses.replace(clips[0], name=name)]  # type: ignore[type-var]
    gaps = {clip.name: _gaps(clip.name, clip.numbers, skip_broken) for clip in clips}
    with only_writer(out):
        kept, about = _kept(Path(out), preset, clips, splits)
        numbers = {name: info.numbers for name, info in kept.items()}
        segments = split_segments({**numbers, **{clip.name: clip.numbers for clip in clips}}, splits)
        opened = _open_all(Path(out), clips, kept, skip_broken)
        written = _write(opened, skip_broken, workers, on_frame)
        numbers |= {name: part.info.numbers for name, part in written.items()}
        skipped = {name: {**gaps[name], **part.skipped} for name, part in written.items()}
        skipped = {name: dict(sorted(frames.items())) for name, frames in skipped.items() if frames}
        before = {name: frames for name, frames in about.get("skipped", {}).items() if name in kept}
        about = {
            "preset": preset,
            "skipped": {**before, **{name: list(frames) for name, frames in skipped.items()}},
            "splits": None if splits is None else {split: list(chosen) for split, chosen in splits.items()},
        }
        dataset = write_dataset(out, fit_segments(segments, numbers), source=about)
    totals = _totals([part.info for part in written.values()])
    warnings += _still(totals)
    return ImportReport(dataset, totals, skipped, tuple(written), tuple(warnings))


def _gaps(name: str, numbers: Sequence[int], skip_broken: bool) -> dict[int, str]:
    """First missing number -> which are missing. A ValueError if none may be, or no two are neighbours."""
    pairs = list(zip(numbers, numbers[1:], strict=False))
    spans = [(a + 1, b - 1) for a, b in pairs if b > a + 1]
    gaps = {a: f"frame {a} is missing" if a == b else f"the frames {a}..{b} are missing" for a, b in spans}
    shown = ", ".join(map(str, numbers[:4])) + (", ..." if len(numbers) > 4 else "")
    if pairs and len(gaps) == len(pairs):
        raise ValueError(
            f"sequence {name}: expected frames that follow each other, got {shown}: every one would be a cut. Motion "
            "links a frame to the one before; number them in steps of 1."
        )
    if gaps and not skip_broken:
        raise ValueError(
            f"sequence {name}: {next(iter(gaps.values()))} (gaps in all: {len(gaps)}). Render or copy what is missing; "
            "--skip-broken goes on without, with a cut behind each gap."
        )
    return gaps


def _kept(
    out: Path, preset: str, clips: Sequence[Clip], splits: Mapping[str, Range] | None
) -> tuple[dict[str, SequenceInfo], Mapping[str, Any]]:
    """Sequences that ``out`` holds besides those of this import, and the source of its dataset."""
    if not (out / "dataset.json").exists():
        return {}, {}
    names, about, _ = read_index(out)
    if about.get("preset") != preset:
        made = f"the preset {about['preset']}" if "preset" in about else "another command"
        raise ValueError(
            f"{out}: expected a dataset of the preset {preset}, found one of {made}. Choose another folder."
        )
    kept = {name: read_sequence_info(out, name) for name in names if name not in {clip.name for clip in clips}}
    for name, info in kept.items():
        if not info.complete:
            raise ValueError(f"{out}: sequence {name} is unfinished. First run the import that writes it again.")
    if splits is None and about.get("splits") and {clip.name for clip in clips} - set(names):
        given = ", ".join(f"--{split} {chosen}" for split, chosen in about["splits"].items())
        raise ValueError(
            f"{out}: the splits of this dataset were chosen ({given}). Say what they are with the new sequence: give "
            "train, validation and test."
        )
    return kept, about


def _open_all(out: Path, clips: Sequence[Clip], kept: Mapping[str, SequenceInfo], skip_broken: bool) -> list[OpenClip]:
    """Open every clip; what cannot end well is refused before anything is written."""
    infos, opened = list(kept.values()), []
    for clip in clips:
        folder = (out / clip.name).resolve()
        for parent in {path.parent for number in clip.numbers for path in clip.files(number)}:
            if parent.resolve() == folder:
                raise ValueError(
                    f"{folder}: the dump is there, nothing is written into it. Choose another output folder."
                )
        opened.append(open_clip(out, clip))
        if len(clips) + len(kept) > 1:
            infos.append(opened[-1].writer.info or _first_frame(opened[-1], skip_broken))
    check_agreement(out / "dataset.json", infos)
    return opened


def _first_frame(opened: OpenClip, skip_broken: bool) -> SequenceInfo:
    """Find what the first frame that is not broken says about size and channels."""
    clip, writer, _ = opened
    reasons = []
    for number in clip.numbers:
        try:
            return writer.describe(number, clip.convert(number).content)
        except ValueError as error:
            reasons.append(f"sequence {clip.name}, frame {number}: {BrokenFrame(clip.name, number, error, '')}")
            if not skip_broken:
                raise ValueError(f"{reasons[0]}{hint(opened, number)}") from error
    raise ValueError(f"sequence {clip.name}: all frames are broken. The first: {reasons[0]}")


def _write(opened: Sequence[OpenClip], skip_broken: bool, workers: int | None, on_frame: OnFrame) -> dict[str, Written]:
    done, total = 0, sum(len(one.clip.numbers) for one in opened)

    def step(count: int) -> None:
        nonlocal done
        done += count
        on_frame(done, total)

    return {one.clip.name: write_clip(one, skip_broken=skip_broken, workers=workers, on_frames=step) for one in opened}


def _still(totals: Mapping[str, int]) -> list[str]:
    """Warn about background that does not move with the cameras, as far as it is known."""
    if not totals.get("still"):
        return []
    return [
        f"{totals['still'] / totals['background']:.0%} of the background (sky) holds no motion although surfaces move: "
        "nobody wrote any there. Give the cameras ([files] metadata), and it follows from them; a method takes it for "
        "standing still otherwise"
    ]


def _totals(infos: Sequence[SequenceInfo]) -> dict[str, int]:
    totals: dict[str, int] = {}
    for info in infos:
        for record in info.frames:
            for key, count in record["notes"].items():
                totals[key] = totals.get(key, 0) + count
    return totals
