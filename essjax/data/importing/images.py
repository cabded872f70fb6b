"""The images of one frame of a dump: read from its files, brought into essjax's conventions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data import exr
from essjax.data.importing import convert
from essjax.data.importing.facts import FrameFacts
from essjax.data.importing.recipe import Recipe

UNIT_RANGE = ("base_color", "roughness", "metallic", "specular", "n_dot_v", "reactive")


def read_images(
    wanted: Mapping[str, tuple[Path, tuple[str, ...]]],
) -> tuple[dict[str, np.ndarray], Mapping[str, Any]]:
    """``[H, W, C]`` float32 images of one size, each file read once, and the header of the first file.

    Args:
      wanted: image -> its file and channel names.

    Raises:
      ValueError: names the file and the channel.
    """
    by_path: dict[Path, list[str]] = {}
    for image, (path, _) in wanted.items():
        by_path.setdefault(path, []).append(image)
    images, headers, size = {}, [], None
    for path, names in by_path.items():
        planes, header = exr.read_all(path, [channel for name in names for channel in wanted[name][1]])
        headers.append(header)
        for name in names:
            for channel in wanted[name][1]:
                size = planes[channel].shape if size is None else size
                if planes[channel].shape != size:
                    (high, wide), (h, w) = size, planes[channel].shape
                    raise ValueError(f"{path}, channel {channel}: expected {wide}x{high} as the others, got {w}x{h}.")
            images[name] = _stacked([planes[channel] for channel in wanted[name][1]])
    return {name: images[name] for name in wanted}, headers[0]


def _stacked(planes: list[np.ndarray]) -> np.ndarray:
    """``[H, W, C]`` float32 over planes that stay contiguous: files hold planes, so nothing is interleaved and back."""
    image = np.empty((len(planes), *planes[0].shape), np.float32)
    for index, plane in enumerate(planes):
        image[index] = plane
    return np.moveaxis(image, 0, -1)


def radiance(stored: np.ndarray, recipe: Recipe, facts: FrameFacts) -> tuple[np.ndarray, dict[str, int]]:
    """Linear scene radiance >= 0, and how many negative and infinite values there were."""
    color = convert.srgb_to_linear(stored) if recipe.color.encoding == "srgb" else stored
    if recipe.color.pre_exposed:
        color = color / np.float32(facts.exposure)
    counts = {"negative": int(np.count_nonzero(stored < 0)), "infinite": int(np.count_nonzero(stored == np.inf))}
    return np.clip(color, 0.0, exr.HALF_MAX), counts


def view_depth(stored: np.ndarray, recipe: Recipe, facts: FrameFacts, jitter: np.ndarray) -> np.ndarray:
    """View-space z in metres, +inf on the background; a ValueError says what it needs and does not have."""
    rule = recipe.depth
    kind = facts.depth_kind or "" if rule.kind == "metadata" else rule.kind
    if not kind:
        raise ValueError("depth.kind is metadata, which does not say it. Give [depth] kind.")
    if kind == "distance":
        if facts.camera is None:
            raise ValueError("depth.kind is distance: that needs the camera of each frame ([files] metadata).")
        depth = convert.depth_from_distance(stored, facts.camera.focal, facts.camera.center, jitter)  # type: ignore[arg-type]
    else:
        near = rule.near if facts.near is None else facts.near
        if near is None and kind != "linear":
            raise ValueError(f"depth.kind is {kind}: that needs the near plane. Give [depth] near.")
        far = rule.far if facts.far is None else facts.far
        depth = convert.linear_depth(stored, kind, near or 1.0, far)
    depth = depth * np.float32(rule.scale)
    return np.where(depth >= rule.background, np.float32(np.inf), depth)


def buffer(name: str, stored: np.ndarray, hit: np.ndarray, recipe: Recipe) -> np.ndarray:
    """An optional G-buffer: its range, its encoding, 0 on the background."""
    if name in UNIT_RANGE:
        linear = name == "base_color" and recipe.base_color.encoding == "srgb"
        image = np.clip(convert.srgb_to_linear(stored) if linear else stored, 0.0, 1.0)
        return image if name == "reactive" else np.where(hit, image, np.float32(0.0))
    if name == "stencil":
        return np.where(hit, np.rint(stored), 0.0).astype(np.int32)
    image = convert.unit_normals(stored, recipe.normal.encoding) if name == "normal" else stored * recipe.world.scale
    if recipe.world.handedness == "left":
        image = image * np.asarray([1.0, -1.0, 1.0], np.float32)
    return np.where(hit, image, np.float32(0.0)).astype(np.float32)
