"""``--profile``: a JAX profiler trace of the train step and of the streaming steps."""

import dataclasses
import itertools
from pathlib import Path

import jax
from rich.console import Console

from essjax.builtin import generate, plan
from essjax.frames import select_time
from essjax.rollout import ESS, SS, stream
from essjax.train import OPTIMIZERS, create_state, make_train_step
from experiments.config import Config
from experiments.trace import describe, operations
from experiments.training import initial_variables, make_batches
from experiments.variants import get_variant, stages_of


def write_profile(name: str, config: Config, out: Path, console: Console, *, repetitions: int = 5) -> int:
    """Trace ``repetitions`` train steps of the last stage and as many SS/ESS pairs; compilation is not in the trace."""
    variant = get_variant(name)
    clips = plan("train", 1, max(config.clip, 3), spp=1, families=["carousel"])
    dataset = generate(out / "profile-scenes", clips, *config.size, scale=config.scale)
    folder = out / "profile"
    stages = stages_of(name, config)
    if stages:
        stage = stages[-1]
        variables = initial_variables(stages, dataset, config)
        transform = OPTIMIZERS[config.optimizer]()
        step = make_train_step(stage.objective, transform, stage.name)
        state, batch = (
            create_state(variables, stage.name, transform),
            next(make_batches(dataset, dataclasses.replace(config, fresh=None), stage)),
        )
        state, _ = step(state, batch, stage.learning_rate)
        method, frames = stage.method, jax.tree.map(lambda leaf: leaf[:, :1], batch.frames)
        variables = state.variables
    else:
        method = variant.method(config)
        from essjax.data import disk_source

        frames = jax.tree.map(lambda leaf: leaf[:, None], disk_source(dataset, "train")[0].frames)
        variables = method.init(jax.random.key(0), select_time(frames, 0))
    kinds = (SS,) if method.info.renders_all else (SS, ESS)
    given = itertools.cycle(select_time(frames, n) for n in range(len(kinds)))
    images = stream(method, variables, given, itertools.cycle(kinds))
    for _ in kinds:
        next(images).block_until_ready()
    with jax.profiler.trace(str(folder)):
        for repetition in range(repetitions):
            for kind in kinds:
                with jax.profiler.StepTraceAnnotation(f"stream {kind}", step_num=repetition):
                    next(images).block_until_ready()
        if stages:
            for repetition in range(repetitions):
                with jax.profiler.StepTraceAnnotation("train", step_num=repetition):
                    state, terms = step(state, batch, stage.learning_rate)
                    jax.block_until_ready(terms)
    for line in describe(operations(folder)):
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    console.print(
        f"trace: {folder}\nOpen it with `pip install xprof && xprof --logdir {folder}`, or load its *.trace.json.gz in "
        "Perfetto.",
        soft_wrap=True,
        markup=False,
    )
    return 0
