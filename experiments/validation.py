"""Validation during training: a few frames of each held-out clip, played frame by frame as evaluation plays them."""

import itertools
from typing import NamedTuple

import jax
import numpy as np

from essjax.color import display, expose
from essjax.data import Dataset, disk_source
from essjax.data.loader import DiskSource
from essjax.frames import Sequence
from essjax.interfaces import Method
from essjax.metrics import psnr
from essjax.rollout import alternate, every
from essjax.typing import Array, PyTree
from experiments.evaluate import Runner, scored_frames, shown_exposure
from experiments.settings import Settings

SPLIT = "validation"
CLIPS = 8
"""At most; of more, some that are equally far apart."""
SCORED = 4
"""Frames of each clip that are scored, after those that warm up: as many rendered as extrapolated ones."""


class Window(NamedTuple):
    """Frames of one clip, ``[T, ...]`` without a batch axis, and the indices of those that are scored."""

    sequence: Sequence
    scored: list[int]


def windows(dataset: Dataset, settings: Settings, *, native: bool) -> list[Window]:
    """Cut out what is played: of up to ``CLIPS`` clips the first frames that are scored, after those that warm up."""
    source, segments = disk_source(dataset, SPLIT, native=native), dataset.segments(SPLIT)
    chosen = sorted(set(np.linspace(0, len(segments) - 1, CLIPS).round().astype(int).tolist()))
    found = [_window(source, index, dataset.scored(segments[index]), settings.evaluation.warmup) for index in chosen]
    return [window for window in found if window.scored]


def _window(source: DiskSource, index: int, counted: np.ndarray, warmup: int) -> Window:
    cuts = source.cuts(index)
    scored = scored_frames(cuts, counted, warmup)
    start = max(scored[0] - warmup, 0) if scored else 0
    length = min(warmup + SCORED, len(cuts) - start)
    return Window(source.window(index, start, length), [n - start for n in scored if n < start + length])


class Scorer:
    """PSNR of a method on the windows, as evaluation has it: after x/(1+x) and sRGB, both kinds, all trained rates."""

    def __init__(self, method: Method, dataset: Dataset, settings: Settings):
        """Nothing is read or compiled before the first score is asked for."""
        self._method, self._dataset, self._settings = method, dataset, settings
        self._windows: list[Window] = []
        self._runner: Runner | None = None

    def __call__(self, variables: PyTree) -> dict[str, float]:
        """Kind of frame -> mean PSNR over its scored frames, dB; of the kinds that the method predicts."""
        info = self._method.info
        if self._runner is None:
            self._windows = windows(self._dataset, self._settings, native=info.native)
            self._runner = Runner(self._method, variables, self._settings.compiler_options)
        self._runner.variables = variables
        rates = self._settings.training.rates
        schedules = [every()] if info.renders_all else [alternate(period=rate) for rate in rates]
        values: dict[str, list[float]] = {}
        for schedule, (sequence, scored) in itertools.product(schedules, self._windows):
            images = self._runner(sequence, schedule)
            low = images.shape[1:3] == sequence.frames.motion.shape[1:3] and not info.native
            targets = sequence.frames.color if low else sequence.reference
            found = np.asarray(_psnr(images, targets, shown_exposure(sequence)))
            kinds = schedule.kinds(len(images))
            shown = len(images) - info.latency
            for n in scored:
                if kinds[n] in info.predicts and n < shown:
                    values.setdefault(kinds[n], []).append(float(found[n]))
        return {kind: float(np.mean(each)) for kind, each in sorted(values.items())}


@jax.jit
def _psnr(images: Array, targets: Array, exposure: Array) -> Array:
    return psnr(display(expose(images, exposure)), display(expose(targets, exposure)))
