"""Two commands on one folder: one goes on, the other says who is there; nothing of either is torn or removed."""

import re
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest

from essjax.builtin import generate, plan
from essjax.data import import_dataset
from essjax.files import LOCK, atomic, only_writer
from essjax.train import Checkpoints
from experiments import run
from tests.data.importing.test_blender import dump  # noqa: F401  a fixture
from tests.faults.test_checkpoints import state_of


def test_the_second_is_refused_and_told_who_is_there(tmp_path):
    folder = tmp_path / "a" / "b"
    with only_writer(folder):
        message = rf"{folder}: another command writes into this folder \(process \d+ on \S+ since \d.*\)\. Wait until"
        with pytest.raises(ValueError, match=message), only_writer(folder):
            pass
        with only_writer(tmp_path / "other"):  # a shard of its own
            pass
        assert (folder / LOCK).exists()
        (folder / "result").touch()
    assert [path.name for path in folder.iterdir()] == ["result"]
    with only_writer(folder):
        pass


def test_nothing_is_left_where_nothing_was_written(tmp_path):
    with pytest.raises(KeyError), only_writer(tmp_path / "a" / "b"):
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_a_lock_ends_with_its_process_and_what_it_left_is_removed(tmp_path):
    script = (
        "import sys, time; from essjax.files import atomic, only_writer\n"
        "with only_writer(sys.argv[1]), atomic(sys.argv[1] + '/x.json') as half:\n"
        "    half.touch(); print('in', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE)
    process.stdout.readline()
    with pytest.raises(ValueError, match=f"process {process.pid} on"), only_writer(tmp_path):
        pass
    assert len(list(tmp_path.iterdir())) == 2  # nothing of the other's is removed
    process.kill()
    process.wait()
    with only_writer(tmp_path):
        assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_locks_that_come_and_go_exclude_each_other(tmp_path):
    """Three processes count in one file; a count is a read and a write. The lock is removed each time."""
    script = (
        "import pathlib, sys; from essjax.files import only_writer\n"
        "count, done = pathlib.Path(sys.argv[1], 'count'), 0\n"
        "while done < 60:\n"
        "    try:\n"
        "        with only_writer(sys.argv[1]):\n"
        "            count.write_text(str(int(count.read_text()) + 1))\n"
        "        done += 1\n"
        "    except ValueError: pass"
    )
    (tmp_path / "count").write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", script, str(tmp_path)]) for _ in range(3)]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert (tmp_path / "count").read_text() == "180"


def test_two_that_write_one_file_do_not_tear_it(tmp_path):
    path, both = tmp_path / "a.json", threading.Barrier(2)

    def write(text):
        with atomic(path) as temporary:
            temporary.write_text(text)
            both.wait()

    threads = [threading.Thread(target=write, args=(text,)) for text in ("one", "two")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_text() in ("one", "two") and [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_file_is_no_folder(tmp_path):
    """Noticed before anything is rendered."""
    (tmp_path / "afile").touch()
    message = f"{tmp_path / 'afile' / 'x'}: expected a folder, but {tmp_path / 'afile'} is a file. Choose another one."
    with pytest.raises(ValueError, match=re.escape(message)):
        generate(tmp_path / "afile" / "x", plan("train", 1, 2), 8, 6)


def test_every_writer_takes_the_lock(tmp_path, dump, capsys):  # noqa: F811
    refused = pytest.raises(ValueError, match="another command writes into this folder")
    with only_writer(tmp_path / "out"):
        with refused:
            generate(tmp_path / "out", plan("train", 1, 2), 8, 6)
        with refused:
            import_dataset(dump, tmp_path / "out", "blender")
        assert run.main(["--preset", "smoke", "--out", str(tmp_path / "out")]) == 2
        output = capsys.readouterr().out
        assert output.count("\n") == 1 and "another command writes into this folder" in output
        assert [path.name for path in (tmp_path / "out").iterdir()] == [LOCK]


def test_two_that_save_into_one_folder(tmp_path):
    """The first one's half-written checkpoint is not taken for a leftover."""
    first, second = Checkpoints(tmp_path), Checkpoints(tmp_path)
    first.save(1, state_of(1), {})
    half = tmp_path / "2.unfinished"
    half.mkdir()
    with pytest.raises(ValueError, match="another command writes into this folder"):
        second.save(1, state_of(5), {})
    assert half.exists()
    first.close()
    second.save(2, state_of(2), {})
    jax.tree.map(np.testing.assert_array_equal, second.restore(state_of(0))[0], state_of(2))
    second.close()
