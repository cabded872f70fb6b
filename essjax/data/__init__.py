"""Datasets on disk, import of renders, and the loader. Files: ``layout``; conventions: docs/conventions.md."""

from essjax.data.layout import Dataset, Segment, SequenceInfo, read_dataset, write_dataset
from essjax.data.presets import PRESETS, ImportReport, import_dataset
from essjax.data.store import SequenceWriter, read_segment, read_sequence, write_sequence

__all__ = [
    "PRESETS", "Dataset", "ImportReport", "Segment", "SequenceInfo", "SequenceWriter", "import_dataset",
    "read_dataset", "read_segment", "read_sequence", "write_dataset", "write_sequence",
]  # fmt: skip
