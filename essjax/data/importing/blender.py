"""``blender``: a folder with ``meta.json`` and, per frame, ``lr.NNNN.exr`` (jittered colour and passes) and
``hr.NNNN.exr`` (reference), as Blender writes multi-layer EXR.

Code instead of a recipe, because of what Blender leaves out: the background's motion, which objects move by themselves,
and averaged passes at silhouettes.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from essjax.cameras import Camera, pixel_positions, unproject
from essjax.data import exr
from essjax.data.importing.facts import make_camera, numbered
from essjax.data.importing.motion import camera_motion
from essjax.data.importing.stream import Converted
from essjax.data.json_files import OBJECT, POSITIVE, Kind, check, numbers, read_json, whole
from essjax.frames import Frame, GBuffers
from essjax.sizes import Size, scale_of

BLENDER_BACKGROUND = 1e9
"""Blender writes 1e10 as the depth of the background."""
MIXED_NORMAL = 0.98
"""A shorter averaged normal is a mixture of surfaces, and so is the motion of that pixel."""
DYNAMIC_PIXELS = 0.1
"""An object moves if, in some frame, its motion is more than this off that of a static one (pixels) ..."""
DYNAMIC_SHARE = 0.1
"""... in more than this share of its pixels."""
DYNAMIC_AREA = 16
"""Frames in which an object has fewer pixels than this do not count."""


@dataclasses.dataclass(frozen=True)
class _Dump:
    """The folder, and ``meta.json`` in essjax's terms."""

    folder: Path
    width: int
    height: int
    output: Size
    cameras: dict[int, Camera]
    jitters: dict[int, np.ndarray]

    @property
    def numbers(self) -> list[int]:
        return sorted(self.cameras)


def _blender_camera(record: Mapping, width: int, height: int) -> Camera:
    focal = record["lens_mm"] / record["sensor_width_mm"] * width
    return make_camera(record["camera_to_world"], [focal, focal], [width / 2, height / 2])


_PIXELS = whole(1, 1 << 16)
_SIZE = Kind(
    "two whole numbers of pixels, above 0",
    lambda value: isinstance(value, list) and len(value) == 2 and all(map(_PIXELS.fits, value)),
)
_FRAME = {"camera_to_world": numbers(16), "lens_mm": POSITIVE, "sensor_width_mm": POSITIVE, "jitter": numbers(2, 0.5)}


def _read_meta(folder: Path) -> _Dump:
    path = folder / "meta.json"
    if not path.is_file():
        raise ValueError(
            f"{path}: not found. The blender preset expects a folder with meta.json (render_size, display_size and "
            "per frame jitter, camera_to_world, lens_mm, sensor_width_mm), lr.NNNN.exr and hr.NNNN.exr."
        )
    meta = read_json(path)
    check(str(path), meta, {"render_size": _SIZE, "display_size": _SIZE, "frames": OBJECT})
    (width, height), (wide, high) = meta["render_size"], meta["display_size"]
    frames = numbered(path, meta["frames"])
    for number, record in frames.items():
        check(f"{path}, frame {number}", record, _FRAME)
    cameras = {number: _blender_camera(record, width, height) for number, record in frames.items()}
    jitters = {number: np.asarray(record["jitter"], np.float32) for number, record in frames.items()}
    if not cameras:
        raise ValueError(f"{path}: expected at least one frame under 'frames', got none.")
    if wide < width or high < height:
        raise ValueError(
            f"{path}: expected display_size to be at least render_size, got {wide}x{high} and {width}x{height}."
        )
    return _Dump(folder, width, height, (high, wide), cameras, jitters)


def _check_files(dump: _Dump) -> None:
    paths = [dump.folder / f"{kind}.{number:04d}.exr" for number in dump.numbers for kind in ("lr", "hr")]
    missing = [path.name for path in paths if not path.is_file()]
    if missing:
        raise ValueError(
            f"{dump.folder}: {len(missing)} of the {len(paths)} images that meta.json lists are missing, the first is "
            f"{missing[0]}. Render or copy them, or take their frames out of meta.json."
        )


class _Passes:
    """Channels of one Blender file, looked up by pass name whatever the view layer is called."""

    def __init__(self, path: Path, width: int, height: int):
        self.path, self.size, self.channels = path, (height, width), exr.read(path)

    def _plane(self, key: str) -> np.ndarray | None:
        names = [name for name in self.channels if name == key or name.endswith(f".{key}")]
        if len(names) > 1:
            raise ValueError(f"{self.path}: {key} is ambiguous: {', '.join(names)}. Export one view layer only.")
        if not names:
            return None
        plane = self.channels[names[0]]
        if plane.shape != self.size:
            raise ValueError(
                f"{self.path}, channel {names[0]}: expected {self.size[1]}x{self.size[0]} as meta.json says, "
                f"got {plane.shape[1]}x{plane.shape[0]}."
            )
        return plane.astype(np.float32)

    def find(self, name: str, suffixes: str) -> np.ndarray | None:
        """``[H, W, C]`` float32, or None if the file has no such pass."""
        planes = [self._plane(f"{name}.{suffix}") for suffix in suffixes]
        found = [plane for plane in planes if plane is not None]
        return np.stack(found, axis=-1) if len(found) == len(suffixes) else None

    def get(self, name: str, suffixes: str) -> np.ndarray:
        """``find``, or a ValueError that says which pass to switch on."""
        image = self.find(name, suffixes)
        if image is None:
            channels = ", ".join(f"{name}.{suffix}" for suffix in suffixes)
            have = ", ".join(sorted({exr.layer(channel) for channel in self.channels}))
            raise ValueError(
                f"{self.path}: expected the channels {channels}; the file has the passes {have}. Switch the pass on in "
                "Blender (View Layer > Passes; basecolor is a colour AOV) and render again."
            )
        return image


def _lr(dump: _Dump, number: int) -> _Passes:
    return _Passes(dump.folder / f"lr.{number:04d}.exr", dump.width, dump.height)


def _motions(dump: _Dump, passes: _Passes, number: int, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motion as rendered, ``previous = current + (X, -Y)``, and that of a static world; both 0 in the first frame."""
    vector = passes.get("Vector", "XY") * np.array([1.0, -1.0], np.float32)
    if number - 1 not in dump.cameras:
        return np.zeros_like(vector), np.zeros_like(vector)
    camera, previous = dump.cameras[number], dump.cameras[number - 1]
    return vector, np.asarray(camera_motion(camera, previous, dump.jitters[number], depth))


def _depth(passes: _Passes) -> np.ndarray:
    depth = passes.get("Depth", "Z")
    return np.where(depth >= BLENDER_BACKGROUND, np.inf, depth).astype(np.float32)


def _object_index(passes: _Passes) -> np.ndarray | None:
    for name in ("Object Index", "IndexOB"):
        index = passes.find(name, "X")
        if index is not None:
            return np.rint(index).astype(np.int32)
    return None


def _moving_ids(dump: _Dump, number: int) -> set[int]:
    """Ids of objects whose rendered motion in a frame is not that of a static surface under the camera's motion."""
    passes = _lr(dump, number)
    index, depth = _object_index(passes), _depth(passes)
    if index is None:
        return set()
    vector, static = _motions(dump, passes, number, depth)
    moving, hit = np.linalg.norm(vector - static, axis=-1) > DYNAMIC_PIXELS, np.isfinite(depth[..., 0])
    objects = {int(identity): moving[hit & (index[..., 0] == identity)] for identity in np.unique(index[hit])}
    return {identity for identity, mine in objects.items() if mine.size >= DYNAMIC_AREA and mine.mean() > DYNAMIC_SHARE}


def _dynamic_ids(dump: _Dump, workers: int | None, skip_broken: bool) -> tuple[int, ...]:
    """Ids of objects that move in some frame; broken frames count as still if they are to be skipped."""

    def ids(number: int) -> set[int]:
        try:
            return _moving_ids(dump, number)
        except ValueError:
            if not skip_broken:
                raise
            return set()

    with ThreadPoolExecutor(workers) as pool:
        return tuple(sorted(set().union(*pool.map(ids, dump.numbers))))


def _stencil(index: np.ndarray, dynamic: Iterable[int], hit: np.ndarray) -> np.ndarray:
    """Ids of moving objects, 0 elsewhere. Objects without an index share 0; if those move they get a new id."""
    dynamic = np.asarray(list(dynamic), np.int32)
    renamed = np.where(index == 0, dynamic.max(initial=0) + 1, index)
    return np.where(hit & np.isin(index, dynamic), renamed, 0).astype(np.int32)


def _radiance(passes: _Passes) -> tuple[np.ndarray, int]:
    color = passes.get("Combined", "RGB")
    return np.maximum(color, 0.0), int((color < 0).sum())


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-6), length


def _convert(dump: _Dump, number: int, dynamic: tuple[int, ...]) -> Converted:
    """One frame, its reference, and counts of what had to be repaired."""
    passes = _lr(dump, number)
    camera, jitter, depth = dump.cameras[number], dump.jitters[number], _depth(passes)
    hit = np.isfinite(depth)
    index = _object_index(passes)
    stencil = None if index is None else _stencil(index, dynamic, hit)
    normal, length = _unit(passes.get("Normal", "XYZ"))
    normal = np.where(hit & (length > 1e-3), normal, 0.0).astype(np.float32)
    position = passes.find("Position", "XYZ")
    if position is None:
        positions = pixel_positions(dump.height, dump.width, jnp.asarray(jitter))
        position = np.asarray(unproject(camera, positions, jnp.asarray(depth)))
    position = np.where(hit, position, 0.0).astype(np.float32)
    to_camera, _ = _unit(np.asarray(camera.camera_to_world)[:3, 3] - position)
    vector, static = _motions(dump, passes, number, depth)
    mixed = hit & (length < MIXED_NORMAL) & (True if stencil is None else stencil == 0)

    def scalar(name: str) -> np.ndarray | None:
        plane = passes.find(name, "X")
        return None if plane is None else np.where(hit, np.clip(plane, 0.0, 1.0), 0.0).astype(np.float32)

    color, negative = _radiance(passes)
    reference, negative_reference = _radiance(
        _Passes(dump.folder / f"hr.{number:04d}.exr", dump.output[1], dump.output[0])
    )
    gbuffers = GBuffers(
        base_color=np.where(hit, np.clip(passes.get("basecolor", "RGB"), 0.0, 1.0), 0.0).astype(np.float32),
        normal=normal,
        depth=depth,
        roughness=scalar("roughness"),
        metallic=scalar("metallic"),
        world_position=position,
        stencil=stencil,
        n_dot_v=np.where(hit, np.clip((normal * to_camera).sum(-1, keepdims=True), 0.0, 1.0), 0.0),
    )
    frame = Frame(
        color=color,
        gbuffers=gbuffers,
        motion=np.where(hit & ~mixed, vector, static).astype(np.float32),
        jitter=jitter,
        cut=np.asarray(number - 1 not in dump.cameras),
        camera=camera,
    )
    counts = {
        "pixels": hit.size,
        "background": int((~hit).sum()),
        "mixed": int(mixed.sum()),
        "negative": negative + negative_reference,
    }
    return Converted(frame, reference, counts)


@dataclasses.dataclass(frozen=True)
class BlenderClip:
    """A clip that Blender rendered; a ``stream.Clip``.

    Background (depth >= 1e9) becomes depth +inf with empty buffers and the sky motion of the cameras; normals get unit
    length; ``previous = current + (X, -Y)`` of Vector; mixed silhouette pixels of static objects move with the cameras;
    negative colour becomes 0. Objects that move by themselves keep their index as stencil, all others get 0.
    """

    name: str
    dump: _Dump
    workers: int | None
    skip_broken: bool

    @functools.cached_property
    def dynamic(self) -> tuple[int, ...]:
        """Indices of the objects that move by themselves; reads every frame once."""
        return _dynamic_ids(self.dump, self.workers, self.skip_broken)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.dump.numbers)

    @property
    def source(self) -> dict[str, Any]:
        """Return what the dataset keeps."""
        return {"preset": "blender", "folder": str(self.dump.folder.resolve()), "dynamic": list(self.dynamic)}

    def files(self, number: int) -> list[Path]:
        """List the files of one frame."""
        return [self.dump.folder / f"{kind}.{number:04d}.exr" for kind in ("lr", "hr")]

    def said(self, number: int) -> str:
        """Return what ``meta.json`` says that matters to one frame."""
        dump = self.dump
        camera, previous = dump.cameras[number], dump.cameras.get(number - 1)
        size = (dump.width, dump.height, scale_of((dump.height, dump.width), dump.output))
        return repr((size, camera, previous, dump.jitters[number].tolist()))

    def convert(self, number: int) -> Converted:
        """Read and convert one frame; a ValueError names the file and what is missing or wrong."""
        return _convert(self.dump, number, self.dynamic)


def open_blender(folder: Path, *, workers: int | None, skip_broken: bool) -> BlenderClip:
    """Open the clip in a folder with ``meta.json``.

    Raises:
      ValueError: names the file and what is missing or wrong.
    """
    dump = _read_meta(folder)
    if not skip_broken:
        _check_files(dump)
    return BlenderClip(folder.resolve().name, dump, workers, skip_broken)
