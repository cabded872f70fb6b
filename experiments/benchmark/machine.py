"""What the machine can do, measured in the same run: the roofline that rows are compared with."""

from typing import Any

import jax.numpy as jnp

from experiments.benchmark.measure import Case, measure


def roofline(repetitions: int, *, megabytes: int = 256, size: int = 2048) -> dict[str, float]:
    """Bytes per second of a copy in place and FLOP/s of a matrix product, float32 and bfloat16.

    Args:
      repetitions: of each.
      megabytes: size of the array that is copied; larger than the caches.
      size: rows and columns of the matrices.
    """
    array = jnp.zeros(megabytes * 250_000, jnp.float32)
    # Donated: into a fresh array each call would measure the allocator.
    copy = measure(
        Case("copy", lambda x: x + 1.0, (array,), donate=(0,), following=lambda _, output: (output,)), repetitions
    )
    found = {"copy_bytes_per_second": 2e6 * megabytes / (1e-3 * copy["median_ms"])}
    for dtype in (jnp.float32, jnp.bfloat16):
        matrix = jnp.ones((size, size), dtype)
        row = measure(Case("product", jnp.matmul, (matrix, matrix)), repetitions)
        found[f"{jnp.dtype(dtype).name}_flops_per_second"] = 2.0 * size**3 / (1e-3 * row["median_ms"])
    return found


def roofline_fraction(row: dict[str, Any], machine: dict[str, float], dtype: str = "float32") -> float:
    """Least time over measured time: the work at the machine's rate, or its arguments and results through memory."""
    rate = machine.get(f"{dtype}_flops_per_second", machine["float32_flops_per_second"])
    least = max(row["flops"] / rate, row["least_bytes"] / machine["copy_bytes_per_second"])
    return least / (1e-3 * row["median_ms"])
