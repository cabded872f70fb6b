"""Triton kernels in JAX programs: whether they can run here, and the call (optional: ``pip install 'essjax[gpu]'``)."""

import contextlib
import contextvars
import functools
import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp

from essjax.typing import Array

_plain: contextvars.ContextVar[bool] = contextvars.ContextVar("plain", default=False)


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Trace what every backend runs: no kernels, nothing padded for a GPU.

    To compare with, and to count work. Enter it inside the function that is jitted: jit's cache does not know of it.
    """
    token = _plain.set(True)
    try:
        yield
    finally:
        _plain.reset(token)


def backend() -> str:
    """Where programs that are traced now will run: "cpu", "gpu", "tpu". Minds ``jax.default_device``."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    platform = jax.default_backend() if device is None else getattr(device, "platform", device)
    return "gpu" if platform in ("cuda", "rocm") else platform


def check_platform() -> None:
    """Raise a ValueError where ``JAX_PLATFORMS`` names a platform that is not here."""
    wanted = os.environ.get("JAX_PLATFORMS")
    if not wanted:
        return
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter where there is no plugin at all
        reason = (str(error).splitlines() or ["there is no plugin for it"])[0]
        raise ValueError(
            f"JAX_PLATFORMS={wanted}: JAX cannot run there ({reason}). Install its plugin (for NVIDIA: pip install "
            "'essjax[gpu]'), or leave JAX_PLATFORMS away."
        ) from error


def on_gpu() -> bool:
    """Whether programs for a GPU are to be made."""
    return backend() == "gpu" and not _plain.get()


@functools.cache
def _installed() -> bool:
    return importlib.util.find_spec("jax_triton") is not None


def available() -> bool:
    """Whether kernels can run: JAX is on a GPU and ``jax-triton`` is installed."""
    return on_gpu() and _installed()


def call(kernel: Any, *arrays: Array, out_shape: Sequence[jax.ShapeDtypeStruct], **options: Any) -> list[Array]:
    """``jax_triton.triton_call``: ``options`` are the grid, ``num_warps`` and the kernel's constants."""
    cache = os.environ.get("TRITON_CACHE_DIR")
    import jax_triton  # empties that variable, and torch.compile in the same process would find no cache

    if cache is None:
        os.environ.pop("TRITON_CACHE_DIR", None)
    else:
        os.environ["TRITON_CACHE_DIR"] = cache
    return list(jax_triton.triton_call(*cast(Any, arrays), kernel=kernel, out_shape=list(out_shape), **options))


def over_batches(function: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
    """Make a function that calls a kernel work under ``jax.vmap``: the new axis joins the batch.

    Args:
      function: its arrays have a leading axis of B, or of 1: one for all of the batch. Its results have one of B.
    """
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def rule(size: int, batched: list[bool], *arrays: Array):
        batch = max(array.shape[int(has)] for array, has in zip(arrays, batched, strict=True))

        def merge(array: Array, has: bool) -> Array:
            if not has and array.shape[0] == 1:
                return array
            array = jnp.broadcast_to(array if has else array[None], (size, batch, *array.shape[1 + int(has) :]))
            return array.reshape(size * batch, *array.shape[2:])

        outputs = mapped(*(merge(array, has) for array, has in zip(arrays, batched, strict=True)))
        return [output.reshape(size, batch, *output.shape[1:]) for output in outputs], [True] * len(outputs)

    return mapped
