"""Training: objectives, one jitted step, the loop, checkpoints."""

from essjax.train.checkpoint import Checkpoints
from essjax.train.loop import Budget, Interrupted, NonFiniteLoss, train
from essjax.train.objectives import (
    Objective,
    both_kinds,
    classification_objective,
    composition_objective,
    dlctus_objective,
    extrass_objective,
    fasset_objective,
    frnet_objective,
    odd_length,
)
from essjax.train.state import TrainState, constant, cosine, create_state, halving, learning_rate, optimizer
from essjax.train.step import make_train_step

__all__ = [
    "Budget", "Checkpoints", "Interrupted", "NonFiniteLoss", "Objective", "TrainState", "both_kinds",
    "classification_objective", "composition_objective", "constant", "cosine", "create_state", "dlctus_objective",
    "extrass_objective", "fasset_objective", "frnet_objective", "halving", "learning_rate", "make_train_step",
    "odd_length", "optimizer", "train",
]  # fmt: skip
