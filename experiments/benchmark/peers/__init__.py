"""Peers that people would otherwise run: the same warps and networks in PyTorch, eager and compiled.

Written for the comparison, with our conventions and our weights; nothing is timed before its output equals ours. Needs
the extra ``bench`` (``pip install -e '.[bench]'``); without it the benchmark shows essjax alone.
"""

import importlib.util
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmark.measure import Case, queued_calls, summary, time_calls
from experiments.benchmark.peers import plain_c

TOLERANCE = 1e-4
"""Largest difference of a float32 peer from our output, relative to its largest value."""
GPU_TOLERANCE = 5e-3
"""The same on a GPU, where both multiply float32 in TF32 by default, as their users do."""
MODES = ("eager", "compile")


class Peer(NamedTuple):
    """Another implementation of a case.

    Attributes:
      make: from the case's arguments (NumPy) a function of torch tensors, and those tensors.
      back: its output as a NumPy array in our layout.
      ties: share of pixels that may differ where equal candidates are ordered differently.
    """

    make: Callable[[tuple], tuple[Callable, tuple]]
    back: Callable[[Any], np.ndarray]
    ties: float = 0.0


def installed() -> bool:
    """Whether PyTorch is there."""
    return importlib.util.find_spec("torch") is not None


def find(name: str) -> Peer | None:
    """Find the peer of a case, by its name without the size."""
    from experiments.benchmark.peers import networks, warps

    return {**warps.PEERS, **networks.PEERS}.get(name.split(",")[0])


def rows(case: Case, repetitions: int, dtype: str = "float32") -> Iterator[dict[str, Any]]:
    """Time the peers of a case, if it has any: PyTorch's where it is installed, plain C where there is a compiler.

    Raises:
      RuntimeError: a float32 peer does not compute what we do.
    """
    peer = find(case.name) if installed() else None
    plain = case.name.startswith("guided,") and jax.default_backend() == "cpu"
    if peer is None and not plain:
        return
    ours = np.asarray(jax.tree.leaves(jax.jit(case.function)(*case.arguments))[0], np.float32)
    if plain:
        yield from plain_c.rows(case, ours, repetitions)
    if peer is None:
        return
    for mode in MODES:
        yield _row(case, peer, mode, repetitions, dtype, ours)


def _row(case: Case, peer: Peer, mode: str, repetitions: int, dtype: str, ours: np.ndarray) -> dict[str, Any]:
    import torch  # after the check that it is installed

    torch.set_num_threads(os.cpu_count() or 1)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    device = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
    function, tensors = peer.make(jax.tree.map(np.asarray, case.arguments))
    kind = getattr(torch, dtype)
    tensors = [t.to(device, kind if t.is_floating_point() else t.dtype) for t in tensors]
    if mode == "compile":
        # On a GPU with CUDA graphs: without them the launches would be timed.
        function = torch.compile(function, dynamic=False, mode="reduce-overhead" if device == "cuda" else None)

    def call() -> Any:
        with torch.inference_mode():
            return function(*tensors)

    def wait(output: Any) -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    first = time_calls(call, 1, wait=wait, warm_up=0)
    difference = _difference(peer.back(call()), ours, peer.ties)
    if dtype == "float32" and not difference < (TOLERANCE if device == "cpu" else GPU_TOLERANCE):
        raise RuntimeError(f"{case.name}: PyTorch ({mode}) differs from essjax by {difference:.2g}, not timed.")
    seconds = time_calls(call, repetitions, wait=wait, queued=queued_calls() if device == "cuda" else 1)
    row = {"name": case.name, "implementation": f"torch {mode}", **summary(seconds), "work": dict(case.work)}
    return {**row, "compile_seconds": float(first[0]), "difference_from_essjax": difference}


def _difference(theirs: np.ndarray, ours: np.ndarray, ties: float) -> float:
    """Largest difference over the largest value; of the pixels that are left when the share ``ties`` is dropped."""
    apart = np.abs(theirs - ours).reshape(-1, ours.shape[-1]).max(axis=-1)
    return float(np.quantile(apart, 1.0 - ties, method="lower") / np.abs(ours).max())
