"""Inventory of a dump that nobody described: files by pattern, channels by image, and what their names say.

Nothing here looks at more than one frame, or compares pictures; ``essjax.data.guess`` does.
"""

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from essjax.data.exr import layer
from essjax.data.importing.files import hidden
from essjax.data.importing.planes import STACKS, channels_in, count_frames
from essjax.data.json_files import read_json

ENDINGS = (".exr", ".png", ".npy", ".npz", ".safetensors")
_WORD = r"(?<![a-z])({})(?![a-z])"
ROLES = {
    "motion": r"motion|velocity|vector|flow|" + _WORD.format("mv|mvs|mvec|vel"),
    "base_color": r"albedo|base_?col|diffuse_?col",
    "normal": r"normal|" + _WORD.format("n|nrm|nor"),
    "world_position": r"position|" + _WORD.format("pos|p"),
    "roughness": r"rough",
    "metallic": r"metal",
    "specular": r"specular",
    "n_dot_v": r"nov|n_?dot_?v",
    "stencil": r"stencil|object|crypto|" + _WORD.format("id|ids|index"),
    "reactive": r"reactive|transluc",
    "depth": r"depth|zbuf|distance|" + _WORD.format("z|dist"),
    "reference": r"reference|ground_?truth|target|final|hires|high_?res|" + _WORD.format("ref|gt|hr"),
    "color": r"colou?r|beauty|combined|input|render|" + _WORD.format("rgb|lr|image|img|frame"),
}
"""Image -> how its files and layers are called; the first that fits."""
COUNTS = {"motion": 2, "base_color": 3, "normal": 3, "world_position": 3, "reference": 3, "color": 3}
"""Channels of an image; the others have one."""


_ORDER = {letter: place for letters in ("RGBA", "XYZW", "UV") for place, letter in enumerate(letters)}
"""Names of the channels of a layer; indices come in theirs."""


class Group(NamedTuple):
    """Channels of one file that belong together.

    Attributes:
      pattern: of the files, with {sequence} and {frame}.
      channels: their names, in order.
      planes: of one frame, ``[H, W]`` as they are stored.
      role: image, "reference" or "" (its name says nothing).
    """

    pattern: str
    channels: tuple[str, ...]
    planes: tuple[np.ndarray, ...]
    role: str

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.planes[0].shape
        return height, width

    @property
    def bytes(self) -> bool:
        """Whether the file holds bytes."""
        return self.planes[0].dtype == np.uint8


class Inventory(NamedTuple):
    """A dump.

    Attributes:
      groups: of a frame of the first sequence.
      sequences: names.
      numbers: of the frames of the first sequence.
      files: pattern -> frame number -> file, of the first sequence.
      metadata: pattern of a JSON with frames, or "".
      fields: what that says of each frame.
    """

    groups: list[Group]
    sequences: list[str]
    numbers: list[int]
    files: Mapping[str, Mapping[int, Path]]
    metadata: str
    fields: frozenset[str] = frozenset()


def _runs(stem: str) -> list[str]:
    """``["lr", "0012", ""]``: digits at odd places."""
    return re.split(r"(\d+)", stem)


def _patterns(paths: list[PurePosixPath]) -> dict[str, dict[int, PurePosixPath]]:
    """Pattern -> frame number -> path. The frame is the digits of the name that take the most values."""
    alike: dict[tuple, list[PurePosixPath]] = {}
    for path in paths:
        runs = _runs(path.stem)
        alike.setdefault((path.parent, path.suffix, tuple(runs[::2])), []).append(path)
    found: dict[str, dict[int, PurePosixPath]] = {}
    for (parent, suffix, _), members in alike.items():
        digits = np.array([_runs(path.stem)[1::2] for path in members], dtype=object).reshape(len(members), -1)
        if not digits.shape[1]:
            if suffix in STACKS:
                found[members[0].as_posix()] = {}
            continue
        counts = [len(set(column)) for column in digits.T]
        place = len(counts) - 1 - int(np.argmax(counts[::-1]))
        for path, own in zip(members, digits, strict=True):
            runs = _runs(path.stem)
            runs[2 * place + 1] = "{frame}"
            pattern = (parent / ("".join(runs) + suffix)).as_posix()
            found.setdefault(pattern, {})[int(own[place])] = path
    return found


def role_of(text: str) -> str:
    """Return the image that a name means, or ""."""
    words = re.sub(r"([a-z])([A-Z])", r"\1_\2", text).lower()
    return next((role for role, words_of in ROLES.items() if re.search(words_of, words)), "")


def _with_sequences(patterns: list[str]) -> tuple[dict[str, str], list[str]]:
    """Pattern -> the same with {sequence} for a folder that has siblings with the same files; and their names."""
    parts = {pattern: pattern.split("/") for pattern in patterns}
    for place in range(max(len(p) for p in parts.values()) - 1):
        names = sorted({p[place] for p in parts.values() if len(p) > place + 1})
        if len(names) < 2 or any(role_of(name) for name in names):
            continue
        rest = {name: {tuple(p[:place] + p[place + 1 :]) for p in parts.values() if p[place] == name} for name in names}
        if all(each == rest[names[0]] for each in rest.values()):
            first = [p for p in parts.values() if p[place] == names[0]]
            return {"/".join(p): "/".join([*p[:place], "{sequence}", *p[place + 1 :]]) for p in first}, names
    return {pattern: pattern for pattern in patterns}, []


def _groups_of(pattern: str, planes: Mapping[str, np.ndarray]) -> list[Group]:
    by_layer: dict[str, list[str]] = {}
    for name in planes:
        single = layer(name) if "." in name else ""
        by_layer.setdefault(single, []).append(name)
    groups = []
    for name, channels in by_layer.items():
        ordered = sorted(channels, key=lambda c: (_ORDER.get(c.rpartition(".")[2], len(_ORDER)), c))
        for part in _by_size([(c, planes[c]) for c in ordered]):
            own = name if name and role_of(name) else f"{pattern.replace('{frame}', '')} {name}"
            groups.append(Group(pattern, tuple(c for c, _ in part), tuple(p for _, p in part), role_of(own)))
    return groups


def _by_size(channels: list[tuple[str, np.ndarray]]) -> list[list[tuple[str, np.ndarray]]]:
    sizes: dict[tuple[int, ...], list[tuple[str, np.ndarray]]] = {}
    for name, plane in channels:
        sizes.setdefault(plane.shape, []).append((name, plane))
    return list(sizes.values())


def take_stock(source: Path) -> Inventory:
    """Look at the names of all files of a dump, and at the channels of one frame.

    Raises:
      ValueError: there are no images.
    """
    paths = [path.relative_to(source) for path in sorted(source.rglob("*")) if path.is_file()]
    shown = [path for path in paths if not hidden(path)]
    images = _patterns([PurePosixPath(path.as_posix()) for path in shown if path.suffix.lower() in ENDINGS])
    if not images:
        raise ValueError(f"{source}: expected images ({', '.join(ENDINGS)}), found none. Is this the right folder?")
    named, sequences = _with_sequences(list(images))
    groups, files = [], {}
    for pattern, general in named.items():
        frames = images[pattern]
        path = source / (frames[sorted(frames)[len(frames) // 2]] if frames else pattern)  # nothing moves in the first
        if frames:
            files[general] = {number: source / frames[number] for number in sorted(frames)}
            groups += _groups_of(general, channels_in(path))
        else:
            planes = channels_in(path, -1)
            files[general] = dict.fromkeys(range(count_frames(path, next(iter(planes)))), path)
            groups += _groups_of(general, planes)
    common = set.intersection(*[set(frames) for frames in files.values()])
    first = sequences[0] if sequences else ""
    jsons = [path.as_posix() for path in shown if path.suffix == ".json"]
    known = [path for path in jsons if b'"frames"' in (source / path).read_bytes()[:4096]]
    metadata = known[0].replace(first, "{sequence}") if known and first else known[0] if known else ""
    fields = _fields(source / known[0]) if known else frozenset()
    return Inventory(groups, sequences, sorted(common), files, metadata, fields)


def _fields(path: Path) -> frozenset[str]:
    records = read_json(path).get("frames")
    first = next(iter(records.values()), {}) if isinstance(records, dict) else {}
    return frozenset(first) if isinstance(first, dict) else frozenset()
