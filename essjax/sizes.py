"""Sizes of outputs, given by a ratio or exactly, and the ratio between two sizes, axis by axis.

Sizes are ``(height, width)`` as in an image's shape; only where a user gives one it is ``(width, height)``.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from numbers import Real

Size = tuple[int, int]
"""``(height, width)``, pixels."""
Scale = float | tuple[int, int]
"""How large an output is: a number >= 1 that both sides of the input are multiplied with, or ``(width, height)``."""


def check_scale(scale: Scale | Sequence[int]) -> Scale:
    """Return the scale, whole numbers as ints and a size as a tuple.

    Raises:
      ValueError: it is neither a number >= 1 nor a size.
    """
    number = isinstance(scale, Real) and not isinstance(scale, bool)
    if number and math.isfinite(scale) and scale >= 1:
        return int(scale) if scale == int(scale) else float(scale)
    pair = isinstance(scale, list | tuple) and len(scale) == 2
    if pair and all(isinstance(side, int) and side >= 1 for side in scale):
        return scale[0], scale[1]
    raise ValueError(f"scale: expected a number >= 1 or the output's (width, height), got {scale!r}.")


def output_size(scale: Scale | Sequence[int], size: Sequence[int]) -> Size:
    """Return the size of the output for an input of ``size`` (height, width); that of a ratio is rounded.

    Raises:
      ValueError: no such scale, or the output would be smaller than the input.
    """
    scale, (height, width) = check_scale(scale), size
    if not isinstance(scale, tuple):
        return round(scale * height), round(scale * width)
    if scale[0] < width or scale[1] < height:
        raise ValueError(
            f"scale: expected an output of at least the input's {width}x{height}, got {scale[0]}x{scale[1]}."
        )
    return scale[1], scale[0]


def check_size(size: Sequence[int]) -> Size:
    """Return ``(height, width)`` as a tuple; raise a ValueError unless both are whole numbers >= 1."""
    whole = isinstance(size, Sequence) and len(size) == 2 and all(int(side) == side and side >= 1 for side in size)
    if not whole:
        raise ValueError(f"size: expected (height, width), two whole numbers >= 1, got {size!r}.")
    return int(size[0]), int(size[1])


def ratios(size: Sequence[int], output: Sequence[int]) -> tuple[float, float]:
    """Return output size over input size along x and y, both sizes (height, width)."""
    return output[1] / size[1], output[0] / size[0]


def whole_ratio(size: Sequence[int], output: Sequence[int]) -> int | None:
    """Return the whole number by which both sides of ``size`` are multiplied, or None."""
    factor = output[0] // size[0]
    return factor if factor >= 1 and (factor * size[0], factor * size[1]) == tuple(output) else None


def scale_of(size: Sequence[int], output: Sequence[int]) -> Scale:
    """Return the simplest scale that makes ``output`` of ``size``: a number where both sides have one ratio."""
    along_x, along_y = Fraction(output[1], size[1]), Fraction(output[0], size[0])
    if along_x != along_y:
        return output[1], output[0]
    return int(along_x) if along_x.denominator == 1 else float(along_x)


MAX_STEP = 8
"""Largest denominator of a ratio that crops may have: they begin and end at its multiples."""


def crop_steps(size: Sequence[int], output: Sequence[int]) -> Size | None:
    """Return of what the sides of crops of ``size`` must be multiples (y, x), for those of ``output`` to be whole.

    None where one of them is above ``MAX_STEP``: hardly a crop would be left.
    """
    steps = Fraction(output[0], size[0]).denominator, Fraction(output[1], size[1]).denominator
    return steps if max(steps) <= MAX_STEP else None


def describe_scale(scale: Scale) -> str:
    """Say a scale in a title: "x1.5", or "1920x1080"."""
    return f"{scale[0]}x{scale[1]}" if isinstance(scale, tuple) else f"x{scale:.4g}"
