"""Streaming by ratio: the same output from inputs of several sizes."""

from collections.abc import Iterator

import jax

from essjax import methods
from essjax.rollout import bake
from experiments.benchmark import inputs
from experiments.benchmark.suites import Options, Row
from experiments.benchmark.suites.pipeline import DISTINCT, method_rows

RATIOS = (1.5, 2, 3, 4)
METHODS = {"extrass": methods.extrass, "taau-half": methods.taau_half}


def rows(options: Options) -> Iterator[Row]:
    """Yield a row per ratio, method and kind of frame; the output is twice ``options.width`` x ``options.height``."""
    output = 2 * options.width, 2 * options.height
    for ratio in RATIOS:
        width, height = (round(side / ratio) for side in output)
        frames = inputs.frames(DISTINCT, width, height)
        for name, factory in METHODS.items():
            title = f"{name} x{ratio:g}"
            if options.wanted(title):
                method = factory(scale=output)
                made = bake(method, jax.jit(method.init)(jax.random.key(0), frames[0]))
                given = options._replace(width=width, height=height)
                yield from method_rows(title, made, frames, "float32", given)
