"""Training: objectives, one jitted step, the loop, checkpoints."""

from essjax.stopping import Interrupted
from essjax.train.checkpoint import Checkpoints
from essjax.train.loop import (
    Budget,
    NonFiniteLoss,
    Validation,
    best_validation,
    chosen_variables,
    mean_score,
    read_progress,
    restore_stage,
    train,
)
from essjax.train.objectives import (
    Objective,
    Recurrent,
    classification_objective,
    composition_objective,
    dlctus_objective,
    every_phase,
    extranet_objective,
    extrass_objective,
    fasset_objective,
    fitting_length,
    frnet_objective,
    ifrnet_objective,
    nsrr_objective,
    predict_last,
    whole_periods,
)
from essjax.train.state import (
    OPTIMIZERS,
    TrainState,
    adam,
    averaged,
    constant,
    cosine,
    create_state,
    halving,
    learning_rate,
    muon,
)
from essjax.train.step import make_train_step

__all__ = [
    "Budget", "Checkpoints", "Interrupted", "NonFiniteLoss", "OPTIMIZERS", "Objective", "Recurrent", "TrainState",
    "Validation", "adam", "averaged", "best_validation", "chosen_variables", "classification_objective",
    "composition_objective", "constant", "cosine", "create_state", "dlctus_objective", "every_phase",
    "extranet_objective", "extrass_objective", "fasset_objective", "fitting_length", "frnet_objective", "halving",
    "ifrnet_objective", "learning_rate", "make_train_step", "mean_score", "muon", "nsrr_objective", "predict_last",
    "read_progress", "restore_stage", "train", "whole_periods",
]  # fmt: skip
