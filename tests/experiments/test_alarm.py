"""XLA's alarm about slow compilation is gone, everything else on stderr is still there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.alarm import no_alarm, without_alarm

STARS = b"********************************\n"
SLOW = b"[Compiling module jit_step] Very slow compile? If you want to file a bug, run with envvar XLA_FLAGS=...\n"
ALARM = [b"E1128 14:00:00.1 77 slow_operation_alarm.cc:73] \n", STARS, SLOW, STARS]
LATER = [b"E1128 14:01:00.1 77 slow_operation_alarm.cc:140] The operation took 2m3s\n", b"\n", STARS, SLOW, STARS]
FOLDING = [
    b"E1128 14:00:00.1 7 slow_operation_alarm.cc:73] Constant folding is taking > 1s:\n",
    b"  %x\n",
]
ERROR = [b"E1128 14:00:00.1 77 cuda_executor.cc:11] out of memory\n"]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (ALARM, []),
        (ERROR + ALARM + LATER + ERROR + [b"x\n"], [*ERROR, *ERROR, b"x\n"]),
        (FOLDING + ALARM + FOLDING, FOLDING + FOLDING),
        ([*FOLDING[:1], b"\n", *ALARM, b"\n"], [*FOLDING[:1], b"\n", b"\n"]),
        (ALARM[:1], ALARM[:1]),  # cut off: rather too much than too little
        ([STARS, *ERROR, STARS], [STARS, *ERROR, STARS]),
    ],
)
def test_what_is_left(lines, expected):
    assert list(without_alarm(lines)) == expected


def test_stderr_of_the_process_itself(capfd):
    """Written below Python, as XLA does; in the order in which it came, and afterwards as before."""
    with no_alarm():
        for line in [*ERROR, *ALARM, b"a warning\n"]:
            os.write(2, line)
        print("from Python", file=sys.__stderr__)
    os.write(2, b"afterwards\n")
    captured = capfd.readouterr().err
    assert captured == ERROR[0].decode() + "a warning\nfrom Python\nafterwards\n"


def test_the_last_words_of_a_crash_pass():
    program = (
        "import os\nfrom experiments.alarm import no_alarm\n"
        "with no_alarm():\n    os.write(2, b'fatal: no such thing'); os.abort()"
    )
    run = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, cwd=Path(__file__).parents[2])
    assert run.returncode != 0 and run.stderr == b"fatal: no such thing"
