"""Read a JAX profiler trace: which operations took the time. ``--profile`` prints this; a viewer shows the rest."""

import collections
import gzip
import json
from pathlib import Path
from typing import NamedTuple


class Operation(NamedTuple):
    """One operation of a compiled program, all its executions together.

    Attributes:
      program: the jitted function.
      name: of the operation in XLA's program.
      milliseconds: the sum; operations may run side by side.
      count: executions.
    """

    program: str
    name: str
    milliseconds: float
    count: int


def _newest(folder: Path) -> tuple[Path, list[dict]]:
    files = sorted(folder.rglob("*.trace.json.gz"))
    if not files:
        raise ValueError(f"{folder}: expected a *.trace.json.gz that jax.profiler wrote, found none. Run --profile.")
    with gzip.open(files[-1], "rt") as file:
        return files[-1], json.load(file)["traceEvents"]


def device_milliseconds(folder: Path) -> float:
    """For how long, in the newest trace under ``folder``, any stream of a GPU was busy.

    Raises:
      ValueError: there is no trace, or no work of a GPU in it.
    """
    file, events = _newest(folder)
    names: dict[tuple, str] = {}
    for event in events:
        if event.get("ph") == "M" and event.get("name") in ("process_name", "thread_name"):
            key = (event["pid"],) if event["name"] == "process_name" else (event["pid"], event["tid"])
            names[key] = event["args"]["name"]
    spans = []
    for event in events:
        if event.get("ph") == "X":
            process, thread = names.get((event["pid"],), ""), names.get((event["pid"], event["tid"]), "")
            if "/device:GPU" in process and "Stream" in thread:
                spans.append((event["ts"], event["ts"] + event["dur"]))
    if not spans:
        raise ValueError(f"{file}: expected work on a stream of a GPU, found none.")
    busy, until = 0.0, float("-inf")
    for start, end in sorted(spans):
        busy += max(end - max(start, until), 0.0)
        until = max(until, end)
    return busy / 1e3


def operations(folder: Path) -> list[Operation]:
    """All operations in the newest trace under ``folder``, the longest first.

    Raises:
      ValueError: there is no trace, or it names no operation of a program.
    """
    file, events = _newest(folder)
    seconds: collections.Counter[tuple[str, str]] = collections.Counter()
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    for event in events:
        arguments = event.get("args", {})
        if event.get("ph") == "X" and "hlo_op" in arguments:
            key = arguments.get("hlo_module", ""), arguments["hlo_op"]
            seconds[key] += event["dur"]
            counts[key] += 1
    if not seconds:
        raise ValueError(f"{file}: expected operations of a jitted program, found none.")
    return [Operation(*key, microseconds / 1e3, counts[key]) for key, microseconds in seconds.most_common()]


def describe(found: list[Operation], longest: int = 8) -> list[str]:
    """Per program: the sum and the longest operations."""
    lines = []
    for program in dict.fromkeys(operation.program for operation in found):
        mine = [operation for operation in found if operation.program == program]
        total = sum(operation.milliseconds for operation in mine)
        lines.append(f"{program}: {total:.1f} ms in {len(mine)} operations")
        lines += [
            f"  {operation.milliseconds:9.2f} ms  {operation.milliseconds / total:4.0%}  x{operation.count:<4d} "
            f"{operation.name}"
            for operation in mine[:longest]
        ]
    return lines
