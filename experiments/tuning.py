"""Choose the settings of the TAA family on validation frames: a baseline is only worth beating at its best."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import display
from essjax.interfaces import Method
from essjax.metrics import has_source, psnr
from essjax.rollout import stream
from essjax.typing import Array
from experiments.evaluate import Clip, batches, schedules

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


def tune(make: Callable[[str], Method], clips: Sequence[Clip]) -> Setting:
    """For each clamp (of which ``make`` gives the method) the best alpha, then for it the best sigma; the best of all.

    A clamp replaces the first one only if it gains more than the standard error of the gain over the clips: what a few
    clips choose by chance costs more on others than it gained.
    """
    with ThreadPoolExecutor(len(CLAMPS)) as pool:  # each compiles steps of its own, which is most of the time
        (chosen, scores), *others = pool.map(functools.partial(_tune_clamp, make, clips), CLAMPS)
    for other, other_scores in others:
        gain = other_scores - scores
        if gain.mean() > (gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0):
            chosen, scores = other, other_scores
    return chosen


def _tune_clamp(make: Callable[[str], Method], clips: Sequence[Clip], clamp: str) -> tuple[Setting, np.ndarray]:
    method = make(clamp)
    first, _ = _best(method, clamp, [(alpha, FIRST_SIGMA) for alpha in ALPHAS], clips)
    return _best(method, clamp, [(first.alpha, sigma) for sigma in SIGMAS], clips)


def setting_variables(setting: Setting) -> dict[str, Any]:
    """Make the variables of a TAA method with this setting."""
    return {"alpha": jnp.float32(setting.alpha), "sigma": jnp.float32(setting.sigma)}


def _best(
    method: Method, clamp: str, settings: list[tuple[float, float]], clips: Sequence[Clip]
) -> tuple[Setting, np.ndarray]:
    """Return the best of ``settings`` (alpha, sigma), and its PSNR on each clip."""
    # By index: a loop over the clips would hold one while the next is read.
    scores = np.array([_score_grid(method, np.array(settings, np.float32), clips[n]) for n in range(len(clips))])
    top = int(np.argmax(np.nan_to_num(scores.mean(axis=0), nan=-np.inf)))  # argmax takes a NaN for the largest
    return Setting(clamp, *settings[top], float(scores[:, top].mean())), scores[:, top]


def _score_grid(method: Method, grid: np.ndarray, clip: Clip) -> np.ndarray:
    """Mean PSNR ``[settings]`` over the scored frames of one clip, both kinds, all settings side by side."""
    variables = {"alpha": jnp.asarray(grid[:, 0]), "sigma": jnp.asarray(grid[:, 1])}
    frames = clip.sequence.native if method.info.native else clip.sequence.frames
    assert frames is not None
    totals, count = np.zeros(len(grid)), 0
    for schedule in schedules(method):
        kinds = schedule.kinds(len(clip.numbers))
        made = has_source(kinds, np.asarray(frames.cut))
        for n, image in enumerate(stream(_side_by_side(method, len(grid)), variables, batches(frames), kinds)):
            if n in clip.scored and made[n]:
                totals += np.asarray(_grid_psnr(image[:, 0], clip.sequence.reference[n], clip.exposure[n]))
                count += 1
    return totals / max(count, 1)


@jax.jit
def _grid_psnr(images: Array, target: Array, exposure: Array) -> Array:
    return jax.vmap(lambda image: psnr(display(exposure * image), display(exposure * target)))(images)


@functools.cache  # the same method again, so that it is compiled once
def _side_by_side(method: Method, settings: int) -> Method:
    """Run ``method`` under several settings at once: variables, history and images are ``[settings, ...]``."""

    def start(example):
        return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], settings, axis=0), method.start(example))

    def mapped(step):
        return lambda variables, history, frame, *, train=False: jax.vmap(step, (0, 0, None))(variables, history, frame)

    return method._replace(
        start=start,
        render_step=mapped(method.render_step),
        extrapolate_step=mapped(method.extrapolate_step),
        parts=None,
    )
