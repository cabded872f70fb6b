"""Scene descriptions: NumPy arrays of transforms, lights and cameras over time, from a seed."""

import dataclasses

import numpy as np

from essjax.scenes.materials import Material
from essjax.scenes.world import BOX, CAPACITY, COLUMN, COLUMNS, LIGHTS, OFFSET, RECT, ROD, ROWS, SPHERE, World

KIND_NAMES = ("rects", "boxes", "spheres", "rods")
PACE = 0.5
"""Time that passes per frame; the families' speeds are per unit of time. Chosen so that the median pixel moves by about
1 % of the image width per frame, as in fast play at 60 Hz; see experiments/LOG.md."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """An animated scene of a number of frames. Make one with ``families.make_scene``.

    Attributes:
      family: its family's name.
      seed: equal family, seed and number of frames give an equal scene.
      frames: how many.
      worlds: a ``World`` of NumPy arrays; animated leaves carry a leading time axis, see ``at``.
      cut: bool ``[T]``, true at frame 0 and where the camera jumps.
      unit: what rendered radiance is multiplied with; its inverse is recorded as exposure.
    """

    family: str
    seed: int
    frames: int
    worlds: World
    cut: np.ndarray
    unit: float = 1.0

    def at(self, index: int) -> World:
        """Return the world of frame ``index``."""
        if not 0 <= index < self.frames:
            raise ValueError(f"frame: expected 0 <= frame < {self.frames}, got {index}. Make a longer scene.")
        animated = ("to_local", "to_world", "lights", "camera_to_world", "focal")
        changes = {name: getattr(self.worlds, name)[index] for name in animated}
        return dataclasses.replace(self.worlds, **changes)

    def before(self, index: int) -> World:
        """Return the world one frame earlier; at a cut, the same one."""
        return self.at(index if self.cut[index] else index - 1)


def rotation(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """Rotation matrices ``[..., 3, 3]`` about "x", "y" or "z" by ``angle`` (radians)."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.zeros((*np.shape(angle), 3, 3))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    k = 3 - i - j
    matrix[..., k, k] = 1.0
    matrix[..., i, i], matrix[..., i, j], matrix[..., j, i], matrix[..., j, j] = c, -s, s, c
    return matrix


FLOOR = rotation("x", -np.pi / 2)
"""Turns the unit square's normal (+z) up (+y)."""


def look_at(eye: np.ndarray, target: np.ndarray, roll: np.ndarray | float = 0.0) -> np.ndarray:
    """``camera_to_world`` ``[..., 4, 4]`` at ``eye`` with -Z towards ``target`` and +Y up, both ``[..., 3]``."""
    back = eye - target
    back = back / np.linalg.norm(back, axis=-1, keepdims=True)
    right = np.cross(np.array([0.0, 1.0, 0.0]), back)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(back, right)
    matrix = np.zeros((*eye.shape[:-1], 4, 4))
    matrix[..., :3, :3] = np.stack([right, up, back], axis=-1) @ rotation("z", roll)
    matrix[..., :3, 3], matrix[..., 3, 3] = eye, 1.0
    return matrix


def between(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre, rotation and half length of a rod from ``start`` to ``end`` (``[3]`` each)."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    axis = end - start
    length = float(np.linalg.norm(axis))
    z = axis / length
    helper = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return 0.5 * (start + end), np.stack([x, np.cross(z, x), z], axis=-1), 0.5 * length


class Builder:
    """Collects primitives, lights, sky and camera of a scene of ``frames`` frames.

    ``time`` ``[T]`` is what animations are functions of. Positions are ``[3]`` or ``[T, 3]`` metres, rotations
    ``[3, 3]`` or ``[T, 3, 3]``. Whatever is given a time axis gets an id of its own in the stencil; the rest is static,
    id 0.
    """

    def __init__(self, frames: int, rng: np.random.Generator):
        self.frames, self.rng = frames, rng
        self.time = PACE * np.arange(frames)
        self.ids = 0
        self.rows: list[list[tuple]] = [[], [], [], []]
        self.lights: list[tuple] = []
        self.cut = np.arange(frames) == 0
        self.bounces = 0
        self.set_sky()

    def new_id(self) -> int:
        """Return a new stencil id for an object of several primitives."""
        self.ids += 1
        return self.ids

    def add(self, kind: int, material: Material, position, half, turn=None, object_id: int | None = None) -> None:
        """Add one primitive: ``half`` extents ``[3]`` in its own axes, turned by ``turn``, moved to ``position``."""
        if len(self.rows[kind]) >= CAPACITY[kind]:
            raise ValueError(f"scene: at most {CAPACITY[kind]} {KIND_NAMES[kind]}, tried to add one more.")
        position, half = np.asarray(position, float), np.asarray(half, float)
        turn = np.eye(3) if turn is None else np.asarray(turn, float)
        if object_id is None:
            object_id = self.new_id() if position.ndim == 2 or turn.ndim == 3 else 0
        columns = material.columns() | {
            "kind": kind, "id": object_id, "half_x": half[0], "half_y": half[1], "half_z": half[2],
            "seed": int(self.rng.integers(1 << 16)),
        }  # fmt: skip
        position = np.broadcast_to(position, (self.frames, 3))
        turn = np.broadcast_to(turn, (self.frames, 3, 3))
        to_world = np.concatenate([turn * half, position[..., None]], axis=-1)
        inverse = np.swapaxes(turn, -1, -2) / half[:, None]
        to_local = np.concatenate([inverse, -(inverse @ position[..., None])], axis=-1)
        self.rows[kind].append((to_local.reshape(-1, 12), to_world.reshape(-1, 12), columns))

    def rect(self, material: Material, position, half_u: float, half_v: float, turn=None) -> None:
        """Add a rectangle in the x, y plane of ``turn``."""
        self.add(RECT, material, position, (half_u, half_v, 1.0), turn)

    def box(self, material: Material, position, half, turn=None, object_id: int | None = None) -> None:
        """Add an oriented box; seen from inside it is a room."""
        self.add(BOX, material, position, half, turn, object_id)

    def sphere(self, material: Material, position, radius, turn=None, object_id: int | None = None) -> None:
        """Add a sphere, or an ellipsoid where ``radius`` is ``[3]``."""
        self.add(SPHERE, material, position, np.broadcast_to(radius, 3), turn, object_id)

    def rod(self, material: Material, position, radius: float, half_length: float, turn=None, object_id=None) -> None:
        """Add a capped cylinder along the z axis of ``turn``."""
        self.add(ROD, material, position, (radius, radius, half_length), turn, object_id)

    def bar(self, material: Material, start, end, radius: float) -> None:
        """Add a static rod from ``start`` to ``end``."""
        position, turn, half_length = between(start, end)
        self.rod(material, position, radius, half_length, turn)

    def sun(self, direction, color) -> None:
        """Add a light infinitely far away in ``direction`` ``[3]`` or ``[T, 3]``; ``color`` is its irradiance."""
        direction = np.asarray(direction, float)
        self._light(direction / np.linalg.norm(direction, axis=-1, keepdims=True), 0.0, color)

    def lamp(self, position, color) -> None:
        """Add a point light; ``color`` is its irradiance at one metre."""
        self._light(np.asarray(position, float), 1.0, color)

    def _light(self, place: np.ndarray, is_point: float, color) -> None:
        if len(self.lights) >= LIGHTS:
            raise ValueError(f"scene: at most {LIGHTS} lights, tried to add one more.")
        self.lights.append((np.broadcast_to(place, (self.frames, 3)), is_point, np.asarray(color, float)))

    def set_sky(
        self,
        zenith=(0.25, 0.45, 0.9),
        horizon=(0.8, 0.9, 1.0),
        ground=(0.25, 0.22, 0.2),
        sun_direction=(0.3, 0.6, 0.5),
        sun_color=(0.0, 0.0, 0.0),
        sun_size=0.002,
        clouds=0.5,
        cloud_frequency=3.0,
        ambient=0.6,
    ) -> None:
        """Set what rays see that hit nothing, and the ambient light that follows from it; see ``World.sky``."""
        sun = np.asarray(sun_direction, float)
        sun = sun / np.linalg.norm(sun)
        parts = (zenith, horizon, ground, sun, sun_color, (sun_size, clouds, cloud_frequency, ambient))
        self.sky = np.concatenate([np.asarray(part, float) for part in parts])

    def set_camera(self, eye, target, *, focal: float | np.ndarray = 0.9, roll: float | np.ndarray = 0.0) -> None:
        """Camera path ``[T, 3]`` and what it looks at; ``focal`` as a fraction of the image width."""
        eye, target = (np.broadcast_to(np.asarray(v, float), (self.frames, 3)) for v in (eye, target))
        self.camera = look_at(eye, target, roll)
        self.focal = np.broadcast_to(np.asarray(focal, float), (self.frames,))

    def build(self, family: str, seed: int, *, unit: float = 1.0) -> Scene:
        """Return the finished scene; ``unit`` as in ``Scene``."""
        to_local, to_world = np.zeros((2, self.frames, ROWS, 12))
        to_local[..., 3::4] = 9.0  # unused rows: a degenerate transform outside every shape, which no ray hits
        materials = np.zeros((ROWS, len(COLUMNS)))
        for kind, rows in enumerate(self.rows):
            for index, (local, world, columns) in enumerate(rows):
                row = OFFSET[kind] + index
                to_local[:, row], to_world[:, row] = local, world
                for name, value in columns.items():
                    materials[row, COLUMN[name]] = value
        lights = np.zeros((self.frames, LIGHTS, 7))
        lights[..., 1] = 1.0
        for index, (place, is_point, color) in enumerate(self.lights):
            lights[:, index, :3], lights[:, index, 3], lights[:, index, 4:] = place, is_point, color
        single = lambda array: np.asarray(array, np.float32)
        whole = lambda array: np.asarray(array, np.int32)
        worlds = World(
            to_local=single(to_local), to_world=single(to_world), materials=single(materials),
            counts=whole([len(rows) for rows in self.rows]), lights=single(lights), light_count=whole(len(self.lights)),
            camera_to_world=single(self.camera), focal=single(self.focal), sky=single(self.sky),
            bounces=whole(self.bounces),
        )  # fmt: skip
        return Scene(family=family, seed=seed, frames=self.frames, worlds=worlds, cut=self.cut, unit=unit)
