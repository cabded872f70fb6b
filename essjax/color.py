"""Colour transforms, each with its inverse. Inputs ``[..., 3]`` linear HDR unless said otherwise."""

import jax
import jax.numpy as jnp

from essjax.typing import Array, Color, Image, Plane, Scalar, Values

ALBEDO_FLOOR = 0.04
"""Smallest divisor of a demodulation: below it noise in dark materials would be amplified."""


def demodulation_albedo(
    base_color: Color, background: Array, metallic: Plane | None = None, specular: Plane | None = None
) -> Color:
    """Return the divisor of shading before a warp, its factor after it (ExtraSS section 4.2).

    ``base_color + 0.08 * specular * (1 - metallic)``, at least ``ALBEDO_FLOOR``; 1 on the background, so that sky is
    neither demodulated nor modulated.

    Args:
      base_color: ``[..., H, W, 3]`` in [0, 1].
      background: bool ``[..., H, W, 1]``, true where nothing was hit.
      metallic: ``[..., H, W, 1]`` in [0, 1]; 0 if None.
      specular: ``[..., H, W, 1]`` in [0, 1]; 0.5 if None.
    """
    reflectance = 0.08 * (0.5 if specular is None else specular) * (1.0 if metallic is None else 1.0 - metallic)
    return jnp.where(background, 1.0, jnp.maximum(base_color + reflectance, ALBEDO_FLOOR))


def demodulate(color: Color, albedo: Color) -> Color:
    """Shading without texture: ``color / albedo``; ``albedo`` from ``demodulation_albedo`` (> 0)."""
    return color / albedo


def modulate(shading: Color, albedo: Color) -> Color:
    """Inverse of ``demodulate``."""
    return shading * albedo


def expose(radiance: Image, exposure: Scalar) -> Image:
    """Scene radiance ``[..., H, W, C]`` times its frame's exposure ``[...]``: what the transfer functions below take.

    The unit of radiance is gone after it. Divide by the exposure with ``expose(exposed, 1 / exposure)``.
    """
    return radiance * exposure[..., None, None, None]


@jax.custom_vjp
def log1p(color: Values) -> Values:
    """log(1 + x) of exposed colour: what networks see. Negative input counts as 0; there and at 0 the gradient is 0.

    The gradient is computed from the output, exp(-y): what made the input (a bicubic read, say) can then be fused with
    the logarithm instead of being stored for the backward pass. Differentiates in reverse mode only.
    """
    return jnp.log1p(jnp.maximum(color, 0.0))


def _log1p_forward(color):
    encoded = jnp.log1p(jnp.maximum(color, 0.0))
    return encoded, encoded


def _log1p_backward(encoded, gradient):
    return (jnp.where(encoded > 0, gradient * jnp.exp(-encoded), jnp.zeros_like(gradient)),)


log1p.defvjp(_log1p_forward, _log1p_backward)


def expm1(encoded: Values) -> Values:
    """Inverse of ``log1p``; negative values become 0."""
    return jnp.expm1(jnp.maximum(encoded, 0.0))


def reinhard(color: Values) -> Values:
    """Compress by x / (1 + x): [0, inf) to [0, 1). Negative input counts as 0."""
    color = jnp.maximum(color, 0.0)
    return color / (1.0 + color)


_REINHARD_LIMIT = 0.9999


@jax.custom_vjp
def log1p_of_reinhard(encoded: Values) -> Values:
    """log(1 + x) of ``encoded`` = x / (1 + x), which is -log(1 - encoded); clamped to [0, 0.9999] first.

    The gradient is computed from the output, exp(y), and 0 where clamped; see ``log1p``.
    """
    return -jnp.log1p(-jnp.clip(encoded, 0.0, _REINHARD_LIMIT))


def _log1p_of_reinhard_forward(encoded):
    result = -jnp.log1p(-jnp.clip(encoded, 0.0, _REINHARD_LIMIT))
    return result, result


def _log1p_of_reinhard_backward(result, gradient):
    inside = (result > 0) & (result < -jnp.log1p(jnp.asarray(-_REINHARD_LIMIT, result.dtype)))
    return (jnp.where(inside, gradient * jnp.exp(result), jnp.zeros_like(gradient)),)


log1p_of_reinhard.defvjp(_log1p_of_reinhard_forward, _log1p_of_reinhard_backward)


def reinhard_inverse(encoded: Values, *, limit: float = 0.9999) -> Values:
    """Inverse of ``reinhard``; values above ``limit`` are clamped so that the result stays finite.

    Computed in float32: in 16 bits the limit would be 1.
    """
    dtype = jnp.result_type(encoded, 0.0)
    clipped = jnp.clip(jnp.asarray(encoded, jnp.promote_types(dtype, jnp.float32)), 0.0, limit)
    return (clipped / (1.0 - clipped)).astype(dtype)


def srgb_encode(linear: Values) -> Values:
    """Apply the sRGB transfer function (IEC 61966-2-1) on [0, 1]; finite gradient at 0."""
    safe = jnp.maximum(linear, 0.0031308)
    return jnp.where(linear <= 0.0031308, 12.92 * linear, 1.055 * safe ** (1.0 / 2.4) - 0.055)


def srgb_decode(encoded: Values) -> Values:
    """Inverse of ``srgb_encode``."""
    safe = jnp.maximum(encoded, 0.04045)
    return jnp.where(encoded <= 0.04045, encoded / 12.92, ((safe + 0.055) / 1.055) ** 2.4)


def display(color: Values) -> Values:
    """Show colour as viewers see it and metrics score it: ``srgb_encode(reinhard(color))``, in [0, 1)."""
    return srgb_encode(reinhard(color))


def display_of_log1p(encoded: Values) -> Values:
    """``display(expm1(encoded))``, continued below 0 with its slope there, so that a loss leads back to colours."""
    return display(expm1(encoded)) + 12.92 * jnp.minimum(encoded, 0.0)


def display_inverse(encoded: Values) -> Values:
    """Inverse of ``display``; what is outside [0, 1) is clamped so that the result is finite and >= 0."""
    return reinhard_inverse(srgb_decode(jnp.clip(encoded, 0.0, 1.0)))


def rgb_to_ycocg(rgb: Color) -> Color:
    """Luma and two chroma differences (Malvar and Sullivan 2003); linear, exactly invertible in reals."""
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    return jnp.stack([0.25 * r + 0.5 * g + 0.25 * b, 0.5 * (r - b), -0.25 * r + 0.5 * g - 0.25 * b], axis=-1)


def ycocg_to_rgb(ycocg: Color) -> Color:
    """Inverse of ``rgb_to_ycocg``."""
    y, co, cg = ycocg[..., 0], ycocg[..., 1], ycocg[..., 2]
    return jnp.stack([y + co - cg, y + cg, y - co - cg], axis=-1)


def sum_channels(image: Array) -> Array:
    """Sum over the last axis, ``[..., C]`` to ``[..., 1]``, term by term.

    For few channels of large images: XLA:CPU takes ten times as long to reduce over three numbers, and fuses nothing
    with it.
    """
    total = image[..., :1]
    for channel in range(1, image.shape[-1]):
        total = total + image[..., channel : channel + 1]
    return total


def luminance(color: Color) -> Plane:
    """Rec. 709 luminance ``[..., 1]`` of linear colour."""
    weights = jnp.array([[0.2126], [0.7152], [0.0722]], color.dtype)
    return jnp.matmul(color, weights, precision=jax.lax.Precision.HIGHEST)  # some accelerators round products
