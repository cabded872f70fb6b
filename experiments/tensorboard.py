"""``--tensorboard``: the terms of every step and the validations as TensorBoard events."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def check_installed() -> None:
    """Refuse ``--tensorboard`` without the package that writes its events.

    Raises:
      ValueError: tensorboardX is not installed.
    """
    if importlib.util.find_spec("tensorboardX") is None:
        raise ValueError(
            "--tensorboard: expected the package tensorboardX, which is not installed. "
            "Run pip install 'essjax[tensorboard]', or leave --tensorboard away."
        )


class Events:
    """Writes numbers into ``FOLDER/STAGE``; a run that resumes replaces what came after its checkpoint."""

    def __init__(self, folder: Path):
        """Nothing is written before the first number."""
        self._folder = folder
        self._writers: dict[str, Any] = {}

    def add(self, stage: str, step: int, values: Mapping[str, float], *, group: str) -> None:
        """Add ``values`` of ``step`` as ``group/NAME``."""
        if stage not in self._writers:
            from tensorboardX import SummaryWriter

            name = f".from-step-{step}"  # two files of the same second would be one
            self._writers[stage] = SummaryWriter(str(self._folder / stage), purge_step=step, filename_suffix=name)
        for name, value in values.items():
            self._writers[stage].add_scalar(f"{group}/{name}", value, step)

    def close(self) -> None:
        """Write what is left."""
        for writer in self._writers.values():
            writer.close()
