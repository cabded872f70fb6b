"""PyTorch's versions compute what ours do, on odd sizes, with every weight at random."""

import jax
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from experiments.benchmark import peers  # noqa: E402
from experiments.benchmark.suites import networks, warp  # noqa: E402

NETWORKS = ["ExtraSSNet SS", "ExtraSSNet ESS", "ExtraNet", "DLCTUS", "FRNet", "IFRNet", "NSRR", "FASSET"]
WARPS = {case.name.split(",")[0]: case for case in warp.cases(45, 38)}


def _difference(case):
    peer = peers.find(case.name)
    function, tensors = peer.make(jax.tree.map(np.asarray, case.arguments))
    ours = np.asarray(jax.tree.leaves(jax.jit(case.function)(*case.arguments))[0])
    theirs = peer.back(function(*tensors))
    assert theirs.shape == ours.shape and np.std(ours) > 1e-2
    return peers._difference(theirs, ours, peer.ties)


@pytest.mark.parametrize("name", ["bilinear", "bicubic (a = -0.75)", "splat", "guided"])
def test_warps(name):
    assert _difference(WARPS[name]) < peers.TOLERANCE


@pytest.mark.parametrize("name", NETWORKS)
def test_networks(name):
    forward = next(f for f in networks.forwards(45, 38) if f.name.split(",")[0] == name)
    assert _difference(networks.case(forward, "float32")) < peers.TOLERANCE


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_can_be_compiled(name):
    """By torch.compile's front end; its code generator takes minutes."""
    forward = next(f for f in networks.forwards(45, 38) if f.name.split(",")[0] == name)
    case = networks.case(forward, "float32")
    function, tensors = peers.find(case.name).make(jax.tree.map(np.asarray, case.arguments))
    with torch.inference_mode():
        compiled = torch.compile(function, dynamic=False, backend="eager")(*tensors)
        for ours, theirs in zip(_outputs(compiled), _outputs(function(*tensors)), strict=True):
            torch.testing.assert_close(ours, theirs)


def _outputs(output):
    return output if isinstance(output, tuple) else (output,)


def test_a_wrong_peer_is_not_timed(monkeypatch):
    case = WARPS["bilinear"]
    right = peers.find(case.name)
    monkeypatch.setattr(peers, "find", lambda name: right._replace(back=lambda output: 1.01 * right.back(output)))
    with pytest.raises(RuntimeError, match=r"bilinear, 45x38: PyTorch \(eager\) differs from essjax by 0.01, not"):
        list(peers.rows(case, 1))
