"""Objectives, one per training stage: ``(variables, clip) -> ({term: weighted scalar}, statistics)``."""

from essjax.train.objectives.classifier import classification_objective, composition_objective
from essjax.train.objectives.common import (
    Objective,
    Recurrent,
    every_phase,
    fitting_length,
    predict_last,
    since_cut,
    whole_periods,
)
from essjax.train.objectives.dlctus import dlctus_objective
from essjax.train.objectives.extranet import extranet_objective
from essjax.train.objectives.extrass import extrass_objective, frnet_objective
from essjax.train.objectives.fasset import fasset_objective
from essjax.train.objectives.ifrnet import ifrnet_objective
from essjax.train.objectives.nsrr import nsrr_objective

__all__ = [
    "Objective", "Recurrent", "classification_objective", "composition_objective", "dlctus_objective",
    "every_phase", "extranet_objective", "extrass_objective", "fasset_objective", "fitting_length",
    "frnet_objective", "ifrnet_objective", "nsrr_objective", "predict_last", "since_cut", "whole_periods",
]  # fmt: skip
