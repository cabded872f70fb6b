"""TensorBoard events: what a run writes, and what it says without the package."""

import importlib.util
import io

import pytest
from rich.console import Console

from experiments import run
from experiments.progress import Phases, TrainingProgress
from experiments.tensorboard import Events


def read(folder):
    """(name, step) -> value in the order of the files; a restart drops what came from its step on."""
    from tensorboardX.proto.event_pb2 import Event

    found = {}
    for path in sorted(folder.iterdir(), key=lambda path: (path.stat().st_mtime_ns, path.name)):
        content = path.read_bytes()
        while content:  # records: length, its checksum, data, its checksum
            length = int.from_bytes(content[:8], "little")
            event, content = Event.FromString(content[12 : 12 + length]), content[16 + length :]
            if event.HasField("session_log"):
                found = {key: value for key, value in found.items() if key[1] < event.step}
            found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
    return found


def test_terms_and_validations_are_events_and_a_resumed_run_replaces_what_it_repeats(tmp_path):
    pytest.importorskip("tensorboardX")
    for steps in ((1, 2, 3), (3, 4)):  # the first run was killed after a checkpoint at step 2
        with Phases(Console(file=io.StringIO())) as phases:
            progress = TrainingProgress(phases, "", Events(tmp_path))
            for step in steps:
                progress.on_step("net", step, step / 4, {"loss": step + len(steps) / 10, "gradient_norm": 1.0})
            progress.on_validation("net", steps[-1], 1.0, {})
            progress.on_validation("net", steps[-1], 1.0, {"ss": 20.0 + steps[-1]})
            progress.close()
    found = read(tmp_path / "net")
    assert {key[1]: pytest.approx(value) for key, value in found.items() if key[0] == "train/loss"} == {
        1: 1.3, 2: 2.3, 3: 3.2, 4: 4.2
    }  # fmt: skip
    assert {key[1]: value for key, value in found.items() if key[0] == "validation/ss"} == {4: 24.0}


def test_without_the_package_the_flag_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert run.main(["--preset", "smoke", "--tensorboard", "--out", str(tmp_path / "out")]) == 2
    assert "expected the package tensorboardX, which is not installed" in capsys.readouterr().out.replace("\n", " ")
    assert not (tmp_path / "out").exists()
