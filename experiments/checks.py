"""Checks before anything is rendered, read or trained: settings and data that do not fit together."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from essjax.data import Dataset, Segment
from essjax.interfaces import MethodInfo
from essjax.scenes import make_scene
from essjax.sizes import Size, describe_scale, output_size, scale_of
from experiments.datasets import scene_clips
from experiments.evaluate import scored_frames
from experiments.members import Member
from experiments.settings import Settings
from experiments.training import check_batches, check_crop

SSIM_WINDOW = 11
"""Pixels: frames that are smaller cannot be scored."""


def check_settings(members: Sequence[Member]) -> None:
    """Refuse settings that the built-in scenes cannot be trained or scored with; nothing is rendered for it.

    Raises:
      ValueError: the crop is too small, a variant has another scale, or a sequence has no frame that is scored.
    """
    settings = members[0].settings
    size = settings.data.size[::-1]
    output = output_size(settings.data.scale, size)
    for member in members:
        for stage in member.stages:
            check_crop(stage.settings, *settings.data.size, settings.data.scale)
        reason = unfit_scale(member.method.info, size, output)
        if reason:
            raise ValueError(f"{member.name}: {reason}. Set data.scale, or leave it out.")
    clips = scene_clips(settings)
    for split in scored_splits(settings):
        cuts = {clip.name: make_scene(clip.family, clip.seed, clip.frames).cut for clip in clips if clip.split == split}
        warmup = settings.evaluation.warmup
        empty = [name for name, cut in cuts.items() if not scored_frames(cut, [True] * len(cut), warmup)]
        _refuse_empty("the built-in scenes", split, empty, settings)


def check_dataset(members: Sequence[Member], dataset: Dataset) -> None:
    """Refuse data that the variants cannot be trained on or scored with, from its records alone.

    Raises:
      ValueError: a sequence has no frame that is scored, a variant needs buffers, a scale or frames that the data
        lacks, or no clip can be cut out of it.
    """
    width, height = dataset.info.width, dataset.info.height
    if min(width, height) < SSIM_WINDOW:
        raise ValueError(
            f"{dataset.path}: expected frames of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, the window of SSIM, got "
            f"{width}x{height}."
        )
    check_scored(dataset, members[0].settings)
    for member in members:
        reason = unfit(member.method.info, {"motion", *dataset.info.channels}, dataset.info.size, dataset.info.output)
        if reason:
            raise ValueError(f"{dataset.path}: {member.name} cannot run on it: {reason}. Leave it out, or import more.")
        for stage in member.stages:
            check_batches(dataset, member.settings, stage)


def check_scored(dataset: Dataset, settings: Settings) -> None:
    """Refuse data with sequences of which no frame is scored, before anything is trained.

    Raises:
      ValueError: a test sequence, or a validation sequence where they are used, is all warm-up.
    """
    for split in (split for split in scored_splits(settings) if dataset.splits.get(split)):
        empty = [segment.sequence for segment in dataset.segments(split) if not _has_scored(dataset, segment, settings)]
        _refuse_empty(dataset.path, split, empty, settings)


def scored_splits(settings: Settings) -> tuple[str, ...]:
    """List the splits whose frames are scored in a run."""
    return ("validation", "test") if settings.evaluation.tune or settings.training.validations else ("test",)


def _has_scored(dataset: Dataset, segment: Segment, settings: Settings) -> bool:
    """Say whether ``load_clip`` will find frames that are scored, without reading an image."""
    cuts = {record["number"]: record["cut"] for record in dataset.sequences[segment.sequence].frames}
    numbers = dataset.numbers(segment)
    return bool(scored_frames([cuts[n] for n in numbers], dataset.scored(segment), settings.evaluation.warmup))


def _refuse_empty(where: str | Path, split: str, empty: Sequence[str], settings: Settings) -> None:
    if empty:
        raise ValueError(
            f"{where}, split {split}: expected frames to score in every sequence, got none in "
            f"{', '.join(empty)}: all are among the {settings.evaluation.warmup} that warm up at the start and after a "
            "cut. Give longer sequences, or fewer frames to warm up with --set evaluation.warmup=N."
        )


def unfit(info: MethodInfo, images: Iterable[str], size: Size, output: Size) -> str:
    """Why a method cannot be run and scored on frames that hold ``images``, or an empty string.

    Args:
      info: of the method.
      images: names of what a frame holds.
      size: (height, width) of the frames.
      output: of the references.
    """
    missing = sorted(info.requires - set(images))
    if missing:
        return f"this dataset has no {', '.join(missing)}"
    return unfit_scale(info, size, output)


def unfit_scale(info: MethodInfo, size: Size, output: Size) -> str:
    """Why the output of a method has not the size of the data's references, or an empty string."""
    (high, wide), of_data = output, describe_scale(scale_of(size, output))
    try:
        own = output_size(info.scale, size)
    except ValueError as error:
        return str(error)
    if info.scale != 1 and own != output:
        return (
            f"its output ({describe_scale(info.scale)}) is {own[1]}x{own[0]}, this dataset's reference ({of_data}) is "
            f"{wide}x{high}"
        )
    return ""
