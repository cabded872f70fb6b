"""Keeps XLA's "Very slow compile?" from the terminal: on a busy machine it says nothing that the user can act on.

XLA has no switch for it. It is logged as an error, so a log level that hides it would hide errors too; hence a filter
between this process and the terminal. It is a process of its own (this file as a script), so that the last words of a
crash pass it as well.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator

_HEAD = b"slow_operation_alarm.cc"
_LINE = b"*" * 32


@contextlib.contextmanager
def no_alarm() -> Iterator[None]:
    """While it is entered, what this process writes to stderr passes ``without_alarm``."""
    before = os.dup(2)
    # A session of its own: Ctrl-C is for this process, which may still have something to say.
    command = [sys.executable, "-E", "-S", os.path.abspath(__file__)]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=before, start_new_session=True)
    assert child.stdin is not None
    sys.stderr.flush()
    os.dup2(child.stdin.fileno(), 2)
    child.stdin.close()
    try:
        yield
    finally:
        sys.stderr.flush()
        os.dup2(before, 2)  # closes the last writing end: the filter comes to its end
        os.close(before)
        child.wait()


def without_alarm(lines: Iterable[bytes]) -> Iterator[bytes]:
    """``lines`` of a log without the alarm about compilation; other alarms (constant folding) stay.

    It consists of a head, which may say how long it took and be followed by an empty line, and of a line between two
    lines of asterisks.
    """
    head, inside = [], 0
    for line in lines:
        if inside:
            inside -= 1
        elif head and line.startswith(_LINE):
            head, inside = [], 2
        elif _HEAD in line:
            yield from head
            head = [line]
        elif head and not line.strip():
            head.append(line)
        else:
            yield from head
            head = []
            yield line
    yield from head


if __name__ == "__main__":
    for passed in without_alarm(sys.stdin.buffer):
        sys.stdout.buffer.write(passed)
        sys.stdout.buffer.flush()
