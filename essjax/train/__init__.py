"""Training: objectives, one jitted step, the loop, checkpoints."""

from essjax.train.checkpoint import Checkpoints
from essjax.train.loop import Budget, Interrupted, NonFiniteLoss, train
from essjax.train.objective import extrass_objective, frnet_objective
from essjax.train.state import TrainState, cosine, create_state, optimizer
from essjax.train.step import make_train_step

__all__ = [
    "Budget", "Checkpoints", "Interrupted", "NonFiniteLoss", "TrainState", "cosine", "create_state",
    "extrass_objective", "frnet_objective", "make_train_step", "optimizer", "train",
]  # fmt: skip
