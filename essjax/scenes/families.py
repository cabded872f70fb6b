"""The families of scenes: what they are called, what each shows, and which seeds belong to which split."""

import zlib

import numpy as np

from essjax.scenes._rigging import rigging
from essjax.scenes.builder import Builder, Scene
from essjax.scenes.indoor import carousel, corridor, gloss
from essjax.scenes.outdoor import cuts, grille, plaza, shadows, texture

TRAIN_FAMILIES = ("corridor", "carousel", "grille", "gloss", "shadows", "texture")
"""Families in every split: fast camera and large disocclusions; rigid and rotating objects; thin rods; mirror images in
glossy floors; moving lights with hard shadows; high-frequency textures."""
TEST_ONLY_FAMILIES = ("plaza", "cuts")
"""Families in the test split only: sun, glowing signs and metal under an open sky; a camera that cuts."""
FAMILIES = TRAIN_FAMILIES + TEST_ONLY_FAMILIES
"""The families of the standard splits: their mean is what tables show, so it stays as it is."""
EXTRA_FAMILIES = ("rigging",)
"""Hard cases in no split, for the seeds of the test split, rendered only when asked for by name: ropes and railings
thinner than a pixel before a plain sky, over a mirror."""
SPLITS = ("train", "validation", "test")

_MAKERS = {
    "corridor": corridor, "carousel": carousel, "grille": grille, "gloss": gloss, "shadows": shadows,
    "texture": texture, "plaza": plaza, "cuts": cuts, "rigging": rigging,
}  # fmt: skip


def make_scene(family: str, seed: int, frames: int) -> Scene:
    """Make the scene of a family that belongs to ``seed``, animated over ``frames`` frames.

    The first n frames do not depend on ``frames``.

    Raises:
      ValueError: unknown family, negative seed or no frames.
    """
    if family not in _MAKERS:
        raise ValueError(f"family: expected one of {', '.join(_MAKERS)}, got {family!r}.")
    if seed < 0 or frames < 1:
        raise ValueError(f"scene: expected seed >= 0 and frames >= 1, got seed {seed} and {frames} frames.")
    rng = np.random.default_rng([zlib.crc32(family.encode()), seed])
    builder = Builder(frames, rng)
    _MAKERS[family](builder)
    return builder.build(family, seed, unit=radiance_unit(family, seed))


def radiance_unit(family: str, seed: int) -> float:
    """Draw a scene's unit of radiance, one of the powers of two over nearly four decades (1/128 to 64).

    Other renderers have other units: what depends on it shows on built-in scenes, too. A power of two rounds nothing,
    so pictures and scores are those of unit 1, and half precision holds all of them.
    """
    rng = np.random.default_rng([zlib.crc32(f"unit of {family}".encode()), seed])
    return 2.0 ** int(rng.integers(-7, 7))


def families_of(split: str) -> tuple[str, ...]:
    """List the families of a split: ``FAMILIES`` in "test", ``TRAIN_FAMILIES`` in "train" and "validation"."""
    if split not in SPLITS:
        raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got {split!r}.")
    return FAMILIES if split == "test" else TRAIN_FAMILIES


def split_seeds(split: str, count: int, *, start: int = 0) -> list[int]:
    """``count`` seeds of a split, from its ``start``-th. Splits are disjoint: a seed modulo 3 is its split.

    Raises:
      ValueError: unknown split.
    """
    families_of(split)
    return [3 * k + SPLITS.index(split) for k in range(start, start + count)]
