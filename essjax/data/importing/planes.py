"""One image file to channels by name: EXR, PNG, NumPy's npy and npz, and safetensors.

Channels of an array are its name and an index, ``"depth.0"``; those of an npy, which has no name, the index alone.
Which axis holds them is seen from its size. A negative index counts from the end.
"""

import functools
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data import exr, png
from essjax.tensors import map_safetensors

STACKS = (".npy", ".safetensors")
"""Endings of files that may hold all frames of a sequence, along their first axis."""


def read_planes(
    path: Path, expect: Iterable[str], frame: int | None = None
) -> tuple[Mapping[str, np.ndarray], Mapping[str, Any]]:
    """Channels of an image file, ``[H, W]`` as they are stored, and what its header says.

    Args:
      path: its ending says what it is.
      expect: channels that must be there; arrays are looked up for these alone.
      frame: index along the first axis, of files that hold all frames; None: the file is one frame.

    Raises:
      ValueError: missing, damaged, of an unknown kind, or a channel is missing; begins with the path.
    """
    suffix = path.suffix.lower()
    if suffix == ".png":
        return png.read(path, expect), {}
    if suffix in _ARRAYS:
        return _array_planes(path, list(expect), frame), {}
    return exr.read_all(path, expect)


def channels_in(path: Path, frame: int | None = None) -> dict[str, np.ndarray]:
    """All channels of a file, whatever their names."""
    if path.suffix.lower() not in _ARRAYS:
        return dict(read_planes(path, ())[0])
    found = {}
    for name, array in _arrays(path).items():
        one = array if frame is None else array[frame]
        if one.ndim in (2, 3):
            planes = _channels_first(one)
            prefix = f"{name}." if name else ""
            found |= {f"{prefix}{index}": np.asarray(plane) for index, plane in enumerate(planes)}
    return found


def count_frames(path: Path, channel: str) -> int:
    """How many frames a file holds along the first axis of a channel's array."""
    return len(_array_of(path, _arrays(path), channel)[0])


def _npy(path: Path) -> dict[str, np.ndarray]:
    return {"": np.load(path, mmap_mode="r", allow_pickle=False)}


def _npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


_ARRAYS: Mapping[str, Callable[[Path], Mapping[str, np.ndarray]]] = {
    ".npy": _npy, ".npz": _npz, ".safetensors": map_safetensors,
}  # fmt: skip


def _arrays(path: Path) -> Mapping[str, np.ndarray]:
    if not path.is_file():
        raise ValueError(f"{path}: expected a file of arrays, found {'a folder' if path.is_dir() else 'nothing'}.")
    try:
        return _ARRAYS[path.suffix.lower()](path)
    except (OSError, ValueError, EOFError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: the file is damaged ({error}). Download or write it again.") from error


def _array_of(path: Path, arrays: Mapping[str, np.ndarray], channel: str) -> tuple[np.ndarray, int]:
    """Find the array that a channel belongs to, and its index there."""
    name, _, index = channel.rpartition(".")
    if name not in arrays or not index.lstrip("-").isdigit():
        there = ", ".join(f"{n}.0".lstrip(".") for n in list(arrays)[: exr.SHOWN])
        raise ValueError(f"{path}: expected the channel {channel}; the file has {there} (and so on).")
    return arrays[name], int(index)


def _channels_first(array: np.ndarray) -> np.ndarray:
    """``[C, H, W]``: channels are on the shorter one of the first and the last axis."""
    if array.ndim == 2:
        return array[None]
    return array if array.shape[0] < array.shape[-1] else np.moveaxis(array, -1, 0)


def _array_planes(path: Path, channels: list[str], frame: int | None) -> dict[str, np.ndarray]:
    arrays, found = _arrays(path), {}
    for channel in channels:
        array, index = _array_of(path, arrays, channel)
        if frame is not None:
            array = array[frame]
        if array.ndim == 4 and len(array) == 1:
            array = array[0]
        if array.ndim not in (2, 3):
            raise ValueError(
                f"{path}, channel {channel}: expected an image [H, W], [H, W, C] or [C, H, W], got the shape "
                f"{array.shape}. Frames along the first axis: leave {{frame}} out of the pattern in [files]."
            )
        planes = _channels_first(array)
        if not -len(planes) <= index < len(planes):
            raise ValueError(f"{path}: expected the channel {channel}; the array has {len(planes)} of them.")
        found[channel] = np.ascontiguousarray(planes[index])
    return found


stacked_facts = functools.lru_cache(maxsize=8)(map_safetensors)
"""Small arrays of a file of all frames, mapped once."""
