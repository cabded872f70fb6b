"""The one helper that maps a kernel, written for one image, over any leading axes."""

import jax
import jax.numpy as jnp

from essjax.typing import Array, Callable


def over_leading_axes(kernel: Callable, ranks: tuple[int, ...], *arrays: Array):
    """Apply ``kernel`` to arrays of the given core ranks, vmapped over their (broadcast) leading axes.

    An array without a leading axis that others have is shared, not copied.

    Args:
      kernel: takes one array per entry of ``ranks``; returns an array or a tuple of arrays.
      ranks: number of trailing axes of each array that belong to one image.
      *arrays: ``[..., *core]``; leading axes broadcast as in NumPy.
    """
    counts = [array.ndim - rank for array, rank in zip(arrays, ranks, strict=True)]
    leading = jnp.broadcast_shapes(*(array.shape[:count] for array, count in zip(arrays, counts, strict=True)))
    arrays = tuple(
        jnp.broadcast_to(array, leading[len(leading) - count :] + array.shape[count:])
        for array, count in zip(arrays, counts, strict=True)
    )
    for depth in range(len(leading)):  # the innermost axis first
        kernel = jax.vmap(kernel, in_axes=tuple(0 if count > depth else None for count in counts))
    return kernel(*arrays)


def check_channels(name: str, array: Array, channels: int | None, size: tuple[int, ...] | None = None) -> None:
    """Raise a ValueError unless ``array`` is ``[..., H, W, channels]``, with (H, W) = ``size`` where given."""
    shape = tuple(array.shape)
    fits = len(shape) >= 3 and channels in (None, shape[-1]) and size in (None, shape[-3:-1])
    if not fits:
        expected = "H, W" if size is None else f"{size[0]}, {size[1]}"
        raise ValueError(
            f"{name}: expected [..., {expected}, {'C' if channels is None else channels}], got {shape}. "
            f"Images are channels-last, and both must have the same resolution."
        )
