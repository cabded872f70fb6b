"""Fuzz the EXR reader with mutated files: only ValueError may come out, in bounded time and memory.

A longer run than the test's: ``python -m tests.data.fuzz_exr --seconds 300 --seed 1``. The reader runs in child
processes, so that a crash inside the OpenEXR library is seen; ``--keep`` stores the file that caused it.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

INTERESTING = (0, 1, 2, 255, 65535, 2**16, 2**20, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32 - 2, 2**32 - 64)
SLOW = 5.0
"""Seconds after which one file counts as a hang."""
MEMORY = 1 << 30
"""More resident memory than this, in bytes, counts as a huge allocation."""
ADDRESSES = 8 << 30
"""Bytes a child may reserve: a file that asks for more raises MemoryError and does not take the machine down."""


def seeds(folder: Path) -> list[bytes]:
    """Small files of every kind that the reader takes, and some it refuses."""
    rng = np.random.default_rng(7)
    noise, smooth = rng.uniform(0, 2, (20, 24)), np.tile(np.linspace(0, 1, 24), (20, 1))
    half = {"R": noise.astype(np.float16), "G": smooth.astype(np.float16)}
    mixed = {"depth.Z": smooth.astype(np.float32), "id.X": (noise * 9).astype(np.uint32), **half}
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 8
    headers = [
        ({"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.scanlineimage}, mixed)
        for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB", "HTJ2K32", "ZSTD")
    ]
    headers += [({"type": OpenEXR.tiledimage, "tiles": tiles}, mixed), ({"multiView": ["l", "r"]}, half)]
    files = [OpenEXR.File(header, channels) for header, channels in headers]
    files.append(OpenEXR.File([OpenEXR.Part({}, {f"V.{n}.X": smooth.astype("f")}, f"V.{n}") for n in "abc"]))
    result = []
    for file in files:
        file.write(str(folder / "seed.exr"))
        result.append((folder / "seed.exr").read_bytes())
    return result


def mutate(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: bits, bytes, integers, blocks zeroed, moved, cut or repeated; half of them in the header."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        if len(data) < 16:
            break
        limit = min(len(data), 600) if rng.random() < 0.5 else len(data)
        at = int(rng.integers(4 if rng.random() < 0.95 else 0, limit - 8))
        length = int(rng.integers(1, 64))
        kind = rng.integers(8)
        if kind == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[at] = int(rng.integers(256))
        elif kind == 2:
            data[at : at + 4] = int(rng.choice(INTERESTING)).to_bytes(4, "little")
        elif kind == 3:
            data[at : at + length] = rng.bytes(length)
        elif kind == 4:
            data[at : at + length] = bytes(length)
        elif kind == 5:
            del data[at : at + length]
        elif kind == 6:
            data[at:at] = data[at : at + length]
        else:
            del data[int(rng.integers(8, len(data))) :]
    return bytes(data)


def resident() -> int:
    """Bytes of memory this process held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def child(folder: Path, seed: int, seconds: float) -> dict:
    """Read mutants until the time is over; the one being read lies in ``folder/mutant.exr``."""
    from essjax.data import exr

    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    rng, files = np.random.default_rng(seed), seeds(folder)
    end, counts, slowest, before = time.monotonic() + seconds, {"read": 0, "refused": 0}, 0.0, resident()
    while time.monotonic() < end:
        path = folder / "mutant.exr"
        path.write_bytes(mutate(files[rng.integers(len(files))], rng))
        start = time.monotonic()
        try:
            exr.read(path)
            counts["read"] += 1
        except ValueError as error:
            if not str(error).startswith(str(path)) or isinstance(error.__cause__, MemoryError):
                raise
            counts["refused"] += 1
        slowest = max(slowest, time.monotonic() - start)
        if slowest > SLOW or resident() - before > MEMORY:
            raise TimeoutError(f"{slowest:.1f} s, {(resident() - before) >> 20} MiB for one file")
    return {**counts, "slowest": slowest, "mebibytes": (resident() - before) >> 20}


def fuzz(seconds: float, seed: int, keep: Path | None = None) -> list[dict[str, Any]]:
    """Run children until the time is over; one result for each, with ``failure`` if it did not end well."""
    end, results = time.monotonic() + seconds, []
    while (left := end - time.monotonic()) > 0.5:
        with tempfile.TemporaryDirectory() as name:
            command = [sys.executable, "-m", "tests.data.fuzz_exr", "--child", name]
            command += ["--seed", str(seed + len(results)), "--seconds", str(min(left, 20.0))]
            run = subprocess.run(command, capture_output=True, text=True, timeout=left + 60, check=False)
            lines = run.stdout.splitlines()
            failed = {"failure": run.returncode, "seed": seed + len(results), "stderr": run.stderr.splitlines()[-8:]}
            result = failed if run.returncode else json.loads(lines[-1])
            if keep and run.returncode:
                keep.mkdir(parents=True, exist_ok=True)
                os.replace(Path(name) / "mutant.exr", keep / f"mutant.{seed + len(results)}.exr")
            results.append(result)
    return results


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for files that made the reader fail")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(child(args.child, args.seed, args.seconds)))
        return
    results = fuzz(args.seconds, args.seed, args.keep)
    for result in results:
        print(result)
    print(f"{sum(r.get('read', 0) + r.get('refused', 0) for r in results)} files read or refused")
    sys.exit(any("failure" in result for result in results))


if __name__ == "__main__":
    main()
