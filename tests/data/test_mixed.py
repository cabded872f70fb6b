"""Batches of several tasks: fair turns, exact resumption."""

import itertools

import pytest

from essjax.data import Mixed


class Counting:
    def __init__(self, name):
        self.name, self.number = name, 0

    def __next__(self):
        self.number += 1
        return f"{self.name}{self.number}"

    def get_state(self):
        return self.number

    def set_state(self, state):
        self.number = state


def mixed(seed=3):
    return Mixed({name: Counting(name) for name in "abc"}, seed=seed)


def test_every_task_comes_once_in_each_turn_in_changing_order():
    found = list(itertools.islice(mixed(), 30))
    turns = [found[n : n + 3] for n in range(0, 30, 3)]
    for number, turn in enumerate(turns, start=1):
        assert sorted(turn) == [(name, f"{name}{number}") for name in "abc"]
    assert len({tuple(task for task, _ in turn) for turn in turns}) > 2
    assert found != list(itertools.islice(mixed(seed=4), 30))


def test_a_resumed_one_goes_on_exactly():
    whole, first, second = list(itertools.islice(mixed(), 11)), mixed(), mixed()
    begun = list(itertools.islice(first, 5))
    second.set_state(first.get_state())
    assert begun + list(itertools.islice(second, 6)) == whole


def test_errors():
    with pytest.raises(ValueError, match="mixed batches: expected at least one task, got none"):
        Mixed({})
    state = Mixed({"a": Counting("a")}).get_state()
    with pytest.raises(ValueError, match="expected a state of the tasks a, b, c, got one of a. Resume with"):
        mixed().set_state(state)
