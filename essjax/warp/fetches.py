"""Bicubic reads made of bilinear ones, as shaders do them: a GPU fetches a bilinear read in one go."""

import jax.numpy as jnp

from essjax.typing import Array, Image, Places, Resized
from essjax.warp._batch import check_channels
from essjax.warp.sampling import cubic_weights, sample


def sample_by_fetches(image: Image, positions: Places, *, fetches: int = 9, parameter: float = -0.75) -> Resized:
    """Read ``image`` at ``positions`` with Keys' bicubic kernel from 9 bilinear fetches, or from 5 of them.

    One fetch between the two inner pixels, at the ratio of their weights, stands for both, so that 4 x 4 pixels take
    3 x 3 fetches: the same as ``sample`` with "bicubic-0.75" up to rounding. 5 leaves out the four corners and divides
    by the sum of the other weights, as Unreal Engine's temporal anti-aliasing does. Borders repeat.

    Source: thesis 002 section 5.5.1 (Bicubic9, Bicubic5) and its appendix A.2.

    Args:
      image: ``[..., H, W, C]``.
      positions: ``[..., h, w, 2]`` (x, y) in pixels of ``image``, centres at +0.5.
      fetches: 9 or 5.
      parameter: Keys' a.

    Returns:
      ``[..., h, w, C]``.

    Raises:
      ValueError: another number of fetches, or wrong shapes.
    """
    if fetches not in (5, 9):
        raise ValueError(f"fetches: expected 5 or 9, got {fetches!r}.")
    check_channels("positions", positions, 2)
    first = jnp.floor(positions - 0.5)
    w0, w1, w2, w3 = cubic_weights(positions - 0.5 - first, parameter)
    inner = w1 + w2  # at least 1 for a <= 0
    center = first + 0.5
    taps = [(center - 1.0, w0), (center + w2 / inner, inner), (center + 2.0, w3)]
    total, weights = jnp.zeros((), jnp.float32), jnp.zeros((), jnp.float32)
    for i, (y, weight_y) in enumerate(taps):
        for j, (x, weight_x) in enumerate(taps):
            if fetches == 5 and i != 1 and j != 1:
                continue
            weight: Array = weight_x[..., :1] * weight_y[..., 1:]
            total = total + weight * sample(image, jnp.concatenate([x[..., :1], y[..., 1:]], axis=-1))
            weights = weights + weight
    return total / weights
