"""Training, validation and test ranges of imported clips."""

import itertools
from collections.abc import Mapping, Sequence

from essjax.data.layout import Segment

SPLITS = ("train", "validation", "test")
Range = tuple[int, int] | Sequence[str]
"""Numbers of the first and the last frame, both included, or names of sequences."""


def default_splits(first: int, last: int) -> dict[str, tuple[int, int]]:
    """First and last frame of 60 % train, 10 % validation, 30 % test, in this order; below 10 frames all is test."""
    length = last - first + 1
    if length < 10:
        return {"test": (first, last)}
    train, validation = first + int(0.6 * length), max(1, round(0.1 * length))
    return {
        "train": (first, train - 1),
        "validation": (train, train + validation - 1),
        "test": (train + validation, last),
    }


def split_segments(clips: Mapping[str, Sequence[int]], wanted: Mapping[str, Range] | None) -> dict[str, list[Segment]]:
    """Segments of each split. Validation and test are streamed from the clip's first frame and scored in their range.

    Args:
      clips: sequence -> the numbers of its frames.
      wanted: all of "train", "validation" and "test" -> frames of every sequence, or names of sequences. None: with
        three sequences or more whole sequences (60, 10 and 30 %, at least one each), else ``default_splits`` of each.

    Raises:
      ValueError: a split is missing, a range lies outside, a name is unknown, or two splits share a frame.
    """
    missing = [split for split in SPLITS if not (wanted is None or wanted.get(split))]
    if missing:
        raise ValueError(f"splits: {', '.join(missing)} missing. Give train, validation and test, or none of them.")
    if wanted is None and len(clips) >= 3:
        wanted = _by_sequence(list(clips))
    segments: dict[str, list[Segment]] = {}
    for name, numbers in clips.items():
        ranges = default_splits(numbers[0], numbers[-1]) if wanted is None else wanted
        for split, chosen in ranges.items():
            if isinstance(chosen[0], str):
                if name in chosen:
                    segments.setdefault(split, []).append(Segment(name, numbers[0], numbers[-1], numbers[0]))
            else:
                segments.setdefault(split, []).append(_segment(name, numbers, split, chosen))
    for split, chosen in (wanted or {}).items():
        unknown = [name for name in chosen if isinstance(name, str) and name not in clips]
        if unknown:
            raise ValueError(
                f"{split}: there is no sequence {unknown[0]!r}; there are {', '.join(clips)}. Frames are given as "
                "FIRST:LAST, such as 8:19."
            )
    _check_overlap(segments)
    return segments


def _check_overlap(segments: Mapping[str, Sequence[Segment]]) -> None:
    """Warm-up may run over frames of another split; what is trained on or scored may not."""
    scored: dict[str, list[tuple[str, Segment]]] = {}
    for split, part in segments.items():
        for segment in part:
            scored.setdefault(segment.sequence, []).append((split, segment))
    for mine in scored.values():
        for (other, a), (split, b) in itertools.combinations(mine, 2):
            first, last = max(a.score_from, b.score_from), min(a.last, b.last)
            if split != other and first <= last:
                raise ValueError(
                    f"splits: {other} and {split} share the frames {first}..{last} of {a.sequence}. A frame that is "
                    "trained on says nothing in a test: choose ranges that do not overlap."
                )


def _by_sequence(names: list[str]) -> dict[str, list[str]]:
    train = min(max(1, int(0.6 * len(names))), len(names) - 2)
    test = len(names) - max(1, int(0.3 * len(names)))
    test = max(test, train + 1)
    return {"train": names[:train], "validation": names[train:test], "test": names[test:]}


def _segment(name: str, numbers: Sequence[int], split: str, chosen: Sequence) -> Segment:
    start, last = chosen
    if not numbers[0] <= start <= last <= numbers[-1]:
        raise ValueError(
            f"{split}: expected first <= last within the frames {numbers[0]}..{numbers[-1]}, got {start}..{last}."
        )
    return Segment(name, start if split == "train" else numbers[0], last, start)


def fit_segments(
    segments: Mapping[str, Sequence[Segment]], clips: Mapping[str, Sequence[int]]
) -> dict[str, list[Segment]]:
    """Fit the segments into the frames that were written: broken ones may be missing at the ends."""
    fitted: dict[str, list[Segment]] = {}
    for split, wanted in segments.items():
        for segment in wanted:
            inside = [n for n in clips[segment.sequence] if segment.first <= n <= segment.last]
            scored = [n for n in inside if n >= segment.score_from]
            if scored:
                kept = Segment(segment.sequence, inside[0], inside[-1], scored[0])
                fitted.setdefault(split, []).append(kept)
    return fitted
