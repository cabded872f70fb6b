"""The commit that results name is this project's."""

import subprocess

from experiments.environment import commit


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_the_commit_of_another_repository_around_is_not_taken_for_ours(tmp_path):
    inside = tmp_path / "venv" / "site-packages"
    inside.mkdir(parents=True)
    assert commit(inside) == "unknown"
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "theirs")
    assert commit(inside) == "unknown"
    assert commit(tmp_path) == git(tmp_path, "rev-parse", "--short=12", "HEAD")
