"""The presets by name, and the import itself: open the dump, write its clips, then ``dataset.json``."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from essjax.data.importing.arm import arm_facts
from essjax.data.importing.blender import open_blender
from essjax.data.importing.dump import MakeFacts, open_dump
from essjax.data.importing.facts import Facts, generic_facts, no_facts
from essjax.data.importing.files import fill
from essjax.data.importing.recipe import Recipe, load_recipe
from essjax.data.importing.splits import Range, fit_segments, split_segments
from essjax.data.importing.stream import Clip, OnFrame, Written, write_clip
from essjax.data.importing.unreal import header_facts
from essjax.data.layout import Dataset, SequenceInfo, write_dataset

PRESETS = ("blender", "unreal", "extranet", "arm-nss", "generic")


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What an import found and did.

    Attributes:
      dataset: the dataset that was written.
      totals: counts over all frames: ``pixels`` (LR), ``background`` pixels, ``negative`` colour values set to 0,
        ``clamped`` values beyond half's range; ``mixed`` silhouette pixels of static objects whose motion was taken
        from the cameras (blender); ``unwritten`` pixels likewise (unreal); ``infinite`` colour values.
      skipped: sequence -> broken frame -> what is wrong with it ("" if an earlier, interrupted run found out).
    """

    dataset: Dataset
    totals: Mapping[str, int]
    skipped: Mapping[str, Mapping[int, str]]

    @property
    def sequence(self) -> SequenceInfo:
        """The first sequence."""
        return self.dataset.info

    @property
    def dynamic(self) -> tuple[int, ...]:
        """Object ids that move by themselves (blender); others became stencil 0."""
        return tuple(self.sequence.source.get("dynamic", ()))


def _facts(source: Path, preset: str) -> MakeFacts:
    def make(sequence: str, recipe: Recipe, width: int, height: int) -> Facts:
        if "metadata" in recipe.files:
            path = source / fill(recipe.files["metadata"], sequence)
            return (arm_facts if preset == "arm-nss" else generic_facts)(path, width, height)
        if preset == "unreal":
            return lambda number, header: header_facts(header, width, height)
        return no_facts

    return make


def _open(
    source: Path, preset: str, recipe: Path | None, reference: Path | None, workers: int | None, skip_broken: bool
) -> Sequence[Clip]:
    if preset == "blender":
        if recipe is not None or reference is not None:
            raise ValueError("the preset blender takes neither a recipe nor a reference folder: meta.json says it all.")
        return [open_blender(source, workers=workers, skip_broken=skip_broken)]
    clips = open_dump(source, load_recipe(preset, recipe), reference, _facts(source, preset), preset)
    missing = [path for clip in clips for path in clip.missing()]
    if missing and not skip_broken:
        raise ValueError(
            f"{source}: {len(missing)} of the images are missing, the first is {missing[0]}. Dump or copy them; "
            "--skip-broken leaves their frames out."
        )
    return clips


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
    workers: int | None = None,
    on_frame: OnFrame = lambda done, total: None,
) -> ImportReport:
    """Import a dump into a dataset; running it again resumes where it was interrupted.

    Args:
      source: the dump's folder.
      out: the dataset's folder.
      preset: one of ``PRESETS``.
      recipe: a TOML that changes keys of the preset's; all of it for ``generic``.
      reference: folder with the references, where the dump holds none: files named as the recipe says.
      splits: split -> frames or sequences, see ``splits.split_segments``.
      name: of the sequence, where there is one; None: as in the file names, or the folder's.
      skip_broken: leave broken frames out, with a cut behind them, instead of stopping.
      workers: threads; None: one per core.
      on_frame: called with (frames done, frames in all).

    Raises:
      ValueError: names the file and what is missing or wrong.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}.")
    recipe, reference = (None if path is None else Path(path) for path in (recipe, reference))
    clips = _open(Path(source), preset, recipe, reference, workers, skip_broken)
    if name is not None:
        if len(clips) > 1:
            raise ValueError(f"name: the dump has {len(clips)} sequences, which keep their names. Leave it out.")
        clips = [dataclasses.replace(clips[0], name=name)]  # type: ignore[type-var]
    segments = split_segments({clip.name: clip.numbers for clip in clips}, splits)
    written = _write(out, clips, skip_broken, workers, on_frame)
    skipped = {clip: part.skipped for clip, part in written.items() if part.skipped}
    numbers = {clip: part.info.numbers for clip, part in written.items()}
    about = {"preset": preset, "skipped": {clip: sorted(frames) for clip, frames in skipped.items()}}
    dataset = write_dataset(out, fit_segments(segments, numbers), source=about)
    return ImportReport(dataset, _totals([part.info for part in written.values()]), skipped)


def _write(
    out: str | os.PathLike, clips: Sequence[Clip], skip_broken: bool, workers: int | None, on_frame: OnFrame
) -> dict[str, Written]:
    done, total = 0, sum(len(clip.numbers) for clip in clips)

    def step(count: int) -> None:
        nonlocal done
        done += count
        on_frame(done, total)

    return {
        clip.name: write_clip(out, clip, skip_broken=skip_broken, workers=workers, on_frames=step) for clip in clips
    }


def _totals(infos: Sequence[SequenceInfo]) -> dict[str, int]:
    totals: dict[str, int] = {}
    for info in infos:
        for record in info.frames:
            for key, count in record["notes"].items():
                totals[key] = totals.get(key, 0) + count
    return totals
