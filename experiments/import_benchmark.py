"""Speed and memory of an import: ``python -m experiments.import_benchmark [--frames 1000] [--workers 2]``.

Makes a dump of 960x540 frames (15 channels, as Unreal or Blender would write them; 8 distinct ones, linked), imports it
without and with a 1920x1080 reference, and writes ``experiments/results/import.json``.
"""

import os
import resource
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import tyro

from essjax.data import import_dataset
from essjax.data.json_files import write_json
from experiments.benchmarks_page import RESULTS

WIDTH, HEIGHT, DISTINCT = 960, 540, 8
RECIPE = """
[files]
frame = "lr/{frame}.exr"
[channels]
color = ["R", "G", "B"]
base_color = ["base.R", "base.G", "base.B"]
normal = ["N.X", "N.Y", "N.Z"]
depth = ["depth.Z"]
motion = ["motion.X", "motion.Y"]
roughness = ["rough.Y"]
metallic = ["metal.Y"]
stencil = ["id.Y"]
[motion]
sign = "current-previous"
y = "up"
unit = "uv"
[depth]
kind = "reversed"
near = 0.1
[base_color]
encoding = "srgb"
"""


def _waves(seed: int, width: int, height: int, channels: int) -> np.ndarray:
    """Smooth shading with hard edges, in [0, 1]: compresses about as rendered images do."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / height
    image = np.zeros((height, width, channels), np.float32)
    for amplitude in (0.5, 0.25, 0.125):
        a, b, phase = rng.uniform(2, 20, (3, channels))
        image += amplitude * (0.5 + 0.5 * np.sin(a * x[..., None] + b * y[..., None] + phase))
    return image + 0.125 * (np.floor(8 * x) % 2 == np.floor(6 * y) % 2)[..., None]


def _write(path: Path, half: dict[str, np.ndarray], full: dict[str, np.ndarray]) -> None:
    planes = {name: np.ascontiguousarray(plane, np.float16) for name, plane in half.items()}
    planes |= {name: np.ascontiguousarray(plane, np.float32) for name, plane in full.items()}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(path))


def make_dump(folder: Path, frames: int) -> None:
    """``lr`` and ``hr`` files of ``frames`` frames; colours carry a little noise, as path-traced ones do."""
    for kind in ("lr", "hr"):
        (folder / kind).mkdir(parents=True)
    noise = np.random.default_rng(0)
    for n in range(min(frames, DISTINCT)):
        waves = _waves(n, WIDTH, HEIGHT, 13)
        grain = 1 + 0.02 * noise.standard_normal((HEIGHT, WIDTH, 3), np.float32)
        half = {name: 3 * waves[..., i] * grain[..., i] for i, name in enumerate("RGB")}
        half |= {f"base.{name}": waves[..., 3 + i] for i, name in enumerate("RGB")}
        normal = waves[..., 6:9] - 0.4
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        half |= {f"N.{name}": normal[..., i] for i, name in enumerate("XYZ")}
        half |= {"rough.Y": waves[..., 9], "metal.Y": np.round(waves[..., 10]), "id.Y": np.round(3 * waves[..., 9])}
        full = {"depth.Z": 0.1 / (1 + 20 * waves[..., 10]), "motion.X": 0.02 * waves[..., 11]}
        full["motion.Y"] = 0.01 * waves[..., 12]
        _write(folder / "lr" / f"{n:04d}.exr", half, full)
        big = 3 * _waves(n, 2 * WIDTH, 2 * HEIGHT, 3)
        _write(folder / "hr" / f"{n:04d}.exr", {name: big[..., i] for i, name in enumerate("RGB")}, {})
    for n in range(DISTINCT, frames):
        for kind in ("lr", "hr"):
            (folder / kind / f"{n:04d}.exr").symlink_to(f"{n % DISTINCT:04d}.exr")


def resident_megabytes() -> float:
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def measure(folder: Path, frames: int, *, with_reference: bool, workers: int) -> dict[str, Any]:
    """Import once; frames per second, CPU seconds per frame, memory every 50 frames."""
    recipe, out = folder / "recipe.toml", folder / "out"
    reference = 'reference = "hr/{frame}.exr"\n' if with_reference else ""
    recipe.write_text(RECIPE.replace("[channels]", f"{reference}[channels]"))
    memory: list[float] = []

    def on_frame(done: int, total: int) -> None:
        if done % 50 == 0:
            memory.append(round(resident_megabytes(), 1))

    started, used = time.monotonic(), time.process_time()
    import_dataset(folder, out, "generic", recipe=recipe, workers=workers, on_frame=on_frame)
    seconds, cpu = time.monotonic() - started, time.process_time() - used
    written = sum(path.stat().st_size for path in out.rglob("*.exr"))
    shutil.rmtree(out)
    return {
        "frames": frames,
        "frames_per_second": round(frames / seconds, 2),
        "cpu_seconds_per_frame": round(cpu / frames, 4),
        "megabytes_per_frame": round(written / frames / 1e6, 2),
        "resident_megabytes": memory,
    }


def main(
    *,
    frames: int = 1000,
    workers: int = os.cpu_count() or 1,
    folder: Path | None = None,
    out: Path = RESULTS / "import.json",
) -> None:
    """Measure speed and memory of an import, and write the results.

    Args:
      frames: of the dump.
      workers: threads.
      folder: where the dump and the dataset go for the while; a temporary one without it.
      out: file of the results.
    """
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        make_dump(Path(temporary), frames)
        load, cases = os.getloadavg()[0], {}
        for name, with_reference in (("960x540, no reference", False), ("960x540 and a 1920x1080 reference", True)):
            cases[name] = measure(Path(temporary), frames, with_reference=with_reference, workers=workers)
            print(name, {k: v for k, v in cases[name].items() if k != "resident_megabytes"})
            print("  memory, MB:", *cases[name]["resident_megabytes"])
    machine = f"{os.cpu_count()} CPU cores, {workers} threads, load {load:.1f} from other work at the start"
    write_json(out, {"schema": 1, "kind": "import", "machine": machine, "cases": cases})


if __name__ == "__main__":
    tyro.cli(main, prog="python -m experiments.import_benchmark")
