"""A stage that trains in a second: fit one vector to the colours of a clip, from a real loader, with a real loop.

``python -m tests.train.tiny_run FOLDER SECONDS`` runs it slowly in its own process, for tests that kill it.
"""

import functools
import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from essjax.data import Mixed, clips
from essjax.frames import select_time
from essjax.train import (
    Budget,
    Checkpoints,
    Validation,
    adam,
    create_state,
    learning_rate,
    make_train_step,
    restore_stage,
    train,
)
from tests.helpers import make_sequence

STEPS = 12


def sequences():
    """Two sequences in memory, NumPy leaves ``[T, H, W, C]``."""
    batch = jax.tree.map(np.asarray, make_sequence(0, T=6, B=2, H=4, W=5))
    batch = jax.tree.map(lambda leaf: np.moveaxis(leaf, 1, 0), batch)
    return [select_time(batch, index) for index in range(2)]


def objective(variables, clip):
    """Two terms, so that a test can tell which of them went wrong; they depend on the clip and so on its order."""
    color, reference = (jnp.mean(image, axis=(0, 1, 2, 3)) for image in (clip.frames.color, clip.reference))
    terms = {
        "near": jnp.sum((variables["fit"]["w"] - color) ** 2),
        "far": 0.1 * jnp.sum((variables["fit"]["w"] - reference) ** 2) + variables["frozen"]["b"],
    }
    return terms, {}


def initial_state(average=True):
    """``fit`` is trained, ``frozen`` is not."""
    variables = {"fit": {"w": jnp.zeros(3)}, "frozen": {"b": jnp.ones(())}}
    return create_state(variables, "fit", adam(), average=average)


@functools.cache
def tiny_step():
    """The jitted step, compiled once per process."""
    return make_train_step(objective, adam(), "fit", average=0.5)


def validation(times=4):
    """Scores that first rise, then fall: of steps 3, 6, 9 and 12 the third are the best weights."""
    target = jnp.array([0.1, 0.11, 0.12])
    return Validation(
        lambda variables: {"ss": float(-jnp.sum((variables["fit"]["w"] - target) ** 2)), "ess": 1.0}, times
    )


def tiny_batches(seed=0):
    """Clips of three frames, both the crop and the flips at random."""
    return iter(clips(sequences(), length=3, batch=2, crop=(3, 4), seed=seed, threads=1, prefetch=1))


def run(folder, *, step=None, budget=None, save_every=1e9, batches=None, **options):
    """Train in ``folder`` from its newest checkpoint, if any: all that it leaves behind, and its summary."""
    checkpoints = Checkpoints(Path(folder) / "checkpoints")
    try:
        variables, summary = train(
            {"": step or tiny_step()}, initial_state(), Mixed({"": batches or tiny_batches()}), checkpoints,
            Path(folder) / "log.jsonl",
            budget or Budget(STEPS, None), functools.partial(learning_rate, peak=0.1), trained="fit",
            save_every=save_every, **{"validation": validation(), **options},
        )  # fmt: skip
        state, best, _ = restore_stage(checkpoints, initial_state(), "fit")
    finally:
        checkpoints.close()
    return {"variables": variables, "state": state, "best": best, "validated": summary["validated"]}, summary


if __name__ == "__main__":
    pause = float(sys.argv[2])
    print(os.getpid(), flush=True)
    run(sys.argv[1], save_every=0.0, on_step=lambda step, progress, terms: time.sleep(pause))
