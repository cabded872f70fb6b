"""The frames that are looked at: pairs of neighbours spread over each sequence, one at a time in memory."""

import dataclasses
from collections.abc import Iterator, Mapping

import jax
import numpy as np

from essjax.data.layout import Dataset, SequenceInfo
from essjax.data.read import read_sequence
from essjax.frames import Frame, Sequence, frame_images, select_time
from essjax.sizes import Size

GOLDEN = 0.5 * (5**0.5 - 1)
"""Multiples of it, modulo 1, fill [0, 1) evenly and have no period."""


@dataclasses.dataclass(frozen=True)
class Step:
    """A frame, and the one before it where there is one. NumPy leaves ``[H, W, C]``; no NaN, no negative colour.

    Attributes:
      sequence: name of the sequence.
      number: of the frame.
      cut: whether the dataset says that this frame begins a shot.
      raw: the images as they are in the files, by name, "reference" among them.
      now: the frame.
      before: the frame before; None for the first of the sequence, and after a gap in the numbers.
      reference: of the frame.
      reference_before: of the frame before.
      mask: ``[H, W]`` bool, where the dataset itself says that the previous frame shows the same, equally lit surface;
        all true where it has no masks.
      exact: whether ``mask`` comes from the dataset.
      key: median radiance of the reference: what tone mapping calls middle grey.
    """

    sequence: str
    number: int
    cut: bool
    raw: Mapping[str, np.ndarray]
    now: Frame
    before: Frame | None
    reference: np.ndarray
    reference_before: np.ndarray | None
    mask: np.ndarray
    exact: bool
    key: float

    @property
    def size(self) -> Size:
        """Height and width of the rendered frame."""
        return self.now.motion.shape[0], self.now.motion.shape[1]

    @property
    def output(self) -> Size:
        """Height and width of the reference."""
        return self.reference.shape[0], self.reference.shape[1]

    @property
    def where(self) -> str:
        """Sequence and frame, for messages."""
        return f"{self.sequence} {self.number}"


def choose(info: SequenceInfo, pairs: int) -> list[int]:
    """Choose the frames to look at: the first, and up to ``pairs`` later ones, spread; all if 0.

    Half of them are odd and half are even, each in its part of the clip at a place that never repeats: even spacing
    would see only one phase of a jitter that changes every second frame, or of any other period.
    """
    last = len(info.frames) - 1
    count = min(pairs or last, last)
    chosen = [0]
    for indices, share in ((range(1, last + 1, 2), (count + 1) // 2), (range(2, last + 1, 2), count // 2)):
        edges = np.linspace(0, len(indices), share + 1).astype(int)
        places = np.arange(share) * GOLDEN % 1  # in each part, in [0, 1)
        chosen += [indices[i] for i in (edges[:-1] + places * np.diff(edges)).astype(int)]
    return sorted(chosen)


def _clean(image: np.ndarray, fill: float = 0.0) -> np.ndarray:
    return np.where(np.isfinite(image), image, np.float32(fill)) if np.issubdtype(image.dtype, np.floating) else image


def _clean_frame(frame: Frame) -> Frame:
    assert frame.color is not None
    depth = np.where(np.isnan(frame.gbuffers.depth), np.float32(np.inf), frame.gbuffers.depth)
    cleaned = jax.tree.map(_clean, frame)
    gbuffers = dataclasses.replace(cleaned.gbuffers, depth=depth)
    return dataclasses.replace(cleaned, color=np.maximum(cleaned.color, 0.0), gbuffers=gbuffers)


def _key(reference: np.ndarray) -> float:
    lit = reference[reference > 0]
    return float(np.median(lit)) if lit.size else 1.0


def read_step(dataset: Dataset, name: str, number: int) -> Step:
    """Read a frame, with the frame before it where there is one.

    Raises:
      ValueError: a file is missing or damaged; ``read_sequence`` names it. Values are not judged here.
    """
    info = dataset.sequences[name]
    paired = number - 1 in info.numbers
    sequence = read_sequence(dataset, name, (number - paired, number), native=False)
    last: Sequence = select_time(sequence, -1)
    frames = [_clean_frame(select_time(sequence.frames, i)) for i in range(1 + paired)]
    references = np.maximum(_clean(np.asarray(sequence.reference)), 0.0)
    mask = np.ones(frames[-1].motion.shape[:2], bool)
    for known in (last.valid, last.steady):
        if known is not None and paired:
            mask &= np.asarray(known)[..., 0] > 0.5
    raw = {**frame_images(last.frames), "reference": last.reference}
    return Step(
        sequence=name,
        number=number,
        cut=bool(info.frames[info.numbers.index(number)]["cut"]),
        raw={name: np.asarray(image) for name, image in raw.items()},
        now=frames[-1],
        before=frames[0] if paired else None,
        reference=references[-1],
        reference_before=references[0] if paired else None,
        mask=mask,
        exact=last.valid is not None,
        key=_key(references[-1]),
    )


def steps(dataset: Dataset, name: str, pairs: int) -> Iterator[Step]:
    """Read the chosen frames of a sequence, each with the frame before it; see ``choose`` and ``read_step``."""
    info = dataset.sequences[name]
    for index in choose(info, pairs):
        yield read_step(dataset, name, info.numbers[index])
