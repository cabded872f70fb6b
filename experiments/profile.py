"""``--profile``: a JAX profiler trace of the train step and of the streaming steps."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console

from essjax.builtin import generate, plan
from essjax.frames import select_time
from essjax.rollout import ESS, SS, stream
from experiments.datasets import rendering_of
from experiments.members import resolve, settings_of
from experiments.settings import with_data
from experiments.trace import describe, operations
from experiments.training import first_batches, initial_state, initial_variables, make_steps


def write_profile(
    name: str, preset: str, overrides: Sequence[str], out: Path, console: Console, *, repetitions: int = 5
) -> int:
    """Trace ``repetitions`` train steps of the last stage and as many SS/ESS pairs; compilation is not in the trace."""
    settings = with_data(settings_of(name, preset, overrides), fresh=None)
    member, folder = resolve({name: settings}, preset, out)[name], out / "profile"
    stages, method = member.stages, member.method
    clips = plan("train", 1, max([3, *(stage.settings.clip for stage in stages)]), spp=1, families=["carousel"])
    dataset = generate(
        out / "profile-scenes", clips, *settings.data.size, rendering=rendering_of(settings, ranges=False)
    )
    if stages:
        stage = stages[-1]
        variables = initial_variables(member, dataset)
        batches = first_batches(dataset, settings, stage)
        task = next(iter(batches))
        step, batch = make_steps(stage, settings)[task], batches[task]
        state = initial_state(member, stage, variables, batches)
        state, _ = step(state, batch, stage.settings.learning_rate)
        method, frames = stage.method, jax.tree.map(lambda leaf: leaf[:, :1], batch.frames)
        variables = state.variables
    else:
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
                    state, terms = step(state, batch, stage.settings.learning_rate)
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
