"""Records of frames in ``sequence.json``, and how two of them are compared."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from essjax.cameras import Camera
from essjax.data.layout import channel_names
from essjax.frames import Frame


def split_planes(image: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Planes of an image by channel name."""
    return {name: values[..., i] for i, name in enumerate(channel_names(image))}


def plain(content: Any) -> Any:
    """As JSON gives it back: tuples become lists."""
    return json.loads(json.dumps(content))


def differences(asked: Mapping[str, Any], found: Mapping[str, Any], prefix: str = "") -> list[str]:
    """``"motion.sign: asked 'a', found 'b'"`` for everything in which two nested records differ."""
    lines = []
    for key in {**asked, **found}:
        a, b = asked.get(key), found.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += differences(a, b, f"{prefix}{key}.")
        elif a != b:
            lines.append(f"{prefix}{key}: asked {a!r}, found {b!r}")
    return lines


def digest(content: Any) -> str:
    """Digest all leaves of a tree of arrays: it tells a frame from another one."""
    state = hashlib.blake2b(digest_size=8)
    for path, leaf in jax.tree_util.tree_leaves_with_path(content):
        state.update(f"{jax.tree_util.keystr(path)} {leaf.dtype} {leaf.shape}".encode())
        state.update(np.ascontiguousarray(leaf).data)
    return state.hexdigest()


def _camera_record(camera: Camera | None) -> dict | None:
    if camera is None:
        return None
    return {field.name: np.asarray(getattr(camera, field.name)).tolist() for field in dataclasses.fields(camera)}


def frame_record(number: int, frame: Frame, native: Frame | None, made_from: str) -> dict:
    """Make the entry of a frame in ``sequence.json``, but for its notes."""
    record = {
        "number": number,
        "made_from": made_from,
        "jitter": np.asarray(frame.jitter).tolist(),
        "cut": bool(frame.cut),
        "exposure": None if frame.exposure is None else float(frame.exposure),
        "camera": _camera_record(frame.camera),
    }
    if native is not None:
        record |= {
            "native_jitter": np.asarray(native.jitter).tolist(),
            "native_camera": _camera_record(native.camera),
        }
    return record


def planes_of(images: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Planes by channel name, of images by their names."""
    return {
        key: plane for name, image in images.items() for key, plane in split_planes(name, np.asarray(image)).items()
    }
