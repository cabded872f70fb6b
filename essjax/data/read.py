"""``Sequence``s from a dataset folder."""

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

from essjax.buffers import MASKS, RANGES
from essjax.cameras import Camera
from essjax.data import exr
from essjax.data.augment import start_with_cut
from essjax.data.layout import Dataset, Segment, SequenceInfo, channel_names, frame_path, whole
from essjax.frames import Frame, SampleRanges, Sequence, gbuffers_of


def _sized(path: Path, channels: dict[str, np.ndarray], width: int, height: int) -> dict[str, np.ndarray]:
    for name, plane in channels.items():
        if plane.shape != (height, width):
            raise ValueError(
                f"{path}, channel {name}: expected {width}x{height} as sequence.json says, "
                f"got {plane.shape[1]}x{plane.shape[0]}."
            )
    return channels


def _stack_planes(channels: Mapping[str, np.ndarray], image: str) -> np.ndarray:
    """``[H, W, C]`` float32 (ids int32) from the planes of one image."""
    dtype = np.int32 if image == "stencil" else np.float32
    return np.stack([channels[name] for name in channel_names(image)], axis=-1).astype(dtype)


def _read_images(path: Path, names: Iterable[str], width: int, height: int) -> dict[str, np.ndarray]:
    names = list(names)
    expected = [channel for name in names for channel in channel_names(name)]
    planes = _sized(path, exr.read(path, expected), width, height)
    return {name: _stack_planes(planes, name) for name in names}


def _make_camera(record: Mapping | None) -> Camera | None:
    return None if record is None else Camera(**{key: np.asarray(value, np.float32) for key, value in record.items()})


def _make_frame(images: Mapping[str, np.ndarray], record: Mapping, prefix: str = "") -> Frame:
    return Frame(
        color=images["color"],
        gbuffers=gbuffers_of(images),
        motion=images["motion"],
        jitter=np.asarray(record[f"{prefix}jitter"], np.float32),
        cut=np.asarray(record["cut"], bool),
        exposure=None if record["exposure"] is None else np.asarray(record["exposure"], np.float32),
        camera=_make_camera(record[f"{prefix}camera"]),
        reactive=images.get("reactive"),
    )


def select_records(info: SequenceInfo, first: int, last: int) -> list[Mapping]:
    """Select the records of the frames from number ``first`` to ``last``, both included."""
    return [record for record in info.frames if first <= record["number"] <= last]


def read_frame(root: Path, info: SequenceInfo, record: Mapping, *, native: bool, ranges: bool) -> Sequence:
    """One frame as it lies on disk: NumPy leaves ``[H, W, C]``, float32 (``stencil`` int32, ``cut`` bool).

    Args:
      root: the dataset's folder.
      info: of the sequence.
      record: one of ``info.frames``.
      native: read the native frame too, if there is one.
      ranges: read the sample ranges too, if there are any.

    Raises:
      ValueError: names dataset, sequence, frame, file and channel, what was expected and what came.
    """
    native, ranges = native and info.native, ranges and info.ranges
    number, (high, wide) = record["number"], info.output
    try:
        images = _read_images(frame_path(root, info.name, "lr", number), info.channels, info.width, info.height)
        path = frame_path(root, info.name, "hr", number)
        reference = _sized(path, exr.read(path, "RGB"), wide, high)
        native_frame = None
        if native:
            names = [name for name in info.channels if name not in MASKS]
            native_images = _read_images(frame_path(root, info.name, "native", number), names, wide, high)
            native_frame = _make_frame(native_images, record, "native_")
        sample_ranges = None
        if ranges:
            path = frame_path(root, info.name, "ranges", number)
            sample_ranges = SampleRanges(**_read_images(path, RANGES, wide, high))
        return Sequence(
            frames=_make_frame(images, record),
            reference=np.stack([reference[name] for name in "RGB"], axis=-1).astype(np.float32),
            valid=images.get("valid"),
            steady=images.get("steady"),
            native=native_frame,
            ranges=sample_ranges,
        )
    except KeyError as error:
        raise ValueError(f"{root / info.name / 'sequence.json'}, frame {number}: {error} is missing.") from error
    except ValueError as error:
        raise ValueError(f"dataset {root}, sequence {info.name}, frame {number}: {error}") from error


def read_sequence(
    dataset: Dataset,
    name: str,
    frames: tuple[int, int] | None = None,
    *,
    native: bool = True,
    ranges: bool = False,
    threads: int | None = None,
) -> Sequence:
    """Read a sequence into memory: NumPy leaves ``[T, H, W, C]``, float32 (``stencil`` int32, ``cut`` bool).

    Args:
      dataset: from ``read_dataset``.
      name: of the sequence.
      frames: numbers of the first and the last frame, both included; None: all. The first frame read becomes a
        cut (``start_with_cut``), for what came before it is not there.
      native: read the native frames too, where there are any.
      ranges: read the sample ranges too, where there are any.
      threads: files read at the same time; None: one per core.

    Raises:
      ValueError: names dataset, sequence, frame, file and channel, what was expected and what came.
    """
    if name not in dataset.sequences:
        raise ValueError(f"{dataset.path}: no sequence {name!r}; there are {', '.join(dataset.sequences)}.")
    info = dataset.sequences[name]
    first, last = frames or whole(info)[1:3]
    records = select_records(info, first, last)
    if not records or first not in info.numbers or last not in info.numbers:
        raise ValueError(
            f"{dataset.path}, sequence {name}: expected a range within the frames {info.numbers[0]}.."
            f"{info.numbers[-1]}, got {first}..{last}."
        )

    def read(record: Mapping) -> Sequence:
        return read_frame(dataset.path, info, record, native=native, ranges=ranges)

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        parts = list(pool.map(read, records))
    return start_with_cut(jax.tree.map(lambda *leaves: np.stack(leaves), *parts))


def read_segment(dataset: Dataset, segment: Segment, *, native: bool = True, ranges: bool = False) -> Sequence:
    """``read_sequence`` of a segment, warm-up frames included."""
    return read_sequence(dataset, segment.sequence, (segment.first, segment.last), native=native, ranges=ranges)
