"""Distances between two images, pixel by pixel."""

import jax.numpy as jnp

from essjax.typing import Array, Image


def check_same_shape(first: Array, second: Array, names: tuple[str, str] = ("prediction", "target")) -> None:
    """Raise a ValueError where two images that are compared differ in shape: broadcasting would hide a mistake."""
    if first.shape != second.shape:
        raise ValueError(
            f"{names[0]} and {names[1]}: expected the same shape, got {tuple(first.shape)} and {tuple(second.shape)}. "
            "Bring both to one resolution and the same leading axes first."
        )


def as_float32(first: Array, second: Array, names: tuple[str, str] = ("prediction", "target")) -> tuple[Array, Array]:
    """Two images to compare, in float32: 16-bit floats would round the result, integers would wrap around.

    Raises:
      ValueError: the shapes differ, or an image holds integers.
    """
    check_same_shape(first, second, names)
    for name, image in zip(names, (first, second), strict=True):
        if not jnp.issubdtype(image.dtype, jnp.floating):
            raise ValueError(
                f"{name}: expected floating-point values, got {image.dtype}. Divide by the largest integer (255) first."
            )
    return first.astype(jnp.float32, copy=False), second.astype(jnp.float32, copy=False)


def l1(prediction: Image, target: Image) -> Image:
    """Absolute difference ``[..., H, W, C]``: the L1 of ExtraSS eq 12, ExtraNet eq 7, FASSET eq 5 before its mean.

    Raises:
      ValueError: the shapes differ, or an image holds integers.
    """
    prediction, target = as_float32(prediction, target)
    return jnp.abs(prediction - target)


def charbonnier(prediction: Image, target: Image, *, epsilon2: float = 1e-6) -> Image:
    """Smooth L1 ``sqrt((prediction - target)^2 + epsilon2)``, ``[..., H, W, C]``: rho of ExtraSS eq 7.

    Charbonnier et al. 1994, with IFRNet's ``epsilon2``. Its gradient is finite where the images agree, and its value
    there is ``sqrt(epsilon2)``, not 0.

    Raises:
      ValueError: the shapes differ, or an image holds integers.
    """
    prediction, target = as_float32(prediction, target)
    return jnp.sqrt((prediction - target) ** 2 + epsilon2)
