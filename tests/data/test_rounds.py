"""Rounds of sequences, each made while the one before it is used."""

import itertools
import json
import threading

import pytest

from essjax.data import Rounds


class Batches:
    """Numbers ``100 r``, ``100 r + 1``, ... of round r, with a state as grain's iterators have."""

    def __init__(self, number):
        self.number, self.position = number, 0

    def __next__(self):
        self.position += 1
        return 100 * self.number + self.position - 1

    def get_state(self):
        return {"position": self.position}

    def set_state(self, state):
        self.position = state["position"]


def take(rounds, count):
    return list(itertools.islice(rounds, count))


def test_rounds_change_after_so_many_batches():
    assert take(Rounds(Batches, 3), 8) == [0, 1, 2, 100, 101, 102, 200, 201]


@pytest.mark.parametrize("before", [0, 1, 3, 5, 6])
def test_a_resumed_iterator_continues(before):
    first = Rounds(Batches, 3)
    take(first, before)
    state = json.loads(json.dumps(first.get_state()))
    second = Rounds(Batches, 3)
    take(second, 2)  # what it did before does not matter
    second.set_state(state)
    assert take(second, 7) == take(first, 7)


def test_the_next_round_is_made_meanwhile_and_waited_for():
    begun, go = threading.Event(), threading.Event()

    def make(number):
        if number == 1:
            begun.set()
            assert go.wait(10)
        return Batches(number)

    rounds = Rounds(make, 2)
    assert take(rounds, 2) == [0, 1] and begun.wait(10)
    threading.Timer(0.05, go.set).start()
    assert take(rounds, 1) == [100]


def test_nothing_is_made_before_it_is_asked_for():
    made = []
    rounds = Rounds(lambda number: made.append(number) or Batches(number), 2)
    assert rounds.get_state() == {"round": 0, "taken": 0, "inner": None} and not made


def test_what_a_round_raises_is_raised_at_its_turn():
    def make(number):
        if number == 1:
            raise ValueError("no such scene")
        return Batches(number)

    rounds = Rounds(make, 2)
    assert take(rounds, 2) == [0, 1]
    with pytest.raises(ValueError, match="no such scene"):
        next(rounds)
    with pytest.raises(ValueError, match="expected at least 1 batch of each, got 0"):
        Rounds(make, 0)
