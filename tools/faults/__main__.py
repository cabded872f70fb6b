"""``python -m tools.faults``: the long version of ``tests/faults``, resumable; writes docs/reliability.md.

Each try is a line of FOLDER/tries.jsonl as soon as it is made, so that the same command goes on where it was stopped.
"""

import argparse
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Path(__file__).parent / "results.json"
PAGE = ROOT / "docs" / "reliability.md"
COMMAND = "python -m tools.faults"
WANTED = {"kill -9": {"training": 30}}
"""Tries of a kind where they are not ``TRIES``."""
TRIES = 100
FUZZ_SECONDS = 3600.0
"""Seconds for each reader."""
SLICE = 20.0
"""Seconds of a reader in one round."""
HEAD = """# Reliability

Commands were killed, stopped, starved of disk, started twice and fed with damaged files, at random moments and in
random places, and then run again to their end. *Lost*: the end differs from that of an undisturbed run.
*Half-written*: a file under its final name is not whole. *Unclear*: a traceback, an exit code other than documented
(0; 2 bad input or disk, 130 Ctrl-C, 143 SIGTERM), more than three lines, no file named, a signal not
heard within two seconds (of the processor, on a busy machine), or a hang.

Made by `{command}`, which goes on where it was stopped and takes hours: *wanted* are its tries;
`tests/faults` holds a small version. The import is of six frames of 20x12, the scenes are of eight frames of 16x12 that
were made before, the training has twelve steps.
"""
COLUMNS = "| kind | tries | wanted | lost | half-written | unclear |\n|---|--:|--:|--:|--:|--:|"


def tally(lines: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Row -> tries, what was wrong, and seconds."""
    rows: dict[str, dict[str, Any]] = {}
    for line in lines:
        row = rows.setdefault(line["row"], {"tries": 0, "seconds": 0.0, "lost": [], "torn": [], "unclear": []})
        row["tries"] += line["tries"]
        row["seconds"] = round(row["seconds"] + line["seconds"], 1)
        for column in ("lost", "torn", "unclear"):
            row[column] += line[column]
    return rows


def page(rows: dict[str, dict[str, Any]]) -> str:
    """Write the rows as Markdown."""
    text = [HEAD.format(command=COMMAND), COLUMNS]
    for name, row in sorted(rows.items()):
        fuzzed = name.startswith("damaged: ")
        tries = f"{row['tries']} in {row['seconds'] / 60:.0f} min" if fuzzed else str(row["tries"])
        wanted = f"{FUZZ_SECONDS / 60:.0f} min" if fuzzed else str(wanted_of(name))
        counts = " | ".join(str(len(row[column])) for column in ("lost", "torn", "unclear"))
        text.append(f"| {name} | {tries} | {wanted} | {counts} |")
    wrong = [
        f"- {name}: {column}: `{' '.join(note.split())[:200]}`"
        for name, row in sorted(rows.items())
        for column in ("lost", "torn", "unclear")
        for note in row[column][:3]
    ]
    if wrong:
        text += ["", "What was wrong:", "", *wrong]
    return "\n".join(text) + "\n"


def wanted_of(row: str) -> int:
    """Return how many tries of a row the long version makes."""
    kind, _, job = row.partition(": ")
    return WANTED.get(kind, {}).get(job, TRIES)


def tries(folder: Path, done: dict[str, dict[str, Any]], only: str) -> Iterator[dict[str, Any]]:
    """Make tries, one of each row in turn, until all are made."""
    from tools.faults import fuzz, jobs, kinds
    from tools.faults.process import run

    references: dict[str, kinds.Reference] = {}
    every = [(f"{kind}: {job.name}", kind, job) for job in jobs.prepare(folder / "inputs") for kind in kinds.KINDS]
    every = [entry for entry in every if kinds.possible(entry[1])]
    counts = {name: row["tries"] for name, row in done.items()}
    spent = {name: row["seconds"] for name, row in done.items()}
    while True:
        left = False
        for name, kind, job in every:
            if only not in name or counts.get(name, 0) >= wanted_of(name):
                continue
            left, began = True, time.monotonic()
            if job.name not in references:
                references[job.name] = kinds.undisturbed(job, folder / "undisturbed" / job.name.replace(" ", "-"))
            work, number = folder / "work", counts.get(name, 0)
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            random = np.random.default_rng([number, *name.encode()])
            found = kinds.KINDS[kind](job, references[job.name], work / "out", random)
            columns = {column: [text] if text else [] for column, text in found._asdict().items()}
            counts[name] = number + 1
            yield {"row": name, "tries": 1, "seconds": round(time.monotonic() - began, 1), **columns}
        for reader in fuzz.READERS:
            name = f"damaged: {reader.name}"
            if only not in name or spent.get(name, 0.0) >= FUZZ_SECONDS:
                continue
            left, began = True, time.monotonic()
            seed = int(spent.get(name, 0.0) * 1000)
            ended = run(fuzz.command(reader, folder / "fuzz", seed, SLICE), folder / "output.txt")
            seconds = round(time.monotonic() - began, 1)
            spent[name] = spent.get(name, 0.0) + seconds
            if ended.code:
                found = {"tries": 1, "lost": [], "unclear": [f"exit code {ended.code}: {ended.output[-300:]}"]}
            else:
                found = json.loads(ended.output.splitlines()[-1])
            yield {"row": name, "seconds": seconds, "torn": [], **found}
        if not left:
            return


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument(
        "--folder", type=Path, default=ROOT / "runs" / "faults", help="where the tries run and are kept"
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after them; the same command goes on")
    parser.add_argument("--only", default="", help="rows that hold this text")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    log, end = options.folder / "tries.jsonl", time.monotonic() + 60 * options.minutes
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    with log.open("a") as file:
        for line in tries(options.folder, tally(lines), options.only):
            lines.append(line)
            file.write(json.dumps(line) + "\n")
            file.flush()
            wrong = " ".join(f"{column}: {line[column][0]}" for column in ("lost", "torn", "unclear") if line[column])
            print(f"{line['row']}: {line['tries']} in {line['seconds']} s {wrong or 'ok'}", flush=True)
            if time.monotonic() > end:
                break
    rows = tally(lines)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
    PAGE.write_text(page(rows))


if __name__ == "__main__":
    main()
