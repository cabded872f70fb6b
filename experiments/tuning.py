"""Choose the settings of the TAA family on validation frames: a baseline is only worth beating at its best."""

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import display
from essjax.frames import without_color
from essjax.interfaces import Method
from essjax.metrics import has_source, psnr
from essjax.rollout import SS, check_supported
from essjax.typing import Array
from experiments.config import Config
from experiments.evaluate import Clip, frame_with_batch_axis, schedules
from experiments.variants.base import Variant

ALPHAS = (0.1, 0.2, 0.4, 0.7, 1.0)
SIGMAS = (0.4, 0.5, 0.65, 0.8, 1.0)  # as many: one compilation serves both
CLAMPS = ("ycocg", "none")
"""The first is what everybody uses: another must be better beyond doubt."""
FIRST_SIGMA = 0.65


class Setting(NamedTuple):
    """A TAA setting and its mean PSNR on the validation frames (dB)."""

    clamp: str
    alpha: float
    sigma: float
    psnr: float


def tune(variant: Variant, config: Config, clips: Sequence[Clip]) -> Setting:
    """For each clamp the best alpha, then for it the best sigma; returns the best of all.

    A clamp replaces the first one only if it gains more than the standard error of the gain over the clips: what a few
    clips choose by chance costs more on others than it gained.
    """
    with ThreadPoolExecutor(len(CLAMPS)) as pool:  # each compiles steps of its own, which is most of the time
        (chosen, scores), *others = pool.map(functools.partial(_tune_clamp, variant, config, clips), CLAMPS)
    for other, other_scores in others:
        gain = other_scores - scores
        if gain.mean() > (gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0):
            chosen, scores = other, other_scores
    return chosen


def _tune_clamp(variant: Variant, config: Config, clips: Sequence[Clip], clamp: str) -> tuple[Setting, np.ndarray]:
    method = variant.method(config, clamp=clamp)
    first, _ = _best(method, clamp, [(alpha, FIRST_SIGMA) for alpha in ALPHAS], clips)
    return _best(method, clamp, [(first.alpha, sigma) for sigma in SIGMAS], clips)


def setting_variables(setting: Setting) -> dict[str, Any]:
    """The variables of a TAA method with this setting."""
    return {"alpha": jnp.float32(setting.alpha), "sigma": jnp.float32(setting.sigma)}


def _best(
    method: Method, clamp: str, settings: list[tuple[float, float]], clips: Sequence[Clip]
) -> tuple[Setting, np.ndarray]:
    """The best of ``settings`` (alpha, sigma), and its PSNR on each clip."""
    # By index: a loop over the clips would hold one while the next is read.
    scores = np.array([_score_grid(method, np.array(settings, np.float32), clips[n]) for n in range(len(clips))])
    top = int(np.argmax(np.nan_to_num(scores.mean(axis=0), nan=-np.inf)))  # argmax takes a NaN for the largest
    return Setting(clamp, *settings[top], float(scores[:, top].mean())), scores[:, top]


def _score_grid(method: Method, grid: np.ndarray, clip: Clip) -> np.ndarray:
    """Mean PSNR ``[settings]`` over the scored frames of one clip, both kinds, all settings side by side."""
    variables = {"alpha": jnp.asarray(grid[:, 0]), "sigma": jnp.asarray(grid[:, 1])}
    frames = clip.sequence.native if method.info.native else clip.sequence.frames
    assert frames is not None
    steps = _steps(method)
    totals, count = np.zeros(len(grid)), 0
    for schedule in schedules(method):
        check_supported(method, frames, schedule)
        history = steps["start"](variables, frame_with_batch_axis(frames, 0))
        kinds = schedule.kinds(len(clip.numbers))
        made = has_source(kinds, np.asarray(frames.cut))
        for n, kind in enumerate(kinds):
            frame = frame_with_batch_axis(frames, n)
            history, image = steps[kind](variables, history, frame if kind == SS else without_color(frame))
            if n in clip.scored and made[n]:
                totals += np.asarray(_grid_psnr(image[:, 0], clip.sequence.reference[n], clip.exposure[n]))
                count += 1
    return totals / max(count, 1)


@jax.jit
def _grid_psnr(images: Array, target: Array, exposure: Array) -> Array:
    return jax.vmap(lambda image: psnr(display(exposure * image), display(exposure * target)))(images)


_COMPILED: dict[Method, dict[str, Any]] = {}


def _steps(method: Method) -> dict[str, Any]:
    """Both steps, mapped over settings; compiled once per method."""
    if method not in _COMPILED:

        def mapped(step):
            def run(variables, history, frame):
                history, prediction = step(variables, history, frame)
                return history, prediction.image

            return jax.jit(jax.vmap(run, in_axes=(0, 0, None)))

        _COMPILED[method] = {
            "start": jax.jit(jax.vmap(lambda v, example: method.start(example), in_axes=(0, None))),
            "ss": mapped(method.render_step),
            "ess": mapped(method.extrapolate_step),
        }
    return _COMPILED[method]
