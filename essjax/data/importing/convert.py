"""Foreign conventions to essjax's (docs/conventions.md): one small pure NumPy function each.

Everything downstream of an import has one sign, one unit and one axis order, so all of them are decided here.
Images are ``[H, W, C]`` float32.
"""

import numpy as np

VELOCITY_ZERO = 32767 / 65535
"""The value in Unreal's 16-bit velocity texture where nothing moves."""
VELOCITY_RANGE = 0.499 * 0.5
"""Encoded velocity per unit of normalised device coordinates."""
SHORT_NORMAL = 1e-3
"""Shorter than this is no normal."""


def decode_velocity(encoded: np.ndarray, encoding: str) -> tuple[np.ndarray, np.ndarray]:
    """Unreal's velocity to normalised device coordinates (2 = the image's width).

    Args:
      encoded: ``[H, W, 2]``, in [0, 1].
      encoding: "unreal4": v · 0.2495 + 32767 / 65535; "unreal5": the same of sign(v) · sqrt(2 |v|), for small motion;
        "unreal-mrq": 0.5 + v / 2, which is what Epic's documentation says of Movie Render Queue's MotionVectors pass.

    Returns:
      ``[H, W, 2]`` current - previous, y up, and bool ``[H, W, 1]``: true where the engine wrote a velocity (the first
      two hold 0 where only the camera moves).

    Raises:
      ValueError: much of an "unreal-mrq" image is exactly 0, which would be half a screen.
    """
    if encoding == "unreal-mrq":
        unwritten = float((encoded == 0).all(axis=-1).mean())
        if unwritten > 0.01:
            raise ValueError(
                f"motion: the MotionVectors pass holds 0.5 where nothing moves, this image 0 in {unwritten:.1%} of the "
                "pixels: is it the raw velocity texture? Then give [motion] encoding unreal4 or unreal5 in the recipe."
            )
        return 2 * encoded - 1, np.ones_like(encoded[..., :1], bool)
    written = encoded[..., :1] != 0
    velocity = (encoded - np.float32(VELOCITY_ZERO)) / np.float32(VELOCITY_RANGE)
    if encoding == "unreal5":
        velocity = 0.5 * velocity * np.abs(velocity)
    return velocity * written, written


def unpack(stored: np.ndarray, components: int, low: int, high: int) -> np.ndarray:
    """Numbers in [0, 1] that were packed into bytes: ``(b0 + b1 / D + b2 / D^2 + ...) / D'``.

    Of two bytes, D = 256 and D' = 255 stand for 16 bits over 255.996; 255 and 255 is what a shader writes that splits a
    number into its first byte and the rest; 256 and 256 is fixed point, of four bytes 32 bits.

    Args:
      stored: ``[H, W, components * n]`` uint8, the n bytes of a component one after the other, high byte first.
      components: numbers per pixel.
      low: D.
      high: D'.
    """
    each = stored.reshape(*stored.shape[:2], components, -1).astype(np.float64)
    weights = 1.0 / (high * float(low) ** np.arange(each.shape[-1]))
    return (each @ weights).astype(np.float32)


def to_pixels(
    vectors: np.ndarray, unit: str, width: int, height: int, *, x: str = "right", y: str = "down"
) -> np.ndarray:
    """Vectors (motion or jitter, ``[..., 2]``) to pixels, x right, y down.

    Args:
      vectors: (x, y).
      unit: "pixels"; "uv", of the image's width and height; "ndc", of half of them.
      width: of the image.
      height: of the image.
      x: where a positive x points, "right" or "left".
      y: where a positive y points, "down" or "up".
    """
    size = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (0.5 * width, 0.5 * height)}[unit]
    signs = (1.0 if x == "right" else -1.0, 1.0 if y == "down" else -1.0)
    return vectors * np.asarray([size[0] * signs[0], size[1] * signs[1]], np.float32)


def to_previous(motion: np.ndarray, sign: str) -> np.ndarray:
    """Motion such that ``previous = current + motion``; ``sign`` names the difference that was stored."""
    return motion if sign == "previous-current" else -motion


def without_jitter(motion: np.ndarray, jitter: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """Motion of the scene from that between two jittered images, which is ``motion + jitter - previous jitter``."""
    return motion - (jitter - previous).astype(np.float32)


def sample_offset(jitter: np.ndarray, sign: str) -> np.ndarray:
    """Where the samples lie, from a jitter in pixels: "sample" is that offset, "image" is how far the image moved."""
    return jitter if sign == "sample" else -jitter


def linear_depth(stored: np.ndarray, kind: str, near: float, far: float) -> np.ndarray:
    """View-space z from a depth buffer, in the unit of ``near``; +inf where the buffer was cleared.

    Args:
      stored: ``[H, W, 1]``.
      kind: "linear" (view-space z already); "reversed" (near plane 1, far plane 0); "forward" (0 and 1).
      near: distance of the near plane.
      far: distance of the far plane; may be infinite.
    """
    if kind == "linear":
        return stored
    reverse = stored if kind == "reversed" else 1.0 - stored
    cleared = reverse <= 0
    # z = near far / (near + d (far - near)), divided by far so that far may be infinite.
    inverse_far = 0.0 if np.isinf(far) else 1.0 / far
    denominator = near * inverse_far + np.where(cleared, 1.0, reverse) * (1.0 - near * inverse_far)
    return np.where(cleared, np.inf, near / denominator).astype(np.float32)


def depth_from_distance(distance: np.ndarray, focal: np.ndarray, center: np.ndarray, jitter: np.ndarray) -> np.ndarray:
    """View-space z from the distance along each pixel's ray.

    Args:
      distance: ``[H, W, 1]``.
      focal: ``[2]`` pixels.
      center: ``[2]`` principal point, pixels.
      jitter: ``[2]`` pixels: the ray goes through pixel centre + jitter.
    """
    height, width = distance.shape[:2]
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5 + jitter[0] - center[0])) / np.float32(focal[0])
    y = (np.arange(height, dtype=np.float32) + np.float32(0.5 + jitter[1] - center[1])) / np.float32(focal[1])
    return distance / np.sqrt(1.0 + x[None, :, None] ** 2 + y[:, None, None] ** 2)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Invert the sRGB curve; values above 1 follow the same power law."""
    encoded = np.maximum(encoded, 0.0)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def unit_normals(stored: np.ndarray, encoding: str) -> np.ndarray:
    """Scale normals to unit length; zero where the stored one has no length.

    Args:
      stored: ``[H, W, 3]``.
      encoding: "signed", in [-1, 1], or "unsigned", in [0, 1] with 0.5 for 0.
    """
    vectors = stored if encoding == "signed" else 2.0 * stored - 1.0
    length = np.sqrt(np.square(vectors).sum(-1, keepdims=True))
    return np.where(length > SHORT_NORMAL, vectors / np.maximum(length, SHORT_NORMAL), 0.0).astype(np.float32)


def at_samples(image: np.ndarray, width: int, height: int, jitter: np.ndarray) -> np.ndarray:
    """Read an image that is larger than the frame at the pixel that each sample of the frame lies in.

    Args:
      image: ``[H', W', C]`` of the same view; averaging would mix surfaces.
      width: of the frame.
      height: of the frame.
      jitter: ``[2]`` pixels of the frame: the sample lies at pixel centre + jitter.
    """
    if image.shape[:2] == (height, width):
        return image
    x, y = (np.arange(size) + 0.5 + offset for size, offset in zip((width, height), jitter, strict=True))
    columns, rows = (
        np.clip((p * (large / len(p))).astype(int), 0, large - 1)
        for p, large in ((x, image.shape[1]), (y, image.shape[0]))
    )
    return image[rows[:, None], columns[None]]


def radical_inverse(index: int, base: int) -> float:
    """Mirror the digits of ``index`` at the point: element ``index`` of the Halton sequence of ``base``."""
    if index < 0:
        raise ValueError(f"Halton: expected an element >= 0, got {index}.")
    value, weight = 0.0, 1.0 / base
    while index:
        index, digit = divmod(index, base)
        value, weight = value + digit * weight, weight / base
    return value


def halton(index: int) -> np.ndarray:
    """Halton (2, 3) jitter ``[2]`` in [-0.5, 0.5): element ``index``, counted from 1 as renderers do."""
    return np.asarray([radical_inverse(index, 2) - 0.5, radical_inverse(index, 3) - 0.5], np.float32)
