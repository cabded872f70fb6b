"""Array aliases with named axes: ``...`` is any leading (time, batch) axes; one name in a signature is one size."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, cast, dataclass_transform

import chex
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

Array = jax.Array | np.ndarray
"""On a device or on the host: data and scenes make NumPy arrays, jitted code takes both and makes JAX arrays."""
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
Resized = Float[Array, "... H W c"]
"""An image made of one of another size, with its channels."""
Places = Float[Array, "... H W 2"]
"""Positions in, or motion on the pixels of, an image of another size."""
Guide = Float[Array, "... h w g"]
"""Channels that tell surfaces apart, pixel by pixel: as many as they like, beside an image of others."""
Level = Float[Array, "... _ _ _"]
"""One of several images of different sizes and channels."""
Values = Float[Array, "..."]
"""Anything that a function works on number by number."""
Jitter = Float[Array, "... 2"]
"""(x, y) in LR pixels in [-0.5, 0.5): the sample lies at pixel centre + jitter."""
Scalar = Float[Array, "..."]
Flag = Bool[Array, "..."]
Matrix4 = Float[Array, "... 4 4"]
Key = PRNGKeyArray
PyTree = Any
"""A pytree of arrays: variables, history, optimiser state."""

_T = TypeVar("_T")


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,))
def pytree(cls: type[_T]) -> type[_T]:
    """Class decorator: a frozen, keyword-only ``chex.dataclass`` that JAX sees as a pytree.

    Type checkers read it as a dataclass (they do not know chex's decorator); change a field with
    ``dataclasses.replace``.
    """
    return cast(type[_T], chex.dataclass(cls, frozen=True, kw_only=True, mappable_dataclass=False))


__all__ = [
    "Array", "Bool", "Callable", "Color", "Flag", "Float", "Guide", "Ids", "Image", "Int", "Jitter", "Key", "Level",
    "Mask", "Matrix4", "Motion", "Places", "Plane", "Positions", "PyTree", "Resized", "Scalar", "Values", "Vectors",
    "pytree",
]  # fmt: skip
