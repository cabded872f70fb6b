"""The images of one frame of a dump: read from its files, brought into essjax's conventions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from essjax.buffers import BUFFERS, UNIT_RANGE
from essjax.data import exr
from essjax.data.importing import convert
from essjax.data.importing.facts import FrameFacts
from essjax.data.importing.planes import read_planes
from essjax.data.importing.primaries import to_rec709
from essjax.data.importing.recipe import Recipe

COLORS = ("color", "reference", "base_color")
"""Images whose channels are amounts of primaries."""
ISOLATED = 0.01
"""Share of an image's pixels up to which bad ones are mended."""
LARGEST_ID = 2**31 - 1
"""Ids are int32."""
TOLERANCE, BEYOND = 1e-3, 0.05
"""By which values may leave [0, 1] without being counted (half precision), and without being odd (denoisers)."""
FEW = 0.05
"""Share of the pixels that may be odd."""
OFF_LENGTH, ENOUGH = 0.1, 100
"""By how much half of the normals may miss unit length, if there are so many: silhouettes mix shorter ones."""


class Stored(NamedTuple):
    """Where an image is stored.

    Attributes:
      path: of the file.
      channels: names there.
      frame: index along the first axis, of files that hold all frames; or None.
    """

    path: Path
    channels: tuple[str, ...]
    frame: int | None = None


def read_images(
    wanted: Mapping[str, Stored], packings: Mapping[str, tuple[int, int]] | None = None
) -> tuple[dict[str, np.ndarray], Mapping[str, Any]]:
    """``[H, W, C]`` float32 images, each file read once, and the header of the first file.

    Integers of 8 and 16 bits become fractions of 255 and 65535, packed ones what they stand for. Colours become Rec.
    709 where a header states other primaries. The stencil is float64, which holds every id of 32 bits, as it is stored.

    Args:
      wanted: image -> where it is. The first one says which size the frame has; others have it, or a larger one.
      packings: images that are packed into bytes -> D and D' of ``convert.unpack``.

    Raises:
      ValueError: names the file and the channel.
    """
    by_file: dict[tuple[Path, int | None], list[str]] = {}
    for image, (path, _, frame) in wanted.items():
        by_file.setdefault((path, frame), []).append(image)
    images, headers, size = {}, [], None
    for (path, frame), names in by_file.items():
        planes, header = read_planes(path, [channel for name in names for channel in wanted[name].channels], frame)
        headers.append(header)
        matrix = to_rec709(header, str(path))
        for name in names:
            mine = [planes[channel] for channel in wanted[name].channels]
            size = mine[0].shape if size is None else size
            for channel, plane in zip(wanted[name].channels, mine, strict=True):
                _check_size(path, channel, plane.shape, size, mine[0].shape)
            images[name] = _values(path, name, mine, (packings or {}).get(name))
            if matrix is not None and name in COLORS:
                images[name] = np.ascontiguousarray(images[name]) @ matrix.T
    return {name: images[name] for name in wanted}, headers[0]


def _check_size(path: Path, channel: str, got: tuple[int, ...], size: tuple[int, ...], own: tuple[int, ...]) -> None:
    (height, width), (high, wide) = size, got
    same_shape = abs(high * width - wide * height) < max(width, height)  # to the pixel: sizes are rounded
    if got != own or high < height or wide < width or not same_shape:
        raise ValueError(
            f"{path}, channel {channel}: expected {width}x{height} as the others (or larger, with the same ratio of "
            f"its sides), got {wide}x{high}."
        )


def _values(path: Path, name: str, planes: list[np.ndarray], packing: tuple[int, int] | None) -> np.ndarray:
    """``[H, W, C]`` of what planes stand for, see ``read_images``."""
    if packing is not None:
        if planes[0].dtype != np.uint8:
            raise ValueError(
                f"{path}: [{name}] packing: expected bytes, the file holds {planes[0].dtype}. Leave it out."
            )
        return convert.unpack(np.stack(planes, axis=-1), BUFFERS[name].channels, *packing)
    if name == "stencil":
        return _stacked(planes, np.float64)
    image = _stacked(planes, np.float32)
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(planes[0].dtype)
    return image if full is None else image / np.float32(full)


def repair(name: str, image: np.ndarray) -> int:
    """Set single NaN and infinite pixels to the median of their neighbours, in place; returns how many.

    Depth may be +inf. An image of which more than ``ISOLATED`` is bad is left as it is: that is no firefly.
    """
    bad = np.isnan(image) if name == "depth" else ~np.isfinite(image)
    bad = bad.any(axis=-1)
    if not bad.any() or bad.mean() > ISOLATED:
        return 0
    mended = 0
    for row, column in np.argwhere(bad):
        window = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        good = image[window][~bad[window]]
        if len(good):
            image[row, column] = np.median(good, axis=0)
            mended += 1
    return mended


def _stacked(planes: list[np.ndarray], dtype: type[np.floating]) -> np.ndarray:
    """``[H, W, C]`` over planes that stay contiguous: files hold planes, so nothing is interleaved and back."""
    image = np.empty((len(planes), *planes[0].shape), dtype)
    for index, plane in enumerate(planes):
        image[index] = plane
    return np.moveaxis(image, 0, -1)


def radiance(stored: np.ndarray, recipe: Recipe, facts: FrameFacts) -> tuple[np.ndarray, dict[str, int]]:
    """Linear scene radiance >= 0, and how many negative and infinite values there were.

    Finite values beyond half's range stay: ``exr.write`` clamps and counts those.
    """
    color = stored * np.float32(recipe.scale.color)
    color = convert.srgb_to_linear(color) if recipe.color.encoding == "srgb" else color
    if recipe.color.pre_exposed:
        if facts.exposure is None:
            raise ValueError(
                "color.pre_exposed is true, but the metadata has no exposure of this frame. Give it there."
            )
        color = color / np.float32(facts.exposure)
    infinite = color == np.inf
    counts = {"negative": int(np.count_nonzero(stored < 0)), "infinite": int(np.count_nonzero(infinite))}
    return np.maximum(np.where(infinite, np.float32(exr.HALF_MAX), color), 0.0), counts


def view_depth(stored: np.ndarray, recipe: Recipe, facts: FrameFacts, jitter: np.ndarray) -> np.ndarray:
    """View-space z in metres, +inf on the background; a ValueError says what it needs and does not have."""
    rule = recipe.depth
    kind = facts.depth_kind or "" if rule.kind == "metadata" else rule.kind
    if not kind:
        raise ValueError("depth.kind is metadata, which does not say it. Give [depth] kind.")
    background = np.zeros((), bool)
    if kind in ("linear", "distance"):
        background = (np.abs(stored) == exr.HALF_MAX) | (rule.zero_is_background & (stored == 0))
    if kind == "linear":
        depth = stored
    elif kind == "distance":
        if facts.camera is None:
            raise ValueError("depth.kind is distance: that needs the camera of each frame ([files] metadata).")
        depth = convert.depth_from_distance(stored, facts.camera.focal, facts.camera.center, jitter)  # type: ignore[arg-type]
    else:
        near = rule.near if facts.near is None else facts.near
        if near is None:
            raise ValueError(f"depth.kind is {kind}: that needs the near plane. Give [depth] near.")
        far = rule.far if facts.far is None else facts.far
        if not 0 < near < far:
            raise ValueError(f"depth: expected 0 < near < far of the planes, got near {near:g} and far {far:g}.")
        depth = convert.linear_depth(stored, kind, near, far)
    depth = depth * np.float32(rule.scale)
    return np.where(background | (depth >= rule.background), np.float32(np.inf), depth)


def buffer(name: str, stored: np.ndarray, hit: np.ndarray, recipe: Recipe) -> tuple[np.ndarray, int]:
    """Read an optional G-buffer: its range, its encoding, 0 on the background.

    Args:
      name: of the image.
      stored: ``[H, W, C]``.
      hit: bool ``[H, W, 1]``, not background.
      recipe: of the dump.

    Returns:
      The image, and how many values were outside [0, 1] and clipped.

    Raises:
      ValueError: more than a few are outside, or the normals are not of unit length (names the recipe's key), or an id
        is too large.
    """
    if name == "reactive":
        stored = _reactive(stored, recipe.reactive.kind)
    if name in UNIT_RANGE:
        return _unit_range(name, stored, np.ones_like(hit) if name == "reactive" else hit, recipe)
    if name == "stencil":
        ids = np.where(hit, np.rint(stored), 0.0)
        if not (np.abs(ids) <= LARGEST_ID).all():  # also NaN
            worst = ids.ravel()[np.argmax(np.where(np.isnan(ids), np.inf, np.abs(ids)))]
            raise ValueError(f"stencil: expected ids up to {LARGEST_ID}, got {worst:.10g}. Renumber the objects.")
        return ids.astype(np.int32), 0
    if name == "normal":
        _check_normals(stored, hit, recipe)
    image = convert.unit_normals(stored, recipe.normal.encoding) if name == "normal" else stored * recipe.world.scale
    if recipe.world.handedness == "left":
        image = image * np.asarray([1.0, -1.0, 1.0], np.float32)
    return np.where(hit, image, np.float32(0.0)).astype(np.float32), 0


def _unit_range(name: str, stored: np.ndarray, hit: np.ndarray, recipe: Recipe) -> tuple[np.ndarray, int]:
    image = stored * np.float32(getattr(recipe.scale, name))
    excess = np.where(hit, np.maximum(-image, image - 1.0), 0.0)
    outside = int(np.count_nonzero(excess > TOLERANCE))
    share = np.count_nonzero((excess > BEYOND).any(axis=-1)) / max(np.count_nonzero(hit), 1) if outside else 0.0
    if share > FEW:
        values = image[np.broadcast_to(hit, image.shape)]
        raise ValueError(
            f"{name} ({', '.join(recipe.channels[name])}): expected values in [0, 1], found {np.nanmin(values):.4g} to "
            f"{np.nanmax(values):.4g}, outside in {share:.1%} of the pixels. [scale] {name} in the recipe is what they "
            f"are multiplied with (0.0039216 if 255 means 1); or is it another channel ([channels] {name})?"
        )
    curved = name == "base_color" and recipe.base_color.encoding == "srgb"
    image = np.clip(convert.srgb_to_linear(image) if curved else image, 0.0, 1.0)
    return np.where(hit, image, np.float32(0.0)), outside


def _reactive(stored: np.ndarray, kind: str) -> np.ndarray:
    if kind == "radiance":
        return (stored.max(axis=-1, keepdims=True) > 0).astype(np.float32)
    return 1 - stored if kind == "transmittance" else stored


def _check_normals(stored: np.ndarray, hit: np.ndarray, recipe: Recipe) -> None:
    encoding = recipe.normal.encoding
    unknown = np.isnan(stored).any(axis=-1) & hit[..., 0]
    if unknown.any():
        raise ValueError(
            f"normal ({', '.join(recipe.channels['normal'])}): expected vectors, got NaN in "
            f"{np.count_nonzero(unknown)} pixels of surfaces. Write zero vectors where there is none; --repair mends "
            "single pixels."
        )
    vectors = (stored if encoding == "signed" else 2.0 * stored - 1.0)[hit[..., 0]]
    length = np.sqrt(np.square(vectors).sum(-1))
    there = length > convert.SHORT_NORMAL
    if np.count_nonzero(there) < ENOUGH or np.median(np.abs(length[there] - 1.0)) <= OFF_LENGTH:
        return
    other = "unsigned" if encoding == "signed" else "signed"
    says = "none has a negative component" if vectors[there].min() > -OFF_LENGTH else "some components are negative"
    raise ValueError(
        f"normal ({', '.join(recipe.channels['normal'])}): read as {encoding}, their lengths are "
        f"{length[there].min():.2f} to {length[there].max():.2f} instead of 1, and {says}. Is [normal] encoding "
        f"{other}, or is it another channel ([channels] normal)?"
    )
