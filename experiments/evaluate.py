"""Run methods over the test frames in every phase, and score every frame as SS and as ESS at each distance (SPEC 0)."""

import collections.abc
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from essjax.cameras import pixel_positions
from essjax.color import display, expose
from essjax.data import Dataset, Segment, read_segment
from essjax.data.memory import Kept
from essjax.exposure import clip_exposure
from essjax.frames import Frame, Sequence, background, frame_size, rendered_color
from essjax.interfaces import Method, expand_flag
from essjax.metrics import aggregate, distances, has_source, mean_over, psnr, score_rollout
from essjax.rollout import ESS, SS, Schedule, alternate, every, stream
from essjax.sizes import ratios
from essjax.typing import Array, PyTree
from essjax.warp import hole_mask, jittered_motion, nearest_upsample, sample, upsample_motion

EXTRA_METRICS = ("psnr_foreground", "psnr_reference")
"""Columns beside ``METRICS``: without the background (for LR results), and LR against the reference at the sample
positions, foreground only, so that denoising is not mistaken for guidance."""


@dataclasses.dataclass
class Clip:
    """One test sequence, ready to be scored; leaves ``[T, ...]``, no batch axis.

    Attributes:
      name: of the sequence.
      sequence: its frames and references.
      numbers: original frame numbers.
      scored: indices that count.
      holes: ``[T, H, W, 1]`` LR, 1 where the previous position is off screen or showed another surface.
      exact_holes: whether they come from the renderer.
    """

    name: str
    sequence: Sequence
    numbers: tuple[int, ...]
    scored: list[int]
    holes: np.ndarray
    exact_holes: bool

    @functools.cached_property
    def exposure(self) -> np.ndarray:
        """See ``shown_exposure``."""
        return shown_exposure(self.sequence)


def shown_exposure(sequence: Sequence) -> np.ndarray:
    """Return what metrics and pictures multiply radiance with ``[T]``: the recorded exposure or ``clip_exposure``."""
    recorded, reference = sequence.frames.exposure, sequence.reference
    return np.asarray(np.full(len(reference), clip_exposure(reference)) if recorded is None else recorded, np.float32)


def scored_frames(cuts: Iterable[Any], counts: Iterable[Any], warmup: int) -> list[int]:
    """List the indices of the frames that are scored.

    Args:
      cuts: of each frame, whether it is one; the first always is.
      counts: of each frame, whether it may be scored (``Dataset.scored``).
      warmup: frames that are not, from a cut on.
    """
    since_cut, scored = 0, []
    for n, (cut, counted) in enumerate(zip(cuts, counts, strict=True)):
        since_cut = 0 if cut or n == 0 else since_cut + 1
        if counted and since_cut >= warmup:
            scored.append(n)
    return scored


def load_clip(dataset: Dataset, segment: Segment, warmup: int, *, native: bool = True, ranges: bool = False) -> Clip:
    """Read a test segment; the first ``warmup`` frames and as many after each cut are not scored."""
    sequence = read_segment(dataset, segment, native=native, ranges=ranges)
    scored = scored_frames(np.asarray(sequence.frames.cut), dataset.scored(segment), warmup)
    holes = 1.0 - np.asarray(estimated_valid(sequence.frames) if sequence.valid is None else sequence.valid)
    return Clip(segment.sequence, sequence, dataset.numbers(segment), scored, holes, sequence.valid is not None)


class Clips(collections.abc.Sequence[Clip]):
    """The clips of a split, a sequence of ``Clip``: each is read when asked for, and kept if there is memory for it."""

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        warmup: int,
        *,
        native: bool = True,
        ranges: bool = False,
        memory: int | None = None,
    ):
        """Nothing is read yet.

        Args:
          dataset: from ``read_dataset``.
          split: its name.
          warmup: see ``load_clip``.
          native: read native frames too, where there are any.
          ranges: read sample ranges too, where there are any.
          memory: bytes of all clips that are kept; None: half of what is free.
        """
        self._segments, self._kept, self._outlines = dataset.segments(split), Kept(memory), {}
        self._load = functools.partial(load_clip, dataset, warmup=warmup, native=native, ranges=ranges)

    def __len__(self) -> int:
        return len(self._segments)

    def __getitem__(self, index: int) -> Clip:
        segment = self._segments[index]
        clip = Clip(**self._kept.get(index, lambda: vars(self._load(segment))))
        if index not in self._outlines:
            first = jax.tree.map(lambda leaf: np.array(leaf[:1]), clip.sequence)
            self._outlines[index] = dataclasses.replace(clip, sequence=first)
        return clip

    def outline(self, index: int) -> Clip:
        """Clip ``index`` with the images of its first frame alone; stays in memory."""
        if index not in self._outlines:
            _ = self[index]
        return self._outlines[index]


@jax.jit
def estimated_valid(frames: Frame) -> Array:
    """``hole_mask`` of each frame against the one before, ``[T, H, W, 1]``; of the first against itself."""
    previous = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf[:-1]]), frames)
    valid = hole_mask(
        frames.gbuffers, previous.gbuffers, frames.motion, jitter=frames.jitter, jitter_previous=previous.jitter
    )
    return jnp.where(expand_flag(frames.cut, valid.ndim), 0.0, valid)  # as the renderer says it


class Runner:
    """Steps a method frame by frame, as a stream does: one compilation per kind of frame and frame size."""

    def __init__(self, method: Method, variables: PyTree, compiler_options: dict | None = None):
        self.method, self.variables, self._options = method, variables, compiler_options

    def __call__(self, sequence: Sequence, schedule: Schedule) -> np.ndarray:
        """Images ``[T, h, w, 3]`` of one sequence; image n is frame n's whatever the latency."""
        frames = sequence.native if self.method.info.native else sequence.frames
        if frames is None:
            raise ValueError(f"{self.method.info.name} needs frames at native resolution, which this dataset lacks.")
        kinds = schedule.kinds(frames.motion.shape[0])
        streamed = stream(self.method, self.variables, batches(frames), kinds, compiler_options=self._options)
        images, late = [np.asarray(image[0]) for image in streamed], self.method.info.latency
        return np.stack(images[late:] + images[-1:] * late)


def batches(frames: Frame) -> Iterator[Frame]:
    """Each of time-major frames without a batch axis, as a batch of one."""
    return (jax.tree.map(lambda leaf, n=n: leaf[n, None], frames) for n in range(frames.motion.shape[0]))


def schedules(method: Method, rate: int = 2) -> list[Schedule]:
    """How a method is run, one frame in ``rate`` rendered: in every phase, or every frame if it cannot extrapolate."""
    return [every()] if method.info.renders_all else [alternate(phase, period=rate) for phase in range(rate)]


def runs_at(method: Method, rate: int, first: int) -> bool:
    """Whether ``method`` is run at this rate: one that gets every frame once, at the ``first``; one that lags at 2."""
    return rate == first if method.info.renders_all else rate == 2 or not method.info.latency


@jax.jit
def reference_at_samples(reference: Array, frames: Frame) -> Array:
    """Read the reference where each LR sample was taken, ``[T, H, W, 3]``."""
    size = frame_size(frames)
    positions = jnp.asarray(ratios(size, reference.shape[-3:-1]), jnp.float32) * pixel_positions(*size, frames.jitter)
    return jnp.maximum(sample(reference, positions, mode="bilinear"), 0.0)


@jax.jit
def _masked_psnr(images: Array, targets: Array, exposure: Array, mask: Array) -> Array:
    return psnr(display(expose(images, exposure)), display(expose(targets, exposure)), mask=mask)


def score_clip(
    method: Method, clip: Clip, images: np.ndarray, kinds: tuple[str, ...], rate: int = 2
) -> list[dict[str, Any]]:
    """One row per scored frame of a kind that the method predicts; without those that it cannot show."""
    frames, size = clip.sequence.frames, clip.sequence.size
    low = images.shape[1:3] == frames.motion.shape[1:3] and not method.info.native
    foreground = ~np.asarray(background(frames.gbuffers))
    if low:
        previous = np.concatenate([frames.jitter[:1], frames.jitter[:-1]])
        targets, holes = np.asarray(frames.color), clip.holes
        motion = jittered_motion(frames.motion, frames.jitter, previous)
    else:
        targets = np.asarray(clip.sequence.reference)
        holes, foreground = (np.asarray(nearest_upsample(m, size)) for m in (clip.holes, foreground))
        motion = upsample_motion(frames.motion, size, jitter=frames.jitter)
    # All frames, so that every sequence has the same shape and compiles once; the warm-up is dropped below.
    everything = list(range(len(kinds)))
    rows = score_rollout(
        images,
        targets,
        scored=everything,
        kinds=kinds,
        period=rate,
        exposure=clip.exposure,
        holes=holes,
        motion=motion,
        cuts=np.asarray(frames.cut),
    )
    extra = {"psnr_foreground": _masked_psnr(images, targets, clip.exposure, foreground)}
    if low:
        at_samples = reference_at_samples(clip.sequence.reference, frames)
        extra["psnr_reference"] = _masked_psnr(images, at_samples, clip.exposure, foreground)
    extra = {name: np.asarray(values) for name, values in extra.items()}
    ages = distances(kinds)
    return [
        {
            "frame": clip.numbers[n],
            "resolution": "lr" if low else "hr",
            "rate": rate,
            "distance": int(ages[n]),
            **rows[n],
            **{name: float(values[n]) if np.isfinite(values[n]) else None for name, values in extra.items()},
        }
        for n in clip.scored
        if kinds[n] in method.info.predicts and has_image(clip, n, method, kinds)
    ]


def has_image(clip: Clip, n: int, method: Method, kinds: collections.abc.Sequence[str]) -> bool:
    """Whether ``method`` shows frame ``n``: something was rendered in its shot, also later if it lags."""
    cuts, late = np.asarray(clip.sequence.frames.cut), method.info.latency
    following = cuts[n + 1 : n + 1 + late]
    return bool(has_source(kinds, cuts)[n]) and len(following) == late and not following.any()


def picture_frames(clip: Clip, count: int) -> list[int]:
    """Choose the frames to show: those with the most holes among the scored ones."""
    shares = clip.holes.mean(axis=(1, 2, 3))
    return sorted(clip.scored, key=lambda n: -shares[n])[:count]


def evaluate(
    runners: Mapping[str, Runner],
    clips: collections.abc.Sequence[Clip],
    *,
    rates: tuple[int, ...] = (2,),
    pictures: int = 1,
    on_step: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Run and score every method on every clip.

    Args:
      runners: method name -> runner, in the order of the table.
      clips: the test sequences; one is in use at a time.
      rates: one frame in so many is rendered; rows, curves and pictures are of the first.
      pictures: chosen frames per sequence.
      on_step: called before each (method, sequence).

    Returns:
      ``rows`` (per sequence and their mean, as metrics.json wants them), ``rates`` (means per rate and distance to the
      rendered frame, with the same labels and ``rate`` and ``distance``), ``curves`` and ``pictures`` (as the report
      wants them).
    """
    every_rate: dict[str, dict[str, list]] = {name: {} for name in runners}
    shown: dict[tuple, dict] = {}

    def run_method(name: str, clip: Clip) -> None:
        runner = runners[name]
        on_step(f"{name} on {clip.name}")
        every_rate[name][clip.name] = []
        for rate in rates:
            for schedule in schedules(runner.method, rate) if runs_at(runner.method, rate, rates[0]) else ():
                kinds = schedule.kinds(len(clip.numbers))
                ages, images = distances(kinds), runner(clip.sequence, schedule)
                every_rate[name][clip.name] += score_clip(runner.method, clip, images, kinds, rate)
                for n in picture_frames(clip, pictures) if rate == rates[0] else ():
                    with lock:
                        if has_image(clip, n, runner.method, kinds) and ages[n] in (0, rate - 1):
                            _collect_picture(shown, clip, n, name, runner.method, images, kinds, rate)

    lock = threading.Lock()
    with ThreadPoolExecutor(2) as pool:  # most of the time is compilation, which two threads do side by side
        for index in range(len(clips)):  # not over the clips themselves: one would be held while the next is read
            list(pool.map(functools.partial(run_method, clip=clips[index]), runners))
    curves = {
        name: {clip: [row for row in rows if row["rate"] == rates[0]] for clip, rows in clips.items()}
        for name, clips in every_rate.items()
    }
    return {
        "rows": _summarise(curves),
        "rates": _by_distance(every_rate),
        "curves": curves,
        "pictures": [_sorted_images(p, runners) for p in _ordered(shown)],
    }


def _sorted_images(picture: dict, names: Iterable[str]) -> dict:
    """Put the images into the table's order, whichever thread came first."""
    order = ["input", *names, "reference"]
    parts = {
        part: {name: picture[part][name] for name in order if name in picture[part]} for part in ("images", "previous")
    }
    return {**picture, **parts}


def _collect_picture(
    shown, clip: Clip, n: int, name: str, method: Method, images: np.ndarray, kinds, rate: int
) -> None:
    """Add a method's image of frame n to the pictures where it belongs (taau's and taa's to SS and ESS alike)."""
    low = images.shape[1:3] == clip.sequence.frames.motion.shape[1:3] and not method.info.native
    resolution = "lr" if low else "hr"
    for kind in (SS, ESS) if method.info.renders_all else (kinds[n],):
        if kind not in method.info.predicts and not method.info.renders_all:
            continue
        key = (clip.name, n, kind, resolution)
        if key not in shown:
            shown[key] = _new_picture(clip, n, kind, low, rate)
        # Copies: views would keep all frames of all clips in memory.
        shown[key]["images"][name] = images[n].copy()
        if shown[key]["previous"]:
            shown[key]["previous"][name] = images[n - rate].copy()


def _new_picture(clip: Clip, n: int, kind: str, low: bool, rate: int) -> dict[str, Any]:
    frames = clip.sequence.frames
    size = frame_size(frames) if low else clip.sequence.size
    rendered = rendered_color(frames, "the report")
    target = rendered if low else clip.sequence.reference
    # What was rendered last: this frame, or one before where this one is extrapolated, the farthest that there is.
    rendered_last = n if kind == SS else n - rate + 1
    frames_of_part = {"images": (n, rendered_last), "previous": (n - rate, rendered_last - rate)}
    picture: dict[str, Any] = {
        "sequence": clip.name, "frame": clip.numbers[n], "kind": kind, "resolution": "lr" if low else "hr",
        "exposure": float(clip.exposure[n]),
    }  # fmt: skip
    starts = np.flatnonzero(np.asarray(clip.sequence.frames.cut)[: n + 1])
    if rendered_last - rate < starts.max(initial=0):  # of another shot, or made of nothing
        picture["previous"] = {}
        del frames_of_part["previous"]
    for part, (frame, index) in frames_of_part.items():
        color = np.asarray(nearest_upsample(np.asarray(rendered[max(index, 0)]), size))
        picture[part] = {"input": color, "reference": np.array(target[max(frame, 0)])}
    return picture


def _ordered(shown: Mapping[tuple, dict]) -> list[dict]:
    """ESS at HR first, then SS, then LR; the report drops from the end what does not fit."""
    order = {("hr", ESS): 0, ("hr", SS): 1, ("lr", ESS): 2, ("lr", SS): 3}
    return sorted(shown.values(), key=lambda p: order[p["resolution"], p["kind"]])


def _summarise(curves: Mapping[str, Mapping[str, list]]) -> list[dict[str, Any]]:
    """Means over frames per sequence, and over sequences ("mean"); none where frames are not finite."""
    rows = []
    for method, sequences in curves.items():
        for kind in (SS, ESS):
            per_sequence = []
            for sequence, entries in sequences.items():
                chosen = [entry for entry in entries if entry["kind"] == kind]
                if chosen:
                    per_sequence.append(_row(method, sequence, kind, chosen))
            rows += per_sequence
            if per_sequence:
                rows.append(_row(method, "mean", kind, per_sequence))
    return rows


def _by_distance(curves: Mapping[str, Mapping[str, list]]) -> list[dict[str, Any]]:
    """Means over frames, then over sequences, for each rate and distance to the rendered frame."""
    rows = []
    for method, sequences in curves.items():
        found = {(entry["rate"], entry["distance"]) for entries in sequences.values() for entry in entries}
        for rate, distance in sorted(found):
            place, per_sequence = {"rate": rate, "distance": distance}, []
            for sequence, entries in sequences.items():
                chosen = [entry for entry in entries if (entry["rate"], entry["distance"]) == (rate, distance)]
                if chosen:
                    per_sequence.append(_row(method, sequence, chosen[0]["kind"], chosen))
            rows.append({**_row(method, "mean", ESS if distance else SS, per_sequence), **place})
    return rows


def _row(method: str, sequence: str, kind: str, entries: list[dict]) -> dict[str, Any]:
    extra = {name: mean_over(entries, name) for name in EXTRA_METRICS}
    labels = {"method": method, "sequence": sequence, "frames": kind, "resolution": entries[0]["resolution"]}
    return {**labels, **aggregate(entries), **extra}
