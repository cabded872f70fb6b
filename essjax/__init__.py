"""essjax: neural supersampling and frame extrapolation for real-time rendering, in JAX.

``import essjax`` costs nothing: its modules are imported when they are first named (``essjax.methods.extrass()``).

Conventions (docs/conventions.md): images ``[..., H, W, C]`` linear HDR, row 0 on top, pixel centres at +0.5; motion in
pixels of its own resolution, current to previous (``previous = current + motion``, x right, y down); sequences
time-major ``[T, B, H, W, C]``.
"""

import importlib
from types import ModuleType

__version__ = "0.1.0"

__all__ = [
    "buffers", "builtin", "cameras", "color", "data", "deploy", "exposure", "files", "frames", "interfaces", "kernels",
    "labels", "losses", "methods", "metrics", "networks", "rollout", "scenes", "sizes", "stopping", "tensors", "train",
    "typing", "warp",
]  # fmt: skip


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return importlib.import_module(f"essjax.{name}")
    raise AttributeError(f"module 'essjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
