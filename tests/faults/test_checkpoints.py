"""Damaged checkpoints: never other numbers, the newest whole one instead, and a line that says so."""

import os
import re
import shutil
import stat

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.train import Checkpoints, adam, create_state
from tests.train import tiny_run


def state_of(scale):
    variables = {"net": {"kernel": scale * jnp.arange(6.0).reshape(2, 3)}, "other": {"b": jnp.ones(3)}}
    return create_state(variables, "net", adam())


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Checkpoints 1 and 2."""
    folder = tmp_path_factory.mktemp("saved")
    checkpoints = Checkpoints(folder)
    for step in (1, 2):
        checkpoints.save(step, state_of(step), {"seconds": float(step)})
    checkpoints.close()
    return folder


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))


DAMAGES = {
    "flip": flip,
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
    "delete": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_restored(tmp_path, saved, caplog, damage):
    """Every file in turn. On the old code flips in the data came back as other numbers."""
    files = sorted(path.relative_to(saved) for path in (saved / "2").rglob("*") if path.is_file())
    assert len(files) == 3
    for number, name in enumerate(files):
        folder = tmp_path / str(number)
        shutil.copytree(saved, folder)
        DAMAGES[damage](folder / name)
        caplog.clear()
        checkpoints = Checkpoints(folder)
        state, progress = checkpoints.restore(state_of(0))
        checkpoints.close()
        assert progress == {"seconds": 1.0}
        jax.tree.map(np.testing.assert_array_equal, state, state_of(1))
        (message,) = caplog.messages
        assert re.fullmatch(rf"{folder}: checkpoint 2 is damaged \(.+\); trying checkpoint 1\.", message)
        assert name.name in message or name.name == "SHA256SUMS"


def test_none_is_whole(tmp_path, saved):
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    flip(tmp_path / "2" / "progress.json")
    (tmp_path / "1" / "SHA256SUMS").unlink()
    checkpoints = Checkpoints(tmp_path)
    message = (
        f"{tmp_path}: expected a whole checkpoint, but checkpoint 2 is damaged (progress.json is not what was "
        "written) and checkpoint 1 is damaged (it has no SHA256SUMS: an older essjax wrote it, or it was not copied "
        "whole). Copy the folder back from a backup, or delete it and train again."
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        checkpoints.restore(state_of(0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"]  # reading removes nothing
    checkpoints.close()


def test_sha256sum_knows_the_format(saved):
    if shutil.which("sha256sum"):
        assert os.system(f"cd '{saved / '2'}' && sha256sum --check --strict --quiet SHA256SUMS") == 0


def test_training_goes_on_from_the_whole_one_as_if_nothing_had_happened(tmp_path, caplog):
    """It ends with the numbers of the run that nothing disturbed, and the damaged one is replaced."""
    expected, _ = tiny_run.run(tmp_path / "uninterrupted")
    run = tmp_path / "run"

    class Killed(Exception):
        pass

    def on_step(step, progress, terms):
        if step == 6:
            raise Killed

    with pytest.raises(Killed):
        tiny_run.run(run, on_step=on_step, save_every=0.0)
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["4", "5"]
    flip(run / "checkpoints" / "5" / "state.safetensors")
    steps = []
    found, _ = tiny_run.run(run, on_step=lambda step, progress, terms: steps.append(step), save_every=0.0)
    assert steps[0] == 5 and "checkpoint 5 is damaged" in caplog.text
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_checkpoint_that_cannot_be_written(tmp_path):
    """One line, and what was there stays: here the folder is another user's, or a file is in the way."""
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state_of(1), {"seconds": 1.0})
    (tmp_path / "2.unfinished").write_text("in the way")
    message = rf"{tmp_path / '2'}: cannot write the checkpoint \(.+\); checkpoint 1 is as it was. Is the disk full\?"
    with pytest.raises(ValueError, match=message) as caught:
        checkpoints.save(2, state_of(2), {"seconds": 2.0})
    assert "\n" not in str(caught.value)
    (tmp_path / "2.unfinished").unlink()
    checkpoints.save(2, state_of(2), {"seconds": 2.0})
    assert checkpoints.restore(state_of(0))[1] == {"seconds": 2.0}
    checkpoints.close()
    assert stat.S_ISDIR((tmp_path / "2").stat().st_mode)
