"""Triton kernels in JAX programs: whether they can run here, and the call (optional: ``pip install 'essjax[gpu]'``)."""

import functools
import importlib.util
import os
from collections.abc import Sequence
from typing import Any, cast

import jax

from essjax.typing import Array


@functools.cache
def available() -> bool:
    """Whether JAX runs on a GPU and ``jax-triton`` is installed."""
    return jax.default_backend() == "gpu" and importlib.util.find_spec("jax_triton") is not None


def call(kernel: Any, *arrays: Array, out_shape: Sequence[jax.ShapeDtypeStruct], **options: Any) -> list[Array]:
    """``jax_triton.triton_call``: ``options`` are the grid, ``num_warps`` and the kernel's constants."""
    cache = os.environ.get("TRITON_CACHE_DIR")
    import jax_triton  # empties that variable, and torch.compile in the same process would find no cache

    if cache is None:
        os.environ.pop("TRITON_CACHE_DIR", None)
    else:
        os.environ["TRITON_CACHE_DIR"] = cache
    return list(jax_triton.triton_call(*cast(Any, arrays), kernel=kernel, out_shape=list(out_shape), **options))
