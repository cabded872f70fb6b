"""The renderer's input: one instant of a scene as arrays, and the layout of its tables.

Every primitive is a unit shape under an affine transform: the square z = 0, the cube, the sphere and the capped
cylinder along z, all inside [-1, 1]^3. A table row holds one primitive. The four kinds occupy fixed
ranges of rows, of which the first ``counts[kind]`` are used: counts are data, so one compilation renders every scene.
"""

import jax.numpy as jnp
import numpy as np

from essjax.typing import Array, Float, Int, pytree

RECT, BOX, SPHERE, ROD = range(4)
CAPACITY = (16, 48, 24, 64)
"""Most primitives of each kind."""
OFFSET = (0, 16, 64, 88)
"""First row of each kind."""
ROWS = 152
ROW_KIND = np.repeat(np.arange(4), CAPACITY)
"""Kind of each row."""
ROW_MEMBER = np.concatenate([np.arange(count) for count in CAPACITY])
"""Number of each row within its kind."""
LIGHTS = 2
"""Most lights that cast shadows."""

COLUMNS = (
    "kind", "id", "half_x", "half_y", "half_z",
    "a_r", "a_g", "a_b", "b_r", "b_g", "b_b",
    "pattern", "frequency", "aspect", "shift", "gap", "seed", "variation", "grime", "grime_frequency", "bump",
    "roughness_a", "roughness_b", "metallic", "specular", "emission_a", "emission_b", "mirror",
)  # fmt: skip
"""Columns of ``World.materials``; what they mean stands in ``materials.Material``."""
COLUMN = {name: index for index, name in enumerate(COLUMNS)}


@pytree
class World:
    """One instant of a scene. Metres; y is up; camera as in ``essjax.cameras``.

    Attributes:
      to_local: ``[P, 12]`` rows of the 3x4 matrix from world to the unit shape, per primitive.
      to_world: ``[P, 12]`` its inverse.
      materials: ``[P, M]`` see ``COLUMNS``.
      counts: ``[4]`` primitives in use of each kind.
      lights: ``[2, 7]`` direction to the light (unit) or position; 1 if it is a position, else 0; radiance r, g, b.
      light_count: ``[]``.
      camera_to_world: ``[4, 4]``.
      focal: ``[]`` focal length as a fraction of the image width.
      sky: zenith, horizon and ground colour, sun direction, sun radiance (3 each), sun size (1 - cosine), cloud
        amount, cloud frequency, ambient strength: ``[19]``.
      bounces: ``[]`` mirror bounces, 0 or 1.
    """

    to_local: Float[Array, "P 12"]
    to_world: Float[Array, "P 12"]
    materials: Float[Array, "P M"]
    counts: Int[Array, "4"]
    lights: Float[Array, "2 7"]
    light_count: Int[Array, ""]
    camera_to_world: Float[Array, "4 4"]
    focal: Float[Array, ""]
    sky: Float[Array, "19"]
    bounces: Int[Array, ""]


def columns(table: Float[Array, "P K"], rows: Int[Array, "N"]) -> Float[Array, "K N"]:
    """Table rows, one per ray, planar: a single gather, so a single kernel. Row -1 reads some row."""
    return jnp.take(table.T, rows, axis=1, mode="clip")


def material_columns(world: World, rows: Int[Array, "N"]) -> dict[str, Float[Array, "N"]]:
    """All material parameters of each ray, by name."""
    planar = columns(world.materials, rows)
    return {name: planar[index] for index, name in enumerate(COLUMNS)}
