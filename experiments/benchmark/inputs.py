"""Frames to time methods on, of any size, no renderer needed: edges, smooth and still motion, as rendered ones have."""

import dataclasses

import jax
import numpy as np

from essjax.frames import Frame, example_frame
from essjax.typing import PyTree

MOTION = 6.0
"""Largest motion, pixels."""


def waves(width: int, height: int, channels: int, seed: int, *, edges: bool = True) -> np.ndarray:
    """Smooth images with hard edges ``[H, W, C]`` in [0, 1]: neighbouring pixels are alike, as rendered ones are."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(np.float32) / height
    a, b, phase = rng.uniform(2.0, 20.0, (3, channels)).astype(np.float32)
    image = 0.4 + 0.4 * np.sin(a * x[..., None] + b * y[..., None] + phase)
    if edges:
        image = image + 0.2 * ((np.floor(9.0 * x) + np.floor(7.0 * y)) % 2)[..., None]
    return image.astype(np.float32)


def motion(width: int, height: int, seed: int) -> np.ndarray:
    """Smooth motion ``[H, W, 2]`` up to ``MOTION`` pixels, another one left and right of an edge."""
    field = MOTION * (2.0 * waves(width, height, 2, seed, edges=False) - 0.8)
    field[:, width // 3 :] *= -0.5
    return field.astype(np.float32)


def frame(width: int, height: int, seed: int = 0) -> Frame:
    """One frame with every buffer, leaves ``[1, H, W, C]``."""
    shapes, tree = jax.tree_util.tree_flatten_with_path(example_frame(width, height))
    return jax.tree.unflatten(tree, [_leaf(path[-1].name, leaf, seed + n) for n, (path, leaf) in enumerate(shapes)])


def _leaf(name: str, leaf: jax.ShapeDtypeStruct, seed: int) -> np.ndarray:
    if name == "jitter":
        return np.array([[0.25, -0.125]], np.float32) * (-1) ** (seed // 100)
    if name == "cut":
        return np.zeros(leaf.shape, bool)
    if name == "exposure":
        return np.ones(leaf.shape, np.float32)
    _, height, width, channels = leaf.shape
    if name == "motion":
        return motion(width, height, seed)[None]
    image = waves(width, height, channels, seed)
    if name == "stencil":
        image = np.floor(3.0 * image)
    if name == "normal":
        image = image / np.linalg.norm(image, axis=-1, keepdims=True)
    return (1.0 + 9.0 * image if name == "depth" else image).astype(leaf.dtype)[None]


def frames(count: int, width: int, height: int) -> list[Frame]:
    """Different frames; the first follows a cut."""
    made = [frame(width, height, 100 * n) for n in range(count)]
    made[0] = dataclasses.replace(made[0], cut=np.ones(1, bool))
    return made


def random_like(shapes: PyTree, seed: int = 0) -> PyTree:
    """Draw normal noise for each ``jax.ShapeDtypeStruct``."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: rng.standard_normal(leaf.shape, np.float32).astype(leaf.dtype), shapes)
