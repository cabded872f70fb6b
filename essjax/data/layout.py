"""The dataset on disk: what it consists of, written frame by frame, checked when opened.

    OUT/dataset.json                size, scale, channels, sequences, splits: written last
    OUT/<sequence>/sequence.json    per frame: number, jitter, camera, cut, exposure; lists complete frames only
    OUT/<sequence>/lr.NNNN.exr      color.R, normal.X, depth.Z, motion.X, ...: the frame and its masks
    OUT/<sequence>/hr.NNNN.exr      R, G, B: the reference
    OUT/<sequence>/native.NNNN.exr  optional: the frame again at the reference's size, with a jitter of its own
    OUT/<sequence>/ranges.NNNN.exr  optional: depth_min.Z, color_max.R, ...: over all samples of each reference pixel

Frames keep their original numbers; ranges of frames include both ends. Colours, normals and the like are half, depth,
positions and motion float32, ids integers.
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from essjax.buffers import BUFFERS, MASKS, RANGES
from essjax.data.json_files import (
    FLAG,
    LIST,
    NAME,
    OBJECT,
    POSITIVE,
    SCALE,
    SIDE,
    TEXT,
    Kind,
    check,
    is_name,
    numbers,
    or_null,
    read_json,
    shown,
    whole,
    write_json,
)
from essjax.sizes import Scale, Size, output_size

SCHEMA = 1
SUFFIXES = {**{name: buffer.suffixes for name, buffer in BUFFERS.items()}, **dict.fromkeys(MASKS, "Y")}
"""Channel suffixes of every image of an ``lr`` or ``native`` file."""
KINDS = ("lr", "hr", "native", "ranges")
"""Kinds of files that a frame may consist of."""


OPEN = ("exposure", "camera")
"""What all frames of a sequence say, or none."""
AGREE = ("width", "height", "scale", "channels", "ranges")
"""Fields of ``SequenceInfo`` in which all sequences of a dataset agree; frames of one agree in ``native`` as well."""


class Segment(NamedTuple):
    """A range of frames of one sequence.

    Attributes:
      sequence: its name.
      first: number of the first frame that is streamed.
      last: number of the last one, included.
      score_from: frames before this number only warm up the history and are not scored.
    """

    sequence: str
    first: int
    last: int
    score_from: int


@dataclasses.dataclass(frozen=True)
class SequenceInfo:
    """``sequence.json``.

    Attributes:
      name: of the sequence and its folder.
      width: of its frames, pixels.
      height: of its frames, pixels.
      scale: reference size over frame size: a number, or the reference's (width, height) where its sides differ in that
        (in JSON a list of both).
      channels: the images in every ``lr`` file, as in ``SUFFIXES``.
      native: whether there are ``native`` files.
      ranges: whether there are ``ranges`` files.
      source: where the frames come from, as the producer describes it.
      frames: one record per complete frame, in order: ``number``, ``jitter``, ``cut``, ``exposure`` (a number in all
        frames or, where it is not known, None in all), ``camera`` (``camera_to_world``, ``focal``, ``center``, or
        None), ``notes`` (counts); ``native_jitter`` and ``native_camera`` with native; ``made_from``, a short text that
        differs if the frame was made from other files or content.
      complete: false while frames are still to be written.
      skipped: one record per frame that was left out: ``number``, ``reason`` and ``made_from``.
    """

    name: str
    width: int
    height: int
    scale: Scale
    channels: tuple[str, ...]
    native: bool
    source: Mapping[str, Any]
    frames: tuple[Mapping[str, Any], ...] = ()
    complete: bool = False
    ranges: bool = False
    skipped: tuple[Mapping[str, Any], ...] = ()

    @property
    def size(self) -> Size:
        """(height, width) of the frames."""
        return self.height, self.width

    @property
    def output(self) -> Size:
        """(height, width) of the references."""
        return output_size(self.scale, self.size)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Original frame numbers."""
        return tuple(record["number"] for record in self.frames)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """``dataset.json`` with the records of its sequences.

    Attributes:
      path: the folder.
      source: where the data comes from, as the producer describes it.
      sequences: name -> ``SequenceInfo``; all agree in size, scale, channels and ranges.
      splits: "train", "validation", "test" -> segments.
    """

    path: Path
    source: Mapping[str, Any]
    sequences: Mapping[str, SequenceInfo]
    splits: Mapping[str, tuple[Segment, ...]]

    @property
    def info(self) -> SequenceInfo:
        """The first sequence: size, scale, channels and ranges are those of all."""
        return next(iter(self.sequences.values()))

    def segments(self, split: str) -> tuple[Segment, ...]:
        """Segments of ``split``; a ValueError lists the splits there are."""
        if split not in self.splits:
            raise ValueError(f"{self.path}: no split {split!r}; this dataset has {', '.join(self.splits) or 'none'}.")
        return self.splits[split]

    def has_native(self, *splits: str) -> bool:
        """Whether every sequence of these splits has frames at the reference's size."""
        return all(self.sequences[segment.sequence].native for split in splits for segment in self.segments(split))

    def numbers(self, segment: Segment) -> tuple[int, ...]:
        """Original numbers of the frames that ``read_segment`` returns, in order."""
        numbers = self.sequences[segment.sequence].numbers
        return tuple(number for number in numbers if segment.first <= number <= segment.last)

    def scored(self, segment: Segment) -> np.ndarray:
        """Bool ``[T]`` over those frames: which are scored (warm-up after cuts is for the evaluation to leave out)."""
        return np.asarray(self.numbers(segment)) >= segment.score_from


def channel_names(image: str) -> list[str]:
    """``["normal.X", "normal.Y", "normal.Z"]`` of ``"normal"``."""
    return [f"{image}.{suffix}" for suffix in {**RANGES, **SUFFIXES}[image]]


def frame_path(root: Path, name: str, kind: str, number: int) -> Path:
    """File of one frame; ``kind`` is one of ``KINDS``."""
    return Path(root) / name / f"{kind}.{number:04d}.exr"


def _schema(path: Path, content: dict) -> dict:
    if content.get("schema") != SCHEMA:
        raise ValueError(
            f"{path}: expected schema {SCHEMA}, found {shown(content.get('schema'))}. "
            "Generate or import the dataset again with this version of essjax."
        )
    return content


_FRAME_NUMBER = whole(-(2**31), 2**31)
_CAMERA_SIZES = {"camera_to_world": 16, "focal": 2, "center": 2}
_CAMERA = or_null(
    Kind(
        "camera_to_world (4x4 numbers), focal and center (2 numbers each)",
        lambda value: (
            isinstance(value, dict)
            and set(value) == set(_CAMERA_SIZES)
            and all(numbers(size).fits(value[key]) for key, size in _CAMERA_SIZES.items())
        ),
    )
)
_CHANNELS = Kind(
    f"a list of images among {', '.join(SUFFIXES)}, each once",
    lambda value: (
        isinstance(value, list)
        and all(isinstance(image, str) and image in SUFFIXES for image in value)
        and len(set(value)) == len(value) > 0
    ),
)
_SEQUENCE = {
    "name": NAME, "width": SIDE, "height": SIDE, "scale": SCALE, "native": FLAG,
    "channels": _CHANNELS,
    "ranges": FLAG, "source": OBJECT, "frames": LIST, "complete": FLAG, "skipped": LIST,
}  # fmt: skip
# Jitter outside of -0.5..0.5 is for ``check`` to explain.
_FRAME = {
    "number": _FRAME_NUMBER, "jitter": numbers(2, 1), "cut": FLAG, "exposure": or_null(POSITIVE), "camera": _CAMERA,
    "notes": OBJECT, "made_from": TEXT,
}  # fmt: skip
_NATIVE = {"native_jitter": numbers(2, 1), "native_camera": _CAMERA}
_SKIPPED = {"number": _FRAME_NUMBER, "reason": TEXT, "made_from": TEXT}
_SEGMENT = {"sequence": NAME, "first": _FRAME_NUMBER, "last": _FRAME_NUMBER, "score_from": _FRAME_NUMBER}


def _check_records(path: Path, content: Mapping[str, Any]) -> None:
    """Check each frame that ``sequence.json`` lists, and their order."""
    kinds = {**_FRAME, **(_NATIVE if content["native"] else {})}
    before = None
    for index, record in enumerate(content["frames"]):
        where = f"{path}, record {index}"
        check(where, record, {"number": _FRAME_NUMBER})
        check(f"{where}, frame {record['number']}", record, kinds, optional=("notes", "made_from"))
        if before is not None and record["number"] <= before:
            raise ValueError(
                f"{where}: number: expected more than {before}, got {record['number']}: frames are in order."
            )
        before = record["number"]
    for index, record in enumerate(content["skipped"]):
        check(f"{path}, skipped, record {index}", record, _SKIPPED, optional=("made_from",))


def read_sequence_info(root: str | os.PathLike, name: str) -> SequenceInfo:
    """Read ``sequence.json`` of a sequence, finished or not.

    Raises:
      ValueError: it is missing, damaged, of another schema, or a field is missing or wrong; names file and key.
    """
    if not is_name(name):  # it may come from a file: nothing outside of the dataset is read or written
        raise ValueError(f"{root}: sequence name: expected {NAME.expected}, got {shown(name)}.")
    path = Path(root) / name / "sequence.json"
    content = _schema(path, read_json(path))
    content = {"ranges": False, "skipped": [], **content}  # datasets older than these
    check(str(path), content, _SEQUENCE)
    if content["name"] != name:
        raise ValueError(f"{path}: name: expected {name!r} as its folder, got {shown(content['name'])}.")
    _check_records(path, content)
    for key in (*OPEN, "native_camera"):
        if len({record.get(key) is None for record in content["frames"]}) > 1:
            raise ValueError(f"{path}: {key}: expected a value for all frames, or null for all; the file is damaged.")
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}
    info = SequenceInfo(**{field.name: fields[field.name] for field in dataclasses.fields(SequenceInfo)})
    if isinstance(info.scale, tuple) and (info.scale[0] < info.width or info.scale[1] < info.height):
        raise ValueError(f"{path}: scale: expected at least the frames' size, got {shown(content['scale'])}.")
    return info


def write_sequence_info(root: str | os.PathLike, info: SequenceInfo) -> None:
    """Write ``sequence.json`` atomically."""
    fields = {field.name: getattr(info, field.name) for field in dataclasses.fields(info)}
    write_json(Path(root) / info.name / "sequence.json", {"schema": SCHEMA, **fields})


def whole(info: SequenceInfo) -> Segment:
    """All frames of a sequence."""
    numbers = info.numbers
    return Segment(info.name, numbers[0], numbers[-1], numbers[0])


def _check_segment(path: Path, split: str, segment: Segment, sequences: Mapping[str, SequenceInfo]) -> None:
    if segment.sequence not in sequences:
        raise ValueError(f"{path}: split {split} names the sequence {segment.sequence!r}, which does not exist.")
    numbers = sequences[segment.sequence].numbers
    if not (numbers[0] <= segment.first <= segment.score_from <= segment.last <= numbers[-1]):
        raise ValueError(
            f"{path}: split {split}, sequence {segment.sequence}: expected first <= score_from <= last within the "
            f"frames {numbers[0]}..{numbers[-1]}, got {segment.first}, {segment.score_from}, {segment.last}."
        )


def check_agreement(path: Path, infos: Iterable[SequenceInfo]) -> None:
    """Raise a ValueError unless the sequences may be of one dataset: one size, scale, and set of channels."""
    infos = list(infos)
    for info in infos:
        for field in AGREE:
            if getattr(info, field) != getattr(infos[0], field):
                raise ValueError(
                    f"{path}: all sequences must agree in {field}: {infos[0].name} has {getattr(infos[0], field)}, "
                    f"{info.name} has {getattr(info, field)}. Put them into different datasets: into a folder of their "
                    "own each, and from there into different output folders."
                )


def _check_sequences(path: Path, infos: Iterable[SequenceInfo]) -> None:
    infos = list(infos)
    for info in infos:
        if not info.complete or not info.frames:
            raise ValueError(
                f"{path}: sequence {info.name} is unfinished ({len(info.frames)} frames so far). "
                "Run the command that writes it again: it resumes."
            )
    check_agreement(path, infos)


def write_dataset(
    root: str | os.PathLike, splits: Mapping[str, Iterable[Segment | str]], *, source: Mapping[str, Any] | None = None
) -> Dataset:
    """Write ``dataset.json`` over finished sequences, atomically; it replaces an older one.

    Args:
      root: the folder that holds the sequences' folders.
      splits: split name -> segments; a sequence's name stands for all its frames.
      source: where the data comes from.

    Raises:
      ValueError: a sequence is missing, unfinished or differs in size or channels, or a segment lies outside.
    """
    path = Path(root) / "dataset.json"
    entries = {split: list(segments) for split, segments in splits.items()}
    names = dict.fromkeys(e if isinstance(e, str) else e.sequence for s in entries.values() for e in s)
    sequences = {name: read_sequence_info(root, name) for name in names}
    if not sequences:
        raise ValueError(f"{path}: expected at least one sequence, got none.")
    _check_sequences(path, sequences.values())
    resolved = {
        split: tuple(whole(sequences[e]) if isinstance(e, str) else Segment(*e) for e in segments)
        for split, segments in entries.items()
    }
    for split, segments in resolved.items():
        for segment in segments:
            _check_segment(path, split, segment, sequences)
    dataset = Dataset(Path(root), dict(source or {}), sequences, resolved)
    info = dataset.info
    write_json(
        path,
        {
            "schema": SCHEMA,
            "source": dataset.source,
            "size": [info.width, info.height],
            "scale": info.scale,
            "channels": list(info.channels),
            "native": [name for name, info in sequences.items() if info.native],
            "ranges": info.ranges,
            "sequences": list(sequences),
            "splits": {split: [segment._asdict() for segment in segments] for split, segments in resolved.items()},
        },
    )
    return dataset


def read_index(root: str | os.PathLike) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    """Read names of sequences, source and splits from ``dataset.json``, also of sequences that are not finished.

    Raises:
      ValueError: the file is missing, damaged, of another schema, or lacks a field.
    """
    file = Path(root) / "dataset.json"
    content = _schema(file, read_json(file))
    check(str(file), content, {"sequences": LIST, "source": OBJECT, "splits": OBJECT})
    names, splits = content["sequences"], content["splits"]
    for index, name in enumerate(names):
        if not is_name(name) or names.index(name) < index:
            raise ValueError(f"{file}: sequences: expected plain folder names, each once, got {shown(name)}.")
    for split, entries in splits.items():
        check(f"{file}: splits", splits, {split: LIST})
        for index, entry in enumerate(entries):
            check(f"{file}: split {split}, segment {index}", entry, _SEGMENT)
    return names, content["source"], splits


def read_dataset(path: str | os.PathLike) -> Dataset:
    """Open a dataset: its metadata, checked; images are read by ``read_sequence``.

    Raises:
      ValueError: names the file and what is wrong with it.
    """
    root = Path(path)
    file = root / "dataset.json"
    if not file.is_file():
        raise ValueError(
            f"{file}: not found. Expected a finished dataset: make one with `essjax scenes {root}` or "
            f"`essjax import SOURCE {root}` (an interrupted one resumes with the same command)."
        )
    names, source, splits = read_index(root)
    resolved = {
        split: tuple(Segment(*(entry[field] for field in Segment._fields)) for entry in entries)
        for split, entries in splits.items()
    }
    sequences = {name: read_sequence_info(root, name) for name in names}
    if not sequences:
        raise ValueError(f"{file}: expected at least one sequence, got none.")
    _check_sequences(file, sequences.values())
    for split, segments in resolved.items():
        for segment in segments:
            _check_segment(file, split, segment, sequences)
    return Dataset(root, source, sequences, resolved)
