"""Streaming: whole methods frame by frame, as a viewer of a game gets them. History stays on the device."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from essjax import methods
from essjax.deploy import count_parameters
from essjax.frames import Frame, without_color
from essjax.interfaces import Method
from essjax.rollout import ESS, SS, alternate, bake, every, stream, stream_step, unroll
from experiments.benchmark import inputs
from experiments.benchmark.measure import Compilations, device_time, summary
from experiments.benchmark.suites import Options, Row

DISTINCT = 8
"""Different frames that are streamed in turn."""
COMPARED = 6
"""Frames on which streaming is compared with the unrolled method."""
BINS = 20
RESIDENT = "essjax, frames on the device"


def streamed_methods() -> dict[str, Method]:
    """Make the parts of ExtraSS as its paper's Table 4 times them, other methods' whole steps, and TAAU."""
    return {
        "extrass-w": methods.extrass_w(),
        "extrass-e": methods.extrass_e(),
        "extrass": methods.extrass(),
        "extranet": methods.extranet(),
        "fasset": methods.fasset(),
        "dlctus": methods.dlctus(),
        "taau": methods.taau(),
    }


def latencies(method: Method, dtype: str, frames: list, count: int, *, resident: bool = False) -> dict[str, np.ndarray]:
    """Seconds of each frame by kind, frame into the device and image out of it included; everything else is refused.

    Args:
      method: weights built in (``bake``); says whether every frame is rendered.
      dtype: of the networks.
      frames: on the host, rendered in turn.
      count: frames to stream.
      resident: frames are on the device already, and images stay there, as in a renderer on the same GPU.
    """
    kinds = (every() if method.info.renders_all else alternate()).kinds(count)
    seconds: dict[str, list[float]] = {kind: [] for kind in dict.fromkeys(kinds)}
    given = jax.block_until_ready(jax.device_put(frames)) if resident else frames
    fed = itertools.cycle(given) if resident else map(jax.device_put, itertools.cycle(given))
    images = stream(method, {}, fed, kinds, dtype=dtype)
    for kind in kinds:
        start = time.perf_counter()
        with jax.transfer_guard("disallow"):
            image = next(images).block_until_ready()
        if not resident:
            jax.device_get(image)
        seconds[kind].append(time.perf_counter() - start)
    return {kind: np.array(values) for kind, values in seconds.items()}


def busy(method: Method, step: Callable, frame: Frame) -> dict[str, float]:
    """``device_ms`` of one kind of frame, see ``measure.device_time``."""
    state = [method.start(frame)]

    def call():
        state[0], image = step({}, state[0], frame)
        return image

    call()
    return device_time(call)


def largest_difference(method: Method, frames: list) -> float:
    """Between streamed and unrolled images of the first frames, relative to the images' mean."""
    schedule, frames = every() if method.info.renders_all else alternate(), frames[:COMPARED]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *frames)
    unrolled = jax.jit(lambda frames: unroll(method, {}, frames, schedule).image)(stacked)
    images = stream(method, {}, map(jax.device_put, frames), schedule.kinds(len(frames)))
    worst = max(float(np.abs(image - expected).max()) for image, expected in zip(images, unrolled, strict=True))
    return worst / float(np.abs(unrolled).mean())


def rows(options: Options) -> Iterator[Row]:
    """Yield a row per method, kind of frame and compute type: latencies of ``options.frames`` frames."""
    frames = inputs.frames(DISTINCT, options.width, options.height)
    for name, method in streamed_methods().items():
        if not options.wanted(name):
            continue
        variables = jax.jit(method.init)(jax.random.key(0), frames[0])
        for dtype in options.dtypes if count_parameters(variables) else ("float32",):
            yield from method_rows(name, bake(method, variables), frames, dtype, options)


def method_rows(name: str, method: Method, frames: list, dtype: str, options: Options) -> Iterator[Row]:
    """Yield a row per kind of frame of a method with its weights built in."""
    kinds = (SS,) if method.info.renders_all else (SS, ESS)
    building, images = {}, stream(method, {}, map(jax.device_put, frames), kinds, dtype=dtype)
    jax.jit(method.start)(jax.device_put(frames[0]))
    for kind in kinds:
        with Compilations() as building[kind]:
            next(images).block_until_ready()
    difference = largest_difference(method, frames) if dtype == "float32" else None
    for resident in (True, False) if jax.default_backend() == "gpu" else (False,):
        with Compilations() as streaming:
            seconds = latencies(method, dtype, frames, options.frames, resident=resident)
        if streaming.count:
            raise RuntimeError(f"{name}: compiled {streaming.count} times while streaming.")
        for kind in kinds:
            if kind not in method.info.predicts:
                continue
            row: dict[str, Any] = {"name": f"{name} {kind.upper()}, {options.width}x{options.height}"}
            row |= {"implementation": RESIDENT if resident else "essjax", "dtype": dtype, **summary(seconds[kind])}
            row |= {"compile_seconds": building[kind].seconds, "compilations": building[kind].count}
            row |= {"latency": latency(seconds[kind]), "work": {"frames": 1.0}}
            if difference is not None:
                row["difference_from_unrolled"] = difference
            if resident:
                given = jax.device_put(frames[0] if kind == SS else without_color(frames[0]))
                row |= busy(method, stream_step(method, kind, dtype=dtype), given)
            yield row


def latency(seconds: np.ndarray) -> dict[str, Any]:
    """Percentiles and histogram, ms."""
    values = 1e3 * seconds
    counts, edges = np.histogram(values, bins=BINS)
    percentiles = {f"p{p}": float(np.percentile(values, p)) for p in (5, 50, 95, 99)}
    return {**percentiles, "worst": float(values.max()), "counts": counts.tolist(), "edges": edges.tolist()}


def facts(rows: list[Row]) -> dict[str, float]:
    """How much an extrapolated frame costs beside a rendered one of ``extrass``."""
    medians = {
        row["name"].split(",")[0]: row["median_ms"]
        for row in rows
        if row["dtype"] == "float32" and row["implementation"] == "essjax"
    }
    if not {"extrass SS", "extrass ESS"} <= set(medians):
        return {}
    return {"extrass: time of an ESS frame over that of an SS frame": medians["extrass ESS"] / medians["extrass SS"]}
