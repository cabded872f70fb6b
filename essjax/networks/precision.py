"""The compute type of convolutions and matrix products (docs/adr/0005-mixed-precision.md).

Weights, activations between layers, warps inside networks and everything else stay float32; operands are rounded where
they enter a product, and XLA fuses the conversions with what is around them.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from functools import wraps

import jax
import jax.numpy as jnp
from jax import lax

from essjax.typing import Callable

DTYPES = ("float32", "bfloat16", "float16")
_current: contextvars.ContextVar[str] = contextvars.ContextVar("compute_dtype", default="float32")


@contextlib.contextmanager
def compute_dtype(name: str) -> Iterator[None]:
    """Networks that are traced inside multiply in this type. Enter it inside the function that is jitted: jit's cache
    does not know of it.

    Args:
      name: "float32", "bfloat16" or "float16".

    Raises:
      ValueError: another name.
    """
    if name not in DTYPES:
        raise ValueError(f"compute dtype: expected one of {', '.join(DTYPES)}, got {name!r}.")
    token = _current.set(name)
    try:
        yield
    finally:
        _current.reset(token)


def current_itemsize() -> int:
    """Bytes of a number of the compute type."""
    return jnp.dtype(_current.get()).itemsize


def in_compute_dtype(product: Callable) -> Callable:
    """``product`` of two operands that are rounded to the compute type; its result has the first one's type again."""

    @wraps(product)
    def rounded(lhs, rhs, *arguments, **options):
        dtype = jnp.dtype(_current.get())
        if lhs.dtype == dtype and rhs.dtype == dtype:
            return product(lhs, rhs, *arguments, **options)
        return product(lhs.astype(dtype), rhs.astype(dtype), *arguments, **options).astype(lhs.dtype)

    return rounded


@in_compute_dtype
def dot_general(lhs, rhs, dimension_numbers, precision=None, **options):
    """``lax.dot_general`` for linen's ``dot_general=``, in the compute type."""
    del options  # linen's preferred type would be that of the operands before rounding
    return lax.dot_general(lhs, rhs, dimension_numbers, precision=precision)


LIKED = 8
"""Channels come in multiples of this where a GPU multiplies 16-bit numbers: 16 bytes, one access."""


def pad_channels(x: jax.Array) -> jax.Array:
    """Pad 16-bit images with channels of zeros up to a multiple of ``LIKED``; others unchanged.

    cuDNN pads by passes of its own; written out, XLA joins it with what makes the image.
    """
    if x.dtype.itemsize != 2 or x.shape[-1] % LIKED == 0:
        return x
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, -x.shape[-1] % LIKED)])
