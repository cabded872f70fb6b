"""The guided warp in plain C with OpenMP, compiled when it is asked for: how far XLA is from the machine."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from essjax.warp import candidate_offsets
from essjax.warp.gbuffer_guided import SIGMA_DISTANCE, SIGMA_GUIDE
from experiments.benchmark.measure import Case, summary, time_calls

SOURCE = Path(__file__).with_name("guided_warp.c")
FLAGS = ("-O3", "-march=native", "-fopenmp", "-shared", "-fPIC")


def compiler() -> str | None:
    """gcc, if it is there."""
    return shutil.which("gcc")


def build(folder: Path) -> Callable:
    """``warp(radiance, guide_previous, guide, motion, out)`` on contiguous float32 arrays ``[H, W, C]``."""
    library = folder / "guided_warp.so"
    subprocess.run([compiler() or "gcc", *FLAGS, str(SOURCE), "-o", str(library), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).guided_warp
    offsets = np.ascontiguousarray(candidate_offsets(), np.int32)
    inverse = np.array([*SIGMA_GUIDE, SIGMA_DISTANCE], np.float32) ** -2

    def warp(radiance, guide_previous, guide, motion, out):
        arrays = (radiance, guide_previous, guide, motion, offsets, inverse, out)
        height, width, channels = radiance.shape
        function(*(a.ctypes.data_as(ctypes.c_void_p) for a in arrays), height, width, channels, guide.shape[-1])

    return warp


def rows(case: Case, ours: np.ndarray, repetitions: int) -> Iterator[dict[str, Any]]:
    """Time the guided warp where there is a compiler; its arguments must use the default sigmas."""
    if not compiler():
        return
    arguments = [np.ascontiguousarray(a, np.float32) for a in case.arguments]
    out = np.empty_like(arguments[0])
    with tempfile.TemporaryDirectory() as folder:
        warp = build(Path(folder))
        seconds = time_calls(lambda: warp(*arguments, out), repetitions)
    apart = np.abs(out - ours).max(axis=-1)
    difference = float(np.quantile(apart, 0.999, method="lower") / np.abs(ours).max())
    if not difference < 1e-4:
        raise RuntimeError(f"{case.name}: plain C differs from essjax by {difference:.2g}.")
    row = {"name": case.name, "implementation": "plain C", **summary(seconds), "work": dict(case.work)}
    yield {**row, "difference_from_essjax": difference}
