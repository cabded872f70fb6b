"""Train steps of ExtraSS: cost against frames and pixels, remat, the gradients of convolutions in a scan, waiting."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from essjax.builtin import generate, plan
from essjax.frames import Frame, Sequence
from essjax.interfaces import Method
from essjax.rollout import alternate, unroll
from essjax.train import create_state, make_train_step, muon
from experiments.benchmark import inputs
from experiments.benchmark.measure import Case, measure, summary
from experiments.benchmark.suites import Options, Row
from experiments.datasets import rendering_of
from experiments.members import Member, resolve, settings_of
from experiments.training import first_batches, initial_state, initial_variables, make_batches, make_steps
from experiments.variants import Stage

FRAMES = (5, 9, 13)
"""Lengths of clips; odd, as SS/ESS pairs need."""
CROPS = (48, 64, 96)
"""Sides of square crops, LR pixels."""
BATCH = 2
WIDTH = 24
"""Width of the networks: the paper preset's."""
LOADED_STEPS = 40
DEFAULT = "a step of the default run:"


def _clip(length: int, width: int, height: int, batch: int = BATCH) -> Sequence:
    """Make a batch of clips ``[T, B, H, W, C]`` of synthetic frames."""
    frames = [inputs.frame(width, height, 100 * n) for n in range(length)]
    stacked: Frame = jax.tree.map(lambda *leaves: np.stack(leaves).repeat(batch, axis=1), *frames)
    reference = np.asarray(stacked.color).repeat(2, axis=-3).repeat(2, axis=-2)
    return Sequence(frames=stacked, reference=reference)


def _extrass(*overrides: str) -> Member:
    """ExtraSS with the settings of the default run, and others."""
    return resolve({"extrass": settings_of("extrass", "quick", overrides)}, "quick", Path())["extrass"]


def _wide() -> Stage:
    return _extrass(f"method.width={WIDTH}", f"method.frnet_width={WIDTH}").stages[-1]


def _step_case(length: int, side: int) -> Case:
    """Make a case of the whole train step: both rollouts, all losses, gradient, Adam."""
    return _case(f"train step, {length} frames of {side}x{side}, batch {BATCH}", _wide(), _clip(length, side, side))


def _default_case(stage: Stage) -> Case:
    """Make the same of a stage of the default run, at its shapes."""
    settings = stage.settings
    return _case(f"{DEFAULT} {stage.name}", stage, _clip(settings.clip, *settings.crop, settings.batch))


def _case(name: str, stage: Stage, clip: Sequence) -> Case:
    length, batch, height, width = clip.frames.motion.shape[:4]
    variables = stage.method.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], clip.frames))
    transform = muon()
    step = make_train_step(next(iter(stage.tasks.values())).objective, transform, stage.name)
    # The state is donated inside; here it is an ordinary argument, so that a repetition starts where the last did.
    return Case(
        name,
        lambda state, clip: step.__wrapped__(state, clip, 1e-4),
        (create_state(variables, stage.name, transform), clip),
        work={"frames": length * batch, "pixels": length * batch * height * width},
    )


def _unrolled_case(method: Method, *, remat: bool, gradient: bool) -> Case:
    """``unroll`` alone over 8 frames; with its gradient, or forward only."""
    clip = _clip(8, 64, 64)
    variables = method.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], clip.frames))

    def loss(variables, frames):
        return jnp.mean(jnp.log1p(unroll(method, variables, frames, alternate(), train=True, remat=remat).image) ** 2)

    kind = "gradient" if gradient else "forward"
    name = f"{kind} of 8 unrolled frames of 64x64, batch {BATCH}" + (", remat" if remat else "")
    return Case(name, jax.grad(loss) if gradient else loss, (variables, clip.frames), work={"frames": 8 * BATCH})


def rows(options: Options) -> Iterator[Row]:
    """Time steps of the default run, of three lengths and sizes, unrolled gradients, training that reads its clips."""
    repetitions = options.repetitions
    for stage in _extrass().stages:
        yield measure(_default_case(stage), repetitions)
    for length, side in sorted({(length, CROPS[1]) for length in FRAMES} | {(FRAMES[1], side) for side in CROPS}):
        yield measure(_step_case(length, side), repetitions)
    method = _wide().method
    for remat, gradient in ((False, False), (False, True), (True, True)):
        yield measure(_unrolled_case(method, remat=remat, gradient=gradient), repetitions)
    yield _loaded()
    yield _loaded("data.fresh=20", "data.train_spp=1", "data.train_sequences=1")


def _loaded(*overrides: str) -> Row:
    """Time training on clips from disk, or fresh ones, and the share in which the step waits for its batch."""
    member = _extrass(*overrides)
    settings, stage = member.settings, member.stages[-1]
    data, training = settings.data, stage.settings
    with tempfile.TemporaryDirectory() as folder:
        clips = plan("train", 1, data.train_frames, spp=1, families=["carousel"])
        dataset = generate(Path(folder), clips, *data.size, rendering=rendering_of(settings, ranges=False))
        steps = make_steps(stage, settings)
        variables = initial_variables(member, dataset)
        state = initial_state(member, stage, variables, first_batches(dataset, settings, stage))
        batches, waited, seconds = make_batches(dataset, settings, stage), [], []
        for n in range(LOADED_STEPS + 2):
            start = time.perf_counter()
            task, batch = next(batches)
            ready = time.perf_counter()
            state, terms = steps[task](state, batch, 1e-4)
            jax.device_get(terms)
            if n >= 2:
                waited.append(ready - start)
                seconds.append(time.perf_counter() - start)
    origin = "read from disk" if data.fresh is None else f"new scenes every {data.fresh} steps, rendered meanwhile"
    name = (
        f"training, {training.clip} frames of {training.crop[0]}x{training.crop[1]}, batch {training.batch}, {origin}"
    )
    row = {"name": name, "implementation": "essjax", **summary(np.array(seconds))}
    return {**row, "waiting_fraction": sum(waited) / sum(seconds), "work": {"frames": training.clip * training.batch}}


def _fit(sizes: list[float], milliseconds: list[float]) -> tuple[float, float]:
    """Least squares ``milliseconds = a + b sizes``: the share of a in the largest, and R²."""
    slope, intercept = np.polyfit(sizes, milliseconds, 1)
    residual = np.array(milliseconds) - (intercept + slope * np.array(sizes))
    return intercept / max(milliseconds), 1.0 - residual.var() / np.var(milliseconds)


def facts(rows: list[Row]) -> dict[str, float]:
    """Speed of the default run, fits in frames and pixels, rates of products, cost of remat, waiting for data."""
    default = {row["name"].removeprefix(DEFAULT): row for row in rows if row["name"].startswith(DEFAULT)}
    steps = {row["name"]: row for row in rows if row["name"].startswith("train step")}
    name = "train step, {} frames of {}x{}, batch " + str(BATCH)
    by_frames = [steps[name.format(length, CROPS[1], CROPS[1])]["median_ms"] for length in FRAMES]
    by_pixels = [steps[name.format(FRAMES[1], side, side)]["median_ms"] for side in CROPS]
    frames_intercept, frames_r2 = _fit(list(FRAMES), by_frames)
    pixels_intercept, pixels_r2 = _fit([side**2 for side in CROPS], by_pixels)
    rates = {row["name"]: row["flops"] / row["median_ms"] / 1e6 for row in rows if "flops" in row}
    forward, gradient, remat = [row for row in rows if "unrolled frames" in row["name"]]
    return {
        **{f"steps per second of the default run:{stage}": 1e3 / row["median_ms"] for stage, row in default.items()},
        **{f"seconds to compile that step:{stage}": row["compile_seconds"] for stage, row in default.items()},
        "fit in frames: R²": frames_r2,
        "fit in frames: constant part of the longest": frames_intercept,
        "fit in pixels: R²": pixels_r2,
        "fit in pixels: constant part of the largest": pixels_intercept,
        "GFLOP/s of the step with the largest crop": rates[name.format(FRAMES[1], CROPS[-1], CROPS[-1])],
        "rate of products in the gradient over that of the forward pass": rates[gradient["name"]]
        / rates[forward["name"]],
        "time with remat over without": remat["median_ms"] / gradient["median_ms"],
        "temporary memory with remat over without": remat["temporary_megabytes"] / gradient["temporary_megabytes"],
        **{
            f"share that waits for data: {row['name']}": row["waiting_fraction"]
            for row in rows
            if "waiting_fraction" in row
        },
    }
