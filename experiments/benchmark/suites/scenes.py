"""The built-in renderer: samples per second of references, frames per second of what training reads."""

from collections.abc import Iterator

import jax

from essjax.scenes import Rendering, make_scene, render_frame
from essjax.scenes.render import render_reference
from experiments.benchmark.measure import Compilations, summary, time_calls
from experiments.benchmark.suites import Options, Row

FAMILIES = ("carousel", "texture")
SAMPLES = 64


def rows(options: Options) -> Iterator[Row]:
    """Time references at a quarter of the size of frames, 64 samples per pixel; and frames with all buffers."""
    width, height = max(options.width // 4, 32), max(options.height // 4, 24)
    for family in FAMILIES:
        scene = make_scene(family, 0, 2)
        world = scene.at(1)
        samples = float(width * height * SAMPLES)
        yield _row(
            f"reference of {family}, {width}x{height}, {SAMPLES} samples per pixel",
            lambda world=world: render_reference(world, width, height, spp=SAMPLES), options, {"samples": samples},
        )  # fmt: skip
        yield _row(
            f"frame and buffers of {family}, {width}x{height}, no reference",
            lambda scene=scene: render_frame(scene, 1, width, height, rendering=Rendering(spp=1)),
            options, {"pixels": width * height},
        )  # fmt: skip


def _row(name: str, call, options: Options, work: dict[str, float]) -> Row:
    """Time rendering from outside, as its users see it: it calls many jitted pieces from Python threads."""
    with Compilations() as building:
        call()
    seconds = time_calls(lambda: jax.block_until_ready(call()), options.repetitions, warm_up=1)
    compiled = {"compile_seconds": building.seconds, "compilations": building.count}
    return {"name": name, "implementation": "essjax", **summary(seconds), **compiled, "work": work}
