"""One try of each kind of fault: a command is disturbed, looked at, and run again to its end."""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tools.faults.jobs import Job
from tools.faults.process import Child, Ended, run

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
HEARD = 2.0
"""Seconds after which a signal must have had its answer."""
LINES = 3
"""Most lines of a message."""


class Reference(NamedTuple):
    """An undisturbed run: what it gave, and the seconds it took."""

    result: dict[str, str]
    seconds: float


class Try(NamedTuple):
    """What was wrong in one try; "" if nothing was.

    Attributes:
      lost: how the end differs from an undisturbed run.
      torn: what was half-written under its final name.
      unclear: a traceback, an undocumented exit code, more than three lines, or no file named.
    """

    lost: str = ""
    torn: str = ""
    unclear: str = ""


def undisturbed(job: Job, folder: Path) -> Reference:
    """Run a job without a fault; twice, the first one fills caches."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in ("first", "reference"):
        out = folder / name
        ended = run(lambda out=out: job.command(out), folder / "output.txt")
        assert ended.code == 0, ended.output
    return Reference(job.result(out), ended.seconds)


def _finish(job: Job, reference: Reference, out: Path, unclear: str, torn: str) -> Try:
    """Run the job again, to its end, and compare."""
    ended = run(lambda: job.command(out), out.parent / "output.txt")
    if ended.code != 0 or "Traceback" in ended.output:
        return Try("", torn, unclear or f"again: exit code {ended.code}: {ended.output[-300:]}")
    result = job.result(out)
    whole = reference.result
    different = sorted(name for name in {**result, **whole} if result.get(name) != whole.get(name))
    return Try(", ".join(different)[:300], torn, unclear)


def _unclear(ended: Ended, codes: tuple[int, ...], named: str = "") -> str:
    """Say what is wrong with the way in which a command ended."""
    if ended.code not in codes:
        return f"exit code {ended.code}: {ended.output[-300:]}"
    if "Traceback" in ended.output or ended.code and len(ended.lines) > LINES:
        return f"{len(ended.lines)} lines: {ended.output[-300:]}"
    if ended.code and named not in ended.output.replace("\n", ""):
        return f"nothing is named: {ended.output[-300:]}"
    return ""


def kill(job: Job, reference: Reference, out: Path, random: np.random.Generator) -> Try:
    """Kill -9 at a random moment."""
    child = Child(lambda: job.command(out), out.parent / "output.txt")
    if child.wait(float(random.uniform(0.0, reference.seconds))) is None:
        child.send(signal.SIGKILL)
        child.end()
    torn = ", ".join(job.torn(out, reference.result))
    return _finish(job, reference, out, "", torn)


def stop(job: Job, reference: Reference, out: Path, random: np.random.Generator) -> Try:
    """Ctrl-C or SIGTERM at a random moment, sometimes twice."""
    number = (signal.SIGINT, signal.SIGTERM)[int(random.integers(2))]
    child = Child(lambda: job.command(out), out.parent / "output.txt")
    ended, late = child.wait(float(random.uniform(0.3, 1.0) * reference.seconds)), ""
    if ended is None:
        child.send(number)
        if random.random() < 0.3:
            time.sleep(float(random.uniform(0.0, 0.2)))
            child.send(number)
        spent = child.cpu()
        said = lambda: "topping after" in (out.parent / "output.txt").read_text(errors="replace")
        while ended is None and not said() and not late:
            ended = child.wait(HEARD)
            # On a busy machine two seconds may be none of the command's.
            late = f"not heard in {HEARD:.0f} s" if ended is None and not said() and child.cpu() - spent > HEARD else ""
        ended = ended or child.end()
    codes = (0, CODES[number])
    torn = ", ".join(job.torn(out, reference.result))
    return _finish(job, reference, out, late or _unclear(ended, codes), torn)


@contextlib.contextmanager
def _disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of ``size`` bytes; takes root."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def full(job: Job, reference: Reference, out: Path, random: np.random.Generator) -> Try:
    """Fill a disk of a random size, too small as a rule; then it grows."""
    size = 4096 * int(random.uniform(3, 1.1 * job.bytes / 4096))
    with _disk(out.parent / "disk", size):
        inside = out.parent / "disk" / "out"
        ended = run(lambda: job.command(inside), out.parent / "output.txt")
        torn = ", ".join(job.torn(inside, reference.result)) if inside.is_dir() else ""
        unclear = _unclear(ended, (0, 2), str(inside))
        subprocess.run(["mount", "-o", "remount,size=64m", str(out.parent / "disk")], check=True)
        return _finish(job, reference, inside, unclear, torn)


def together(job: Job, reference: Reference, out: Path, random: np.random.Generator) -> Try:
    """Two at once: one goes on, the other is refused (or comes after it)."""
    first = Child(lambda: job.command(out), out.parent / "output.txt")
    time.sleep(float(random.uniform(0.0, 1.0)) * reference.seconds)
    second = run(lambda: job.command(out), out.parent / "second.txt")
    ended = [first.end(), second]
    unclear = next(filter(None, (_unclear(each, (0, 2), str(out)) for each in ended)), "")
    if not unclear and not any(each.code == 0 for each in ended):
        unclear = f"both were refused: {ended[0].output} {ended[1].output}"
    return _finish(job, reference, out, unclear, "")


KINDS: dict[str, Any] = {
    "kill -9": kill, "Ctrl-C or SIGTERM": stop, "full disk": full, "two at once": together,
}  # fmt: skip


def possible(kind: str) -> bool:
    """Whether this machine allows a kind."""
    return kind != "full disk" or os.geteuid() == 0
