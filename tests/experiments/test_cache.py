"""Where compiled programs are kept, who decides, and that they do not pile up."""

import os

import jax
import pytest

from experiments import compare, run
from experiments.cache import keep_programs, shrink
from experiments.tables import __main__ as tables


@pytest.fixture
def nothing_chosen(monkeypatch, tmp_path):
    """JAX as users start it, their cache in ``tmp_path``; the suite's own settings come back."""
    names = (
        "jax_compilation_cache_dir", "jax_enable_compilation_cache", "jax_persistent_cache_min_compile_time_secs",
    )  # fmt: skip
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield tmp_path / "essjax" / "programs"
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_in_the_users_cache(nothing_chosen):
    assert keep_programs() == nothing_chosen and nothing_chosen.is_dir()
    assert jax.config.jax_compilation_cache_dir == str(nothing_chosen)
    assert jax.config.jax_enable_compilation_cache


def test_a_folder_that_was_chosen_is_left_as_it_is(nothing_chosen, tmp_path):
    (tmp_path / "mine").mkdir()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))  # what JAX_COMPILATION_CACHE_DIR does
    assert keep_programs() == tmp_path / "mine"
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine") and not nothing_chosen.exists()


def test_without_a_cache_nothing_is_made(nothing_chosen):
    assert keep_programs(False) is None
    assert not jax.config.jax_enable_compilation_cache and not nothing_chosen.exists()


def test_a_home_that_cannot_be_written_is_no_error(nothing_chosen, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert keep_programs() is None and jax.config.jax_compilation_cache_dir is None


@pytest.mark.parametrize("command", [run, compare, tables])
def test_every_command_has_the_switch(command):
    assert command.parse([]).compilation_cache
    assert not command.parse(["--no-compilation-cache"]).compilation_cache


def test_what_was_not_used_for_longest_goes_first(tmp_path):
    for age, name in enumerate(("new", "middle", "old", "oldest")):
        (tmp_path / name).write_bytes(b"x" * 10)
        os.utime(tmp_path / name, (1000 - age, 500))
    shrink(tmp_path, 25)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["middle", "new"]
    shrink(tmp_path, 25)
    assert len(list(tmp_path.iterdir())) == 2
