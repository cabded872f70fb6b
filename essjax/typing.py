"""Array aliases with named axes. ``...`` stands for any leading (time, batch) axes."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Image = Float[Array, "... h w c"]
"""Linear HDR colour or features, row 0 on top."""
Color = Float[Array, "... h w 3"]
"""Linear scene radiance, HDR, >= 0."""
Motion = Float[Array, "... h w 2"]
"""(x right, y down) in pixels of its own resolution, ``previous = current + motion``."""
Mask = Float[Array, "... h w 1"]
"""1 = valid, 0 = hole."""
Plane = Float[Array, "... h w 1"]
"""One scalar per pixel: depth, roughness, ..."""
Vectors = Float[Array, "... h w 3"]
"""One 3-vector per pixel: world-space normal, world position."""
Ids = Int[Array, "... h w 1"]
"""Integer object id >= 0; 0 = static or none."""
Positions = Float[Array, "... h w 2"]
"""Image positions (x, y) in pixels; the centre of the top left pixel is (0.5, 0.5)."""
Jitter = Float[Array, "... 2"]
"""(x, y) in LR pixels in [-0.5, 0.5): the sample lies at pixel centre + jitter."""
Scalar = Float[Array, "..."]
Flag = Bool[Array, "..."]
Matrix4 = Float[Array, "... 4 4"]
Key = PRNGKeyArray
PyTree = Any
"""A pytree of arrays: variables, history, optimiser state."""

__all__ = [
    "Array", "Bool", "Callable", "Color", "Flag", "Float", "Ids", "Image", "Int", "Jitter", "Key", "Mask", "Matrix4",
    "Motion", "Plane", "Positions", "PyTree", "Scalar", "Vectors",
]  # fmt: skip
