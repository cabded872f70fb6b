"""Without a terminal a run is heard of: a line per phase, and one a minute."""

import io
import re
import time

from rich.console import Console

from experiments.progress import Phases


def shown(*, every, terminal=False):
    """What a run prints that shows two phases, the second for 0.25 seconds without a word."""
    output = io.StringIO()
    with Phases(Console(file=output, width=200, force_terminal=terminal), every=every) as phases:
        phases.show("data", text="rendering [1/2]")
        for n in range(1, 8):
            phases.show("data", n / 7, f"{n}/7")
        phases.show("train", text="compiling")
        time.sleep(0.25)
    return output.getvalue()


def test_a_line_per_phase():
    times, states = zip(*(line.strip().split(" ", 1) for line in shown(every=60.0).splitlines()), strict=True)
    assert states == ("data: rendering [1/2]", "data: 100 % 7/7", "train: compiling")
    assert all(re.fullmatch(r"0:0\d", each) for each in times)


def test_a_line_per_minute_even_if_nothing_new_is_known():
    lines = shown(every=0.1).splitlines()
    assert sum("train: compiling" in line for line in lines) == 3


def test_bars_on_a_terminal():
    printed = shown(every=0.01, terminal=True)
    assert "━" in printed and "compiling" in printed and "0:00 train" not in printed


def test_the_last_state_of_a_run_that_breaks_off_is_printed():
    output = io.StringIO()
    try:
        with Phases(Console(file=output, force_terminal=False)) as phases:
            for n in range(3):
                phases.show("data", n / 3, f"frame {n}")
            raise OSError
    except OSError:
        pass
    assert output.getvalue().splitlines()[-1].endswith("data: 67 % frame 2")
