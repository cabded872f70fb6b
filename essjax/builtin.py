"""Joins the built-in renderer and the dataset: render scenes to disk, resumably, or live into memory."""

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import essjax.frames
from essjax.data import CachedSource, Dataset, SequenceWriter, read_dataset, write_dataset
from essjax.files import only_writer
from essjax.scenes import (
    EXTRA_FAMILIES,
    FAMILIES,
    Rendering,
    families_of,
    make_scene,
    render_frame,
    render_sequence,
    split_seeds,
)
from essjax.scenes.sequence import USUAL
from essjax.sizes import output_size, scale_of
from essjax.stopping import finishing

RENDERER = "essjax.scenes 4"
"""How datasets of the built-in renderer name it; the number grows when the same seed gives another picture."""
UNSAID = {"jitter": "kronecker", "ranges": False}
"""Settings that a dataset names only if they differ from these: it may be older than the choice."""
Progress = Callable[[int, int], Any]
"""Called with (frames done, frames in all)."""


class Clip(NamedTuple):
    """One sequence to render.

    Attributes:
      split: "train", "validation" or "test".
      family: of scenes.
      seed: of the scene.
      frames: how many.
      spp: samples per pixel of the reference.
      native: also frames at the reference's size (the input of native TAA).
    """

    split: str
    family: str
    seed: int
    frames: int
    spp: int = 64
    native: bool = False

    @property
    def name(self) -> str:
        """Name of the sequence on disk."""
        return f"{self.split}-{self.family}-{self.seed:04d}"

    def rendered(self, rendering: Rendering) -> Rendering:
        """Adapt ``rendering`` to what this clip says of it."""
        return rendering._replace(spp=self.spp, native=self.native)


def plan(
    split: str,
    sequences: int,
    frames: int,
    *,
    spp: int = 64,
    native: bool = False,
    families: Iterable[str] | None = None,
    start: int = 0,
) -> list[Clip]:
    """Clips of a split: ``sequences`` of each of its families, interleaved; seeds of different splits are disjoint.

    Args:
      split: "train", "validation" or "test".
      sequences: per family.
      frames: per sequence.
      spp: samples per pixel of the references.
      native: also frames at the references' size.
      families: only these, in the test split also ``scenes.EXTRA_FAMILIES``; None: all families of the split.
      start: skip this many seeds of the split.

    Raises:
      ValueError: unknown split or family, or nothing to render.
    """
    usual = families_of(split)
    allowed = usual + (EXTRA_FAMILIES if split == "test" else ())
    chosen = tuple(usual if families is None else families)
    for family in chosen:
        if family not in allowed:
            hint = f" ({family} is in the test split only)" if family in FAMILIES + EXTRA_FAMILIES else ""
            raise ValueError(f"families: {split} has {', '.join(allowed)}; got {family!r}{hint}.")
    clips = [
        Clip(split, family, seed, frames, spp, native)
        for seed in split_seeds(split, sequences, start=start)
        for family in allowed
        if family in chosen
    ]
    if not clips:
        raise ValueError(f"{split}: expected at least one sequence, got {sequences} of the families {chosen}.")
    return clips


def _check_request(out: Path, clips: Sequence[Clip], settings: dict) -> dict[str, list]:
    """Read the splits that are there already; a ValueError where the request contradicts them."""
    if len({clip.name for clip in clips}) != len(clips):
        raise ValueError("generate: two clips have the same split, family and seed.")
    if not (out / "dataset.json").is_file():
        return {}
    dataset = read_dataset(out)
    for key, asked in {**UNSAID, "renderer": RENDERER, **settings}.items():
        found = dataset.source.get(key, UNSAID.get(key))
        if found != asked:
            raise ValueError(
                f"{out}: this dataset was made with {key} = {found!r}, asked for {asked!r}. "
                "Choose another output folder, or delete this one."
            )
    existing = {split: list(segments) for split, segments in dataset.splits.items()}
    for split in {clip.split for clip in clips} & set(existing):
        asked_names = {clip.name for clip in clips if clip.split == split}
        missing = [segment.sequence for segment in existing[split] if segment.sequence not in asked_names]
        if missing:
            raise ValueError(
                f"{out}: the split {split} already holds {', '.join(missing)}, which this request lacks. A split "
                "can grow, not change: ask for the same sequences and more, or choose another output folder."
            )
    return existing


def generate(
    out: str | os.PathLike,
    clips: Iterable[Clip],
    width: int,
    height: int,
    *,
    rendering: Rendering = USUAL,
    progress: Progress = lambda done, total: None,
) -> Dataset:
    """Render clips into a dataset, frame by frame and atomically; running it again resumes.

    Complete frames are kept, and so are splits that the dataset already has; a split may be asked for again with more
    clips.

    Args:
      out: the dataset's folder.
      clips: from ``plan``, of one split or several.
      width: LR width, pixels.
      height: LR height, pixels.
      rendering: all but ``spp`` and ``native``, which the clips have.
      progress: called after each frame.

    Raises:
      ValueError: the folder holds data made with other settings, another command writes into it, or a setting is
        invalid.
      Interrupted: a signal came; the frames so far are there.
    """
    with only_writer(out):
        return _generate(Path(out), list(clips), width, height, rendering, progress)


def _generate(
    out: Path, clips: Sequence[Clip], width: int, height: int, rendering: Rendering, progress: Progress
) -> Dataset:
    shared = {"renderer": RENDERER, "width": width, "height": height}
    shared["mip_bias"] = float(rendering.mip_bias)
    shared |= {key: value for key, value in rendering._asdict().items() if value != UNSAID.get(key, value)}
    scale = scale_of((height, width), output_size(rendering.scale, (height, width)))
    shared["scale"] = list(scale) if isinstance(scale, tuple) else scale  # as JSON has it
    splits: dict[str, list] = _check_request(out, clips, shared)
    done, total = 0, sum(clip.frames for clip in clips)
    so_far = lambda: f"{done + 1} of {total} frames are there. Run the same command again to resume."
    for clip in clips:
        scene = make_scene(clip.family, clip.seed, clip.frames)
        writer = SequenceWriter(out, clip.name, source={**shared, **clip._asdict()})
        for index in range(clip.frames):
            if index not in writer:
                frame = render_frame(scene, index, width, height, rendering=clip.rendered(rendering))
                with finishing(so_far):
                    writer.write(index, frame)
            done += 1
            progress(done, total)
        writer.finish()
    for split in {clip.split: None for clip in clips}:
        splits[split] = [clip.name for clip in clips if clip.split == split]
    return write_dataset(out, splits, source=shared)


def live_source(
    clips: Iterable[Clip],
    width: int,
    height: int,
    *,
    rendering: Rendering = USUAL,
    on_frame: Callable[[int], Any] = lambda index: None,
) -> CachedSource:
    """Make a source for ``data.clips`` that renders each clip when first asked for it, without touching the disk.

    Args:
      clips: from ``plan``.
      width: LR width, pixels.
      height: LR height, pixels.
      rendering: see ``generate``.
      on_frame: called with the index of each finished frame of a clip.
    """

    def render(clip: Clip) -> essjax.frames.Sequence:
        scene = make_scene(clip.family, clip.seed, clip.frames)
        return render_sequence(scene, width, height, rendering=clip.rendered(rendering), on_frame=on_frame)

    return CachedSource(functools.partial(render, clip) for clip in clips)
