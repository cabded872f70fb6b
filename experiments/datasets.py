"""The data of a run: a dataset on disk that the user names, or scenes rendered into the run's folder."""

from collections.abc import Callable
from pathlib import Path

from essjax.builtin import Clip, generate, plan
from essjax.data import Dataset
from essjax.scenes import Rendering
from experiments.settings import Settings

ROUNDS = 10_000
"""Scenes per family that belong to one seed of a run."""


def train_clips(settings: Settings, number: int = 0) -> list[Clip]:
    """Round ``number`` of scenes to train on: 0 are those on disk, each further one (``fresh``) has new seeds.

    Runs with different seeds share no scene.
    """
    data = settings.data
    start = settings.seed * ROUNDS + number * data.train_sequences
    return plan("train", data.train_sequences, data.train_frames, spp=data.train_spp, start=start)


def scene_clips(settings: Settings) -> list[Clip]:
    """List the built-in scenes of a run: of all splits."""
    data = settings.data
    return [
        *train_clips(settings),
        *plan("validation", data.validation_sequences, data.test_frames, spp=data.train_spp, native=True),
        *plan("test", data.test_sequences, data.test_frames, spp=data.test_spp, native=True),
    ]


def rendering_of(settings: Settings, *, ranges: bool) -> Rendering:
    """How the built-in scenes of all splits are rendered."""
    data = settings.data
    return Rendering(scale=data.scale, ranges=ranges, mip_bias=data.mip_bias, jitter=data.jitter)


def prepare(
    settings: Settings,
    data: Dataset | None,
    out: Path,
    progress: Callable[[int, int], None],
    *,
    ranges: bool = False,
    native: bool = False,
    trained: bool = True,
) -> Dataset:
    """Check ``data``, or render the built-in scenes into ``out / "scenes"`` (resumes; complete frames are kept).

    Args:
      settings: of the run.
      data: a dataset that the user names, or None to render.
      out: the run's folder.
      progress: called with frames done and in all.
      ranges: the run needs sample ranges.
      native: the run needs colour at native resolution.
      trained: the run trains something; a test split is enough otherwise.

    Raises:
      ValueError: the dataset lacks a split, ranges or colour that a run needs, or was rendered with other settings.
    """
    if data is not None:
        dataset = data
    else:
        rendering, clips = rendering_of(settings, ranges=ranges), scene_clips(settings)
        dataset = generate(out / "scenes", clips, *settings.data.size, rendering=rendering, progress=progress)
    needed = ("train", "validation", "test") if trained else ("test",)
    if not all(map(dataset.splits.get, needed)):
        listed = lambda names: " and ".join(", ".join(names).rsplit(", ", 1))
        raise ValueError(
            f"{dataset.path}: this run needs the split{'s' * trained} {listed(needed)}; this dataset has "
            f"{', '.join(dataset.splits) or 'none'}. Import it again with {listed(f'--{name}' for name in needed)}."
        )
    if ranges and not dataset.info.ranges:
        raise ValueError(
            f"{dataset.path}: a classifier is trained on labels made of the ranges over all samples of each reference "
            "pixel, which this dataset does not have. Render the scenes with --ranges; imported frames have none."
        )
    if native and not dataset.has_native(*evaluated_splits(dataset)):
        raise ValueError(
            f"{dataset.path}: all variants of this run work on frames at native resolution, which this dataset does "
            "not have. Render the scenes with --native; imported frames have none."
        )
    return dataset


def evaluated_splits(dataset: Dataset) -> list[str]:
    """List the splits that methods are run on; one without training may have no validation split."""
    return [split for split in ("validation", "test") if dataset.splits.get(split)]


def describe(dataset: Dataset) -> str:
    """One line: size, scale, sequences and frames per split."""
    info = dataset.info
    parts = []
    for split, segments in dataset.splits.items():
        frames = sum(len(dataset.numbers(segment)) for segment in segments)
        parts.append(f"{split} {len(segments)} sequences, {frames} frames")
    size = f"{info.width}x{info.height} -> {info.output[1]}x{info.output[0]}"
    return f"{size}; {'; '.join(parts)}"
