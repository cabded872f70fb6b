"""What each stage minimises: ``Objective = (variables, clip) -> ({term: weighted scalar}, statistics)``."""

from essjax.train.objectives.common import Objective, both_kinds, last_prediction, odd_length
from essjax.train.objectives.dlctus import dlctus_objective
from essjax.train.objectives.extrass import extrass_objective, frnet_objective
from essjax.train.objectives.fasset import fasset_objective
from essjax.train.objectives.ifrnet import ifrnet_objective
from essjax.train.objectives.nsrr import nsrr_objective

__all__ = [
    "Objective", "both_kinds", "dlctus_objective", "extrass_objective", "fasset_objective", "frnet_objective",
    "ifrnet_objective", "last_prediction", "nsrr_objective", "odd_length",
]  # fmt: skip
