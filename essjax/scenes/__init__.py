"""The built-in renderer: seeded, procedural, animated scenes with exact buffers, in JAX.

``make_scene(family, seed, frames)`` describes a scene in NumPy; ``render_sequence`` renders it with jitted functions on
whatever device JAX uses. Conventions are the library's (``essjax.frames``); y is up in the world, metres.
"""

from essjax.scenes.builder import Scene
from essjax.scenes.families import (
    EXTRA_FAMILIES,
    FAMILIES,
    SPLITS,
    TEST_ONLY_FAMILIES,
    TRAIN_FAMILIES,
    families_of,
    make_scene,
    split_seeds,
)
from essjax.scenes.jitter import jitter_sequence
from essjax.scenes.sequence import Rendering, iterate_frames, render_frame, render_sequence

__all__ = [
    "EXTRA_FAMILIES", "FAMILIES", "Rendering", "SPLITS", "Scene", "TEST_ONLY_FAMILIES", "TRAIN_FAMILIES",
    "families_of", "iterate_frames", "jitter_sequence", "make_scene", "render_frame", "render_sequence", "split_seeds",
]  # fmt: skip
