"""Datasets on disk, import of renders, and the loader. Files: ``layout``; conventions: docs/conventions.md."""

from essjax.data.layout import Dataset, Segment, SequenceInfo, read_dataset, write_dataset
from essjax.data.store import SequenceWriter, read_segment, read_sequence, write_sequence

__all__ = [
    "Dataset", "Segment", "SequenceInfo", "SequenceWriter", "read_dataset", "read_segment", "read_sequence",
    "write_dataset", "write_sequence",
]  # fmt: skip
