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
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from essjax.buffers import BUFFERS, MASKS, RANGES
from essjax.cameras import Camera
from essjax.files import atomic

SCHEMA = 1
SUFFIXES = {**{name: buffer.suffixes for name, buffer in BUFFERS.items()}, **dict.fromkeys(MASKS, "Y")}
"""Channel suffixes of every image of an ``lr`` or ``native`` file."""
KINDS = ("lr", "hr", "native", "ranges")
"""Kinds of files that a frame may consist of."""


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
      scale: reference size over frame size.
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
    scale: int
    channels: tuple[str, ...]
    native: bool
    source: Mapping[str, Any]
    frames: tuple[Mapping[str, Any], ...] = ()
    complete: bool = False
    ranges: bool = False
    skipped: tuple[Mapping[str, Any], ...] = ()

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


def _format(content: Mapping) -> str:
    """One line per field and per record of a list; ``indent`` would put every number of a matrix on its own."""
    lines = []
    for key, value in content.items():
        text = json.dumps(value)
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], Mapping):
            text = "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def write_json(path: Path, content: Mapping) -> None:
    """Write JSON atomically."""
    with atomic(path) as temporary:
        temporary.write_text(_format(content), encoding="utf-8")


def read_json(path: Path) -> dict:
    """Read a JSON object; missing and damaged files are ValueErrors that name the file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: not found. Is this the right folder, and is the data complete?") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected JSON, cannot read it ({error}).") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, found a {type(content).__name__}.")
    return content


def _schema(path: Path, content: dict) -> dict:
    if content.get("schema") != SCHEMA:
        raise ValueError(
            f"{path}: expected schema {SCHEMA}, found {content.get('schema')!r}. "
            "Generate or import the dataset again with this version of essjax."
        )
    return content


def _check_record(where: str, record: Any) -> None:
    if not isinstance(record, dict) or type(record.get("number")) is not int:
        raise ValueError(f"{where}: expected a frame with its number, got {str(record)[:60]}. The file is damaged.")
    expected = {field.name for field in dataclasses.fields(Camera)}
    for key in ("camera", "native_camera"):
        camera = record.get(key)
        if camera is not None and (not isinstance(camera, dict) or set(camera) != expected):
            found = ", ".join(camera) if isinstance(camera, dict) else repr(camera)
            raise ValueError(
                f"{where}, frame {record['number']}: {key}: expected {', '.join(sorted(expected))}, got {found}."
            )


def read_sequence_info(root: str | os.PathLike, name: str) -> SequenceInfo:
    """Read ``sequence.json`` of a sequence, finished or not.

    Raises:
      ValueError: it is missing, damaged, of another schema, or lacks a field.
    """
    path = Path(root) / name / "sequence.json"
    content = _schema(path, read_json(path))
    content = {"ranges": False, "skipped": [], **content}  # datasets older than these
    fields = [field.name for field in dataclasses.fields(SequenceInfo)]
    missing = [field for field in fields if field not in content]
    if missing:
        raise ValueError(f"{path}: the fields {', '.join(missing)} are missing.")
    for field in ("channels", "frames", "skipped"):
        if not isinstance(content[field], list):
            raise ValueError(f"{path}: {field}: expected a list, got {content[field]!r}.")
        content[field] = tuple(content[field])
    for index, record in enumerate((*content["frames"], *content["skipped"])):
        _check_record(f"{path}, record {index}", record)
    if len({record.get("exposure") is None for record in content["frames"]}) > 1:
        raise ValueError(f"{path}: exposure: expected a number for all frames, or null for all; the file is damaged.")
    return SequenceInfo(**{field: content[field] for field in fields})


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
    try:
        names, source, splits = list(content["sequences"]), dict(content["source"]), dict(content["splits"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: a field is missing or has the wrong form ({error!r}).") from error
    return names, source, splits


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
    try:
        resolved = {split: tuple(Segment(**entry) for entry in entries) for split, entries in splits.items()}
    except (TypeError, AttributeError) as error:
        raise ValueError(f"{file}: a field is missing or has the wrong form ({error!r}).") from error
    sequences = {name: read_sequence_info(root, name) for name in names}
    if not sequences:
        raise ValueError(f"{file}: expected at least one sequence, got none.")
    _check_sequences(file, sequences.values())
    for split, segments in resolved.items():
        for segment in segments:
            _check_segment(file, split, segment, sequences)
    return Dataset(root, source, sequences, resolved)


def stack_planes(channels: Mapping[str, np.ndarray], image: str) -> np.ndarray:
    """``[H, W, C]`` float32 (ids int32) from the planes of one image."""
    dtype = np.int32 if image == "stencil" else np.float32
    return np.stack([channels[name] for name in channel_names(image)], axis=-1).astype(dtype)


def split_planes(image: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Inverse of ``stack_planes``: planes by channel name."""
    return {name: values[..., i] for i, name in enumerate(channel_names(image))}
