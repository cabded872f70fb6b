"""Which setting of a TAA method is chosen, from scores that the test makes up."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.rollout import SS
from experiments import tuning
from tests.helpers import make_frames, streamed

BASE = 25.0


def choose(monkeypatch, gains, best=(0.4, 0.8)):
    """The setting chosen where "none" gains ``gains`` on the clips over the usual clamp, and ``best`` wins in both."""

    def score(method, grid, clip):
        near = -np.abs(grid[:, 0] - best[0]) - np.abs(grid[:, 1] - best[1])
        return BASE + near + (gains[clip] if method == "none" else 0.0)

    monkeypatch.setattr(tuning, "_score_grid", score)
    return tuning.tune(lambda clamp: clamp, list(range(len(gains))))


@pytest.mark.parametrize(
    ("gains", "clamp"),
    [
        ([0.3, 0.4, 0.3], "none"),  # on every clip
        ([1.0, -0.6, -0.1], "ycocg"),  # on average, by one clip
        ([-0.1, -0.1, -0.2], "ycocg"),
        ([0.1], "none"),  # one clip: nothing is known of the spread
    ],
)
def test_another_clamp_must_win_beyond_doubt(monkeypatch, gains, clamp):
    chosen = choose(monkeypatch, gains)
    assert chosen.clamp == clamp
    assert (chosen.alpha, chosen.sigma) == (0.4, 0.8)
    assert chosen.psnr == pytest.approx(BASE + (np.mean(gains) if clamp == "none" else 0.0), abs=1e-5)


def test_the_clamps_are_tried_side_by_side(monkeypatch):
    """Each waits until the other has come as far: one after the other, nobody would ever come."""
    meet = threading.Barrier(len(tuning.CLAMPS), timeout=20)

    def score(method, grid, clip):
        meet.wait()
        return np.zeros(len(grid))

    monkeypatch.setattr(tuning, "_score_grid", score)
    assert tuning.tune(lambda clamp: clamp, [0]).clamp == tuning.CLAMPS[0]


def test_settings_side_by_side_are_what_each_gives_alone():
    method = methods.taau(scale=2)
    frames = make_frames(2, T=3, B=1, H=6, W=8)
    settings = [tuning.Setting("ycocg", alpha, sigma, 0.0) for alpha, sigma in ((0.2, 0.5), (0.7, 0.9))]
    alone = [streamed(method, tuning.setting_variables(setting), frames, (SS,) * 3) for setting in settings]
    grid = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(tuning.setting_variables, settings))
    both = streamed(tuning._side_by_side(method, 2), grid, frames, (SS,) * 3)
    np.testing.assert_allclose(both, jnp.stack(alone, axis=1), rtol=1e-5, atol=1e-6)
