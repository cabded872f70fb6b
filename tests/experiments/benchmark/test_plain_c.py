"""The guided warp in C computes what ours does."""

import jax
import numpy as np
import pytest

from experiments.benchmark.peers import plain_c
from experiments.benchmark.suites import warp


@pytest.mark.skipif(plain_c.compiler() is None, reason="no gcc")
def test_plain_c():
    case = next(case for case in warp.cases(45, 38) if case.name.startswith("guided,"))
    ours = np.asarray(jax.jit(case.function)(*case.arguments))
    (row,) = plain_c.rows(case, ours, 1)
    assert row["implementation"] == "plain C" and row["difference_from_essjax"] < 1e-5
    with pytest.raises(RuntimeError, match="guided, 45x38: plain C differs from essjax by 0"):
        list(plain_c.rows(case, ours + 0.0999 * np.abs(ours).max(), 1))
