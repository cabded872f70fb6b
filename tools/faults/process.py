"""Commands in processes of their own, forked from this one: what they import is imported once."""

import hashlib
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

HANG = 300.0
"""Seconds after which a command counts as one that never ends."""


class Ended(NamedTuple):
    """How a command ended.

    Attributes:
      code: its exit code; negative: the signal that killed it.
      output: stdout and stderr.
      seconds: that it took, or from the last signal to its end.
    """

    code: int
    output: str
    seconds: float

    @property
    def lines(self) -> list[str]:
        """Lines of the output, without progress bars."""
        return [line for line in self.output.splitlines() if line.strip() and "━" not in line]


class Child:
    """A command that runs. JAX must not have been used in this process: its threads do not survive a fork."""

    def __init__(self, command: Callable[[], int], output: Path):
        """Start it."""
        self._output, self._began = output, time.monotonic()
        output.write_text("")  # it may be killed before it has written anything
        self.pid = os.fork()
        if self.pid == 0:
            try:
                self._be(command)
            finally:
                os._exit(1)

    def _be(self, command: Callable[[], int]) -> None:
        """Run the command, in the child."""
        os.setsid()
        file = os.open(self._output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        try:
            code = command()
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

    def send(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        self._began = time.monotonic()
        os.kill(self.pid, number)  # a process that was not waited for is still there

    def cpu(self) -> float:
        """Seconds of the processor that it has had."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def wait(self, most: float = HANG) -> Ended | None:
        """Wait for its end; None: it did not come in time."""
        deadline = time.monotonic() + most
        while True:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                seconds = time.monotonic() - self._began
                text = self._output.read_text(errors="replace")
                return Ended(os.waitstatus_to_exitcode(status), text, seconds)
            if time.monotonic() > deadline:
                return None
            time.sleep(0.01)

    def end(self) -> Ended:
        """Wait for its end; one that does not come is brought about."""
        ended = self.wait()
        if ended is None:
            os.killpg(self.pid, signal.SIGKILL)
            ended = self.wait()
            assert ended is not None
            ended = ended._replace(output=f"Traceback: no end after {HANG:.0f} s\n{ended.output}")
        return ended


def run(command: Callable[[], int], output: Path) -> Ended:
    """Run a command to its end."""
    return Child(command, output).end()


def digests(folder: Path) -> dict[str, str]:
    """Relative name -> digest of every file that is not hidden."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
