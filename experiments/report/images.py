"""Pixels of the report: display transform, maps of what is wrong, encoding, and where to look."""

import base64
import io

import jax.numpy as jnp
import numpy as np
from PIL import Image, features

from essjax.color import display

ERROR_GAIN = 4.0
"""How much error maps are amplified unless the reader says otherwise."""

FLICKER_GAIN = 4.0
"""Flicker maps are stored as ``min(1, FLICKER_GAIN * |flicker|)`` in 8 bits."""

# From black over violet and orange to pale yellow: lightness rises evenly, so that it also reads in grey.
_STOPS = np.array([
    [2, 2, 12], [34, 11, 76], [87, 16, 110], [142, 36, 103], [195, 60, 78], [236, 104, 41], [251, 162, 29],
    [252, 255, 178],
])  # fmt: skip


def color_map() -> np.ndarray:
    """Make the look-up table of error maps, uint8 ``[256, 3]``."""
    position = np.linspace(0, len(_STOPS) - 1, 256)
    return np.stack([np.interp(position, np.arange(len(_STOPS)), _STOPS[:, c]) for c in range(3)], axis=-1).astype(
        np.uint8
    )


def shown(image: np.ndarray) -> np.ndarray:
    """Linear HDR ``[H, W, 3]`` as a viewer sees it, float32 in [0, 1]; NaN becomes black, infinity white."""
    image = np.nan_to_num(np.asarray(image, np.float32), nan=0.0, posinf=1e6, neginf=0.0)
    return np.clip(np.asarray(display(jnp.asarray(image))), 0.0, 1.0)


def resize_nearest(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """``[H, W, ...]`` at another size, each pixel the nearest one."""
    if image.shape[:2] == (height, width):
        return image
    rows = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(int)
    return image[rows][:, columns]


def error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Mean absolute difference over the channels ``[H, W]`` of shown images, at the reference's size."""
    return np.abs(resize_nearest(image, *reference.shape[:2]) - reference).mean(axis=-1)


def flicker(now: np.ndarray, before: np.ndarray, reference: np.ndarray, reference_before: np.ndarray) -> np.ndarray:
    """Compute ``|(I_t - I_t-1) - (R_t - R_t-1)|`` ``[H, W]`` of shown images: change that the reference lacks."""
    change = resize_nearest(now - before, *reference.shape[:2])
    return np.abs(change - (reference - reference_before)).mean(axis=-1)


def colored(values: np.ndarray, gain: float) -> np.ndarray:
    """Show a map ``[H, W]`` in colours, uint8 ``[H, W, 3]``; ``1 / gain`` and more is the brightest."""
    return color_map()[(np.clip(values * gain, 0.0, 1.0) * 255).astype(np.uint8)]


def data_uri(pixels: np.ndarray) -> str:
    """Lossless picture (uint8 ``[H, W]`` or ``[H, W, 3]``) inside a URI: WebP, or PNG where Pillow lacks WebP."""
    buffer = io.BytesIO()
    kind = "webp" if features.check("webp") else "png"
    options = {"lossless": True, "method": 4} if kind == "webp" else {"optimize": True}
    Image.fromarray(pixels).save(buffer, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def to_bytes(image: np.ndarray) -> np.ndarray:
    """[0, 1] to uint8, rounded."""
    return (np.clip(image, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)


def crop_size(height: int, width: int) -> tuple[int, int]:
    """Height and width of the magnified crop for an image of this size, in its pixels (4:3, about a sixth as wide)."""
    wide = min(max(width // 6, 24), width)
    return min(max(wide * 3 // 4, 1), height), wide


def focus(images: list[np.ndarray]) -> tuple[int, int]:
    """Where the methods disagree most: (x, y) of the crop's top left corner.

    Args:
      images: shown images of one size ``[H, W, 3]``; the reference belongs among them.
    """
    height, width = images[0].shape[:2]
    disagreement = np.std(np.stack(images), axis=0).mean(axis=-1)
    high, wide = crop_size(height, width)
    total = np.pad(disagreement, ((1, 0), (1, 0))).cumsum(0).cumsum(1)  # summed-area table
    sums = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
    y, x = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return int(x), int(y)
