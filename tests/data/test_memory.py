"""What stays in memory: never more than the bound, and what is free as the system tells it."""

import numpy as np
import pytest

from essjax.data import memory
from essjax.data.memory import Kept, free_memory

GB = 1 << 30


def ask(kept, key, count=100):
    """Ask for an array of ``count`` bytes; whether it had to be made."""
    made = []
    value = kept.get(key, lambda: made.append(key) or {"values": np.full(count, key, np.uint8)})
    assert (value["values"] == key).all()
    return bool(made)


def test_what_came_first_stays_within_the_bound():
    kept = Kept(250)
    assert [ask(kept, key) for key in (1, 2, 3, 1, 2, 3)] == [True, True, True, False, False, True]
    assert kept.size == 200
    assert ask(kept, 4, 50) and not ask(kept, 4, 50) and kept.size == 250
    assert ask(Kept(0), 1)


def test_without_a_bound_half_of_the_free_memory_is_used(monkeypatch):
    """1000 bytes are free at first: five arrays of 100 leave 500 beside them."""
    kept = Kept()
    monkeypatch.setattr(memory, "free_memory", lambda: 1000 - kept.size - 100)  # 100: of the array just made
    for key in range(8):
        ask(kept, key)
    assert kept.size == 500


def write(root, path, text):
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    (root / path).write_text(text)


def machine(root, groups):
    write(root, "proc/meminfo", f"MemTotal: 99 kB\nMemFree: 1 kB\nMemAvailable:    {16 << 20} kB\n")
    write(root, "proc/self/cgroup", groups)


def limit(root, folder, names, most, used, cached):
    for name, value in zip((*names, "memory.stat"), (most, used, f"anon 5\ninactive_file {cached}"), strict=True):
        write(root, f"sys/fs/cgroup/{folder}/{name}", f"{value}\n")


NEW, OLD = ("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")


@pytest.mark.parametrize(
    ("limits", "free"),
    [
        ([], 16),
        ([("job/step", NEW, 8 * GB, 3 * GB, GB)], 6),  # what was read from files makes room
        ([("job/step", NEW, "max", 3 * GB, 0), ("job", NEW, 4 * GB, 3 * GB, 0)], 1),  # of the group around it
        ([("", NEW, 2 * GB, 3 * GB, 0)], 0),
        ([("job", NEW, 90 * GB, 3 * GB, 0)], 16),
    ],
)
def test_free_memory_is_that_of_the_machine_or_of_the_group(tmp_path, limits, free):
    machine(tmp_path, "0::/job/step\n")
    for each in limits:
        limit(tmp_path, *each)
    assert free_memory(tmp_path) == free * GB


def test_free_memory_of_older_groups(tmp_path):
    machine(tmp_path, "9:name=systemd:/\n4:cpu,memory:/docker/1\n0::/\n")
    limit(tmp_path, "memory/docker/1", OLD, 5 * GB, 3 * GB, GB // 2)
    limit(tmp_path, "memory", OLD, 2**63 - 4096, 3 * GB, 0)
    assert free_memory(tmp_path) == 2.5 * GB


def test_where_nothing_is_known_a_fixed_number_counts_as_free(tmp_path):
    assert free_memory(tmp_path) == memory.UNKNOWN
    assert 0 < free_memory() < 2**50
