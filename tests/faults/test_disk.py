"""A disk that is full, or does not let us: one line that names the file, and what was there stays."""

import contextlib
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import cli
from essjax.data import exr
from essjax.data.exr_text import is_whole
from essjax.data.importing.stream import BrokenFrame
from essjax.files import atomic, naming
from essjax.methods import bilinear, save
from essjax.train import Checkpoints
from experiments import run
from tests.train import tiny_run


@contextlib.contextmanager
def room(most):
    """Files may have so many bytes: as on a full disk, ``write`` is what fails."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_no_room_for_a_checkpoint(tmp_path):
    """One line, where orbax printed up to 154 lines of tracebacks whatever was caught; the one before stays."""
    state, checkpoints = {"w": jnp.arange(99.0)}, Checkpoints(tmp_path)
    checkpoints.save(1, state, {"seconds": 1.0})
    message = f"{tmp_path / '2'}: cannot write the checkpoint \\(.*too large.*\\); checkpoint 1 is as it was"
    with room(200), pytest.raises(ValueError, match=message) as caught:
        checkpoints.save(2, state, {"seconds": 2.0})
    assert "\n" not in str(caught.value) and not (tmp_path / "2").exists()
    assert checkpoints.restore(state)[1] == {"seconds": 1.0}
    checkpoints.save(2, state, {"seconds": 2.0})
    assert checkpoints.restore(state)[1] == {"seconds": 2.0}
    checkpoints.close()


def test_no_room_for_the_log(tmp_path):
    """The error names the file, and the resumed run is that of an undisturbed one."""

    def on_step(step, progress, terms):
        if step == 2:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: '.*log\.jsonl'"):
        tiny_run.run(tmp_path, on_step=on_step)


@pytest.mark.parametrize("most", [0, 100, 340, 400])
def test_no_room_for_the_end_of_an_image(tmp_path, most):
    """OpenEXR writes a small file, or the last kilobytes of a large one, when it is closed, and says nothing."""
    planes, path = {"R": np.arange(48.0).reshape(6, 8), "depth.Z": np.ones((6, 8))}, tmp_path / "a.exr"
    exr.write(path, planes)
    whole = path.read_bytes()
    assert len(whole) > 410
    with room(most), pytest.raises((ValueError, OSError), match=r"a\.exr.*(Is the disk full|disk full|too large)"):
        exr.write(path, {name: 2 * plane for name, plane in planes.items()})
    assert path.read_bytes() == whole and [file.name for file in tmp_path.iterdir()] == ["a.exr"]
    with path.open("r+b") as file:
        file.truncate(len(whole) - 1)
    assert not is_whole(path)


def test_errors_of_the_system_name_the_file(tmp_path):
    """``write`` says "No space left on device" and nothing else."""
    with pytest.raises(OSError, match=r"No space left on device: '.*x\.json'"), atomic(tmp_path / "x.json"):
        raise OSError(28, "No space left on device")
    with pytest.raises(OSError, match="'other'"), naming(tmp_path):
        raise OSError(28, "No space left on device", "other")
    assert not list(tmp_path.iterdir())


def test_weights_that_cannot_be_written(tmp_path):
    (tmp_path / "w").mkdir()
    with room(50), pytest.raises((ValueError, OSError), match=r"w/x\.safetensors") as caught:
        save(tmp_path / "w" / "x.safetensors", bilinear(), {"a": {"b": np.ones(100, np.float32)}})
    assert "\n" not in str(caught.value) and not list((tmp_path / "w").iterdir())


def test_no_plugin_for_the_platform(monkeypatch, capsys, tmp_path):
    """A subprocess would start JAX for it: this one asks JAX as it is, which has its platforms already."""

    def devices():
        raise AssertionError

    monkeypatch.setattr(jax, "devices", devices)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    message = "JAX_PLATFORMS=cuda: JAX cannot run there (there is no plugin for it). Install its plugin"
    for main, arguments in ((cli.main, ["check", str(tmp_path)]), (run.main, ["--list"])):
        code = main(arguments)
        output = capsys.readouterr().out
        assert code == 2 and message in output and output.count("\n") == 1


def test_a_seed_without_end(capsys, tmp_path):
    assert run.main(["--preset", "smoke", "--set", "seed=99999999999999999999", "--out", str(tmp_path / "x")]) == 2
    output = capsys.readouterr().out
    assert "--set seed: expected at least 0 and less than 2.14748e+09, got 99999999999999999999." in output
    assert output.count("\n") == 1 and not (tmp_path / "x").exists()


def test_errors_name_sequence_and_frame_once():
    """As they are printed, and as they are kept in sequence.json: whoever catches it says where it was."""
    error = ValueError("sequence a, frame 9: channel color: expected finite values")
    assert str(BrokenFrame("a", 9, error, "")) == "channel color: expected finite values"
    assert str(BrokenFrame("a", 8, error, "")) == str(error)
