"""One timed case: warm-up, repetitions that each wait for their result, what XLA knows of the program."""

import gc
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.monitoring
import numpy as np

from essjax.deploy import multiply_adds
from experiments.trace import device_milliseconds

REPETITIONS = 20
WARM_UP = 2
QUEUED = {"gpu": 10}
"""Backend -> calls per repetition, one after the other before the clock stops. A single short call on a GPU measures
its launch and the wait for it; in a renderer there is always more in the queue."""
_COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"
_LOWERING_EVENTS = ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration")


class Case(NamedTuple):
    """Something to time.

    Attributes:
      name: "what size", the same for all implementations of one thing.
      function: of ``arguments``; jitted here.
      arguments: arrays. They are on the device before the clock starts.
      implementation: what runs it, for the table.
      donate: arguments whose buffers the function may use up; ``following`` must then replace them.
      following: ``(arguments, output) -> arguments`` of the next call.
      work: unit -> how many of it one call does ("pixels", "frames", "samples"), for rates.
      compiler_options: for ``jax.jit``.
    """

    name: str
    function: Callable
    arguments: tuple
    implementation: str = "essjax"
    donate: tuple[int, ...] = ()
    following: Callable[[tuple, Any], tuple] = lambda arguments, output: arguments
    work: dict[str, float] = {}
    compiler_options: dict[str, Any] | None = None


class Compilations:
    """Counts XLA compilations and their seconds (tracing and lowering too) while it is entered."""

    def __enter__(self):
        """Start counting."""
        self.count, self.seconds = 0, 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, *error):
        """Stop counting."""
        jax.monitoring.unregister_event_duration_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_: str | int):
        if event == _COMPILE_EVENT:
            self.count += 1
        if event == _COMPILE_EVENT or event in _LOWERING_EVENTS:
            self.seconds += duration_secs


def queued_calls() -> int:
    """Return the calls per repetition on the default backend."""
    return QUEUED.get(jax.default_backend(), 1)


def time_calls(
    call: Callable[[], Any],
    repetitions: int,
    *,
    wait: Callable[[Any], Any] = lambda output: None,
    queued: int = 1,
    warm_up: int = WARM_UP,
) -> np.ndarray:
    """Seconds per call ``[repetitions]``.

    Args:
      call: starts the work; it need not be done when this returns.
      repetitions: of the measurement.
      wait: for the output of a call; returns when all calls so far are done.
      queued: calls of one repetition, one wait after the last.
      warm_up: calls before.
    """
    for _ in range(warm_up):
        wait(call())
    seconds = np.empty(repetitions)
    gc.collect()
    gc.disable()  # a collection in the middle of a call would be charged to it
    try:
        for n in range(repetitions):
            start = time.perf_counter()
            for _ in range(queued):
                output = call()
            wait(output)
            seconds[n] = (time.perf_counter() - start) / queued
    finally:
        gc.enable()
    return seconds


def summary(seconds: np.ndarray) -> dict[str, Any]:
    """Median and inter-quartile range in ms, and how many."""
    low, median, high = np.percentile(1e3 * seconds, (25, 50, 75))
    return {"median_ms": float(median), "iqr_ms": float(high - low), "repetitions": int(seconds.size)}


def measure(case: Case, repetitions: int = REPETITIONS) -> dict[str, Any]:
    """Compile, time and describe one case: a row of the results (see ``schema.ROW``).

    ``flops`` are those of convolutions and matrix products in the traced program, twice their multiply-adds, loops
    times their length; where there are none, all that XLA counts. ``least_bytes`` are of arguments and results:
    nothing can move less. XLA's own counts are beside them; they take a loop's body once.

    Raises:
      RuntimeError: something was compiled while the clock ran: the function does not keep its types.
    """
    arguments = jax.device_put(case.arguments)
    jax.block_until_ready(arguments)
    jitted = jax.jit(case.function, donate_argnums=case.donate, compiler_options=case.compiler_options)
    with Compilations() as building:
        compiled = jitted.lower(*arguments).compile()
    state = {"arguments": arguments}

    def call() -> Any:
        output = compiled(*state["arguments"])
        state["arguments"] = case.following(state["arguments"], output)
        return output

    with Compilations() as timing:
        seconds = time_calls(call, repetitions, wait=jax.block_until_ready, queued=queued_calls())
    if timing.count:
        raise RuntimeError(f"{case.name}: compiled {timing.count} times while the clock ran.")
    row = {"name": case.name, "implementation": case.implementation, **summary(seconds)}
    row |= {"compile_seconds": building.seconds, "compilations": building.count}
    row |= _program(compiled, case) | device_time(call)
    row["work"] = dict(case.work)
    return row


def device_time(call: Callable[[], Any], calls: int = 10) -> dict[str, float]:
    """``device_ms``: for how long one call keeps a GPU busy, by the profiler; nothing on other backends."""
    if jax.default_backend() != "gpu":
        return {}
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(calls):
                output = call()
            jax.block_until_ready(output)
        return {"device_ms": device_milliseconds(Path(folder)) / calls}


def _program(compiled: Any, case: Case) -> dict[str, Any]:
    """Memory and work of a compiled program."""
    memory, analysis = compiled.memory_analysis(), compiled.cost_analysis() or {}
    least = memory.argument_size_in_bytes + memory.output_size_in_bytes
    products = 2 * multiply_adds(case.function, *case.arguments)
    return {
        "temporary_megabytes": memory.temp_size_in_bytes / 1e6,
        "peak_megabytes": (least + memory.temp_size_in_bytes - memory.alias_size_in_bytes) / 1e6,
        "least_bytes": float(least),
        "xla_bytes": float(analysis.get("bytes accessed", 0.0)),
        "xla_flops": float(analysis.get("flops", 0.0)),
        "flops": float(products or analysis.get("flops", 0.0)),
    }
