"""Requests: what a run was asked for, and whether its folder is free for that."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from essjax.data.json_files import read_json
from experiments.settings import Settings, flatten


class Request(NamedTuple):
    """All that a command line asks for.

    Attributes:
      names: the variants.
      preset: name of the preset.
      overrides: ``--set``.
      data: a dataset's folder, or None to render the built-in scenes into ``out``.
      out: folder of the results.
      resume: go on with the run in ``out``.
      eval_only: do not train, restore.
      tensorboard: write TensorBoard events beside the checkpoints.
    """

    names: tuple[str, ...]
    preset: str
    overrides: tuple[str, ...]
    data: str | None
    out: Path
    resume: bool = False
    eval_only: bool = False
    tensorboard: bool = False


def default_folder(name: str, preset: str, data: str | None) -> Path:
    """Where a run goes without ``--out``: ``runs/NAME-PRESET``, with ``--data`` ``runs/NAME-PRESET-`` and its name."""
    return Path("runs") / "-".join([name, preset, *([Path(data).resolve().name] if data else [])])


def run_record(request: Request, settings: Mapping[str, Settings]) -> dict[str, Any]:
    """Return what ``out / "run.json"`` says of a run: variants, data, and each setting under its path."""
    flat = {f"{name}:{path}": value for name, own in settings.items() for path, value in flatten(own).items()}
    if len(settings) == 1:
        flat = {key.partition(":")[2]: value for key, value in flat.items()}
    return {"variants": list(request.names), "data": request.data, **flat}


def check_folder(out: Path, wanted: Mapping[str, Any], *, resume: bool, eval_only: bool) -> None:
    """Refuse to mix two runs in ``out`` or to start over one that can be resumed; ``out / "run.json"`` says what it is.

    Nothing is written: a run that finds no data leaves nothing that stands in the way of the next.

    Raises:
      ValueError: ``out`` holds another run, or one that was not asked to continue.
    """
    path, wanted = out / "run.json", json.loads(json.dumps(wanted))
    if path.exists():
        found = read_json(path)
        if not (resume or eval_only):
            raise ValueError(
                f"{out} already holds a run. Continue it with --resume, evaluate it with --eval-only, "
                "or choose another --out."
            )
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            pairs = ", ".join(f"{key} was {found.get(key)}, now {wanted[key]}" for key in different)
            raise ValueError(f"{out} holds a run with other settings: {pairs}. Use the same ones, or another --out.")
    elif eval_only:
        raise ValueError(f"--eval-only: {out} holds no run. Give the --out of a trained one.")
