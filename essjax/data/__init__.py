"""Datasets on disk, import of renders, and the loader. Files: ``layout``; conventions: docs/conventions.md."""

from essjax.data.augment import crop, flip, start_with_cut, without_buffers
from essjax.data.importing import PRESETS, ImportReport, import_dataset
from essjax.data.layout import Dataset, Segment, SequenceInfo, read_dataset, write_dataset
from essjax.data.loader import CachedSource, Source, clips, disk_source
from essjax.data.mixed import Mixed
from essjax.data.read import read_segment, read_sequence
from essjax.data.rounds import Rounds
from essjax.data.store import SequenceWriter, write_sequence
from essjax.data.successive import successive_clips

__all__ = [
    "PRESETS", "CachedSource", "Dataset", "ImportReport", "Mixed", "Rounds", "Segment", "SequenceInfo",
    "SequenceWriter", "Source", "clips", "crop", "disk_source", "flip", "import_dataset", "read_dataset",
    "read_segment", "read_sequence", "start_with_cut", "successive_clips", "without_buffers",
    "write_dataset", "write_sequence",
]  # fmt: skip
