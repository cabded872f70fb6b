"""Limits of the machine, measured in the same run: the roofline that rows are compared with."""

from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmark.measure import Case, measure


def roofline(repetitions: int, *, megabytes: int = 256, size: int | None = None) -> dict[str, float]:
    """Bytes per second of a copy in place and FLOP/s of a matrix product, float32 and bfloat16.

    Args:
      repetitions: of each.
      megabytes: size of the array that is copied; larger than the caches.
      size: rows and columns of the matrices; None: 2048, on a GPU 8192.
    """
    size = size or (8192 if jax.default_backend() == "gpu" else 2048)
    array = jnp.zeros(megabytes * 250_000, jnp.float32)
    # Donated: into a fresh array each call would measure the allocator.
    copy = measure(
        Case("copy", lambda x: x + 1.0, (array,), donate=(0,), following=lambda _, output: (output,)), repetitions
    )
    found = {"copy_bytes_per_second": 2e6 * megabytes / (1e-3 * copy["median_ms"])}
    for dtype in (jnp.float32, jnp.bfloat16):
        matrix = jax.random.normal(jax.random.key(0), (size, size), dtype)
        row = measure(Case("product", jnp.matmul, (matrix, matrix)), repetitions)
        found[f"{jnp.dtype(dtype).name}_flops_per_second"] = 2.0 * size**3 / (1e-3 * row["median_ms"])
    return found


def roofline_fraction(row: dict[str, Any], machine: dict[str, float], dtype: str = "float32") -> float:
    """Least time over measured time: the work at the machine's rate, or its arguments and results through memory.

    On a GPU measured is the time for which it was busy: launches are the host's.
    """
    rate = machine.get(f"{dtype}_flops_per_second", machine["float32_flops_per_second"])
    least = max(row["flops"] / rate, row["least_bytes"] / machine["copy_bytes_per_second"])
    return least / (1e-3 * row.get("device_ms", row["median_ms"]))
