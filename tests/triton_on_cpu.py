"""Triton kernels without a GPU: in Triton's interpreter, called back from JAX programs. With one: as they are."""

import importlib
import sys

import jax
import numpy as np
import pytest

from essjax import kernels


def is_called(function, *arguments) -> bool:
    """Whether a function's program calls a kernel."""
    program = str(jax.make_jaxpr(function)(*arguments))
    return "pure_callback" in program or "triton_kernel_call" in program


def load(name: str, monkeypatch) -> object:
    """Import the module of a kernel; without a GPU ``kernels.call`` runs it in the interpreter until the test ends.

    Skips where Triton or PyTorch, which its interpreter needs, is missing.
    """
    if kernels.available():
        return importlib.import_module(name)
    pytest.importorskip("triton")
    torch = pytest.importorskip("torch")
    monkeypatch.delitem(sys.modules, name, raising=False)

    def call(kernel, *arrays, out_shape, grid, num_warps, **constants):
        def run(*arrays):
            outputs = [
                torch.from_numpy(np.full(s.shape, np.nan if s.dtype.kind == "f" else -1, s.dtype)) for s in shapes
            ]
            kernel[grid](*(torch.from_numpy(np.array(a)) for a in arrays), *outputs, **constants)
            return [output.numpy() for output in outputs]

        shapes = [jax.ShapeDtypeStruct(s.shape, np.dtype(s.dtype)) for s in out_shape]
        return jax.pure_callback(run, shapes, *arrays)

    monkeypatch.setattr(kernels, "call", call)
    monkeypatch.setattr(kernels, "available", lambda: not kernels._plain.get())
    module = importlib.import_module(name)
    monkeypatch.setitem(sys.modules, name, module)  # and forget it with the test
    return module
