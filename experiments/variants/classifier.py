"""Classifier-guided temporal supersampling (Guo et al. 2022)."""

from essjax import methods
from essjax.interfaces import Method
from essjax.labels import Thresholds
from essjax.train import classification_objective, composition_objective
from experiments.config import Config
from experiments.variants.base import Stage, Variant, first_budget, main_budget


def thresholds(config: Config) -> Thresholds:
    """Those of the labels at the size of a run's reference."""
    return Thresholds.of_height(config.size[1] * config.scale)


def _classifier(config: Config) -> Method:
    return methods.classifier(scale=config.scale, width=config.first_width, composition_width=config.width)


def _classification(config: Config) -> Stage:
    method = _classifier(config)
    objective = classification_objective(method, thresholds=thresholds(config))
    budget, rate = first_budget(config), config.first_learning_rate
    return Stage("classifier", method, objective, config.first_batch, rate, budget, ranges=True)


def _composition(config: Config) -> Stage:
    method = _classifier(config)
    objective = composition_objective(method, temporal_weight=config.temporal_weight)
    return Stage("composition", method, objective, config.batch, config.learning_rate, main_budget(config))


VARIANTS = {
    "classifier": Variant(
        "classifier-guided supersampling: classes say what becomes of history; every frame rendered",
        _classifier,
        lambda config: [_classification(config), _composition(config)],
        presets={
            "smoke": {"first_width": 8, "width": 8},
            "quick": {
                "first_width": 16, "width": 32, "first_batch": 2, "batch": 2, "first_learning_rate": 1e-2,
                "learning_rate": 3e-3, "first_seconds": 200.0, "seconds": 90.0,
            },
            "paper": {"first_width": 32, "width": 64, "first_learning_rate": 1e-3, "learning_rate": 1e-3},
        },
    ),
}  # fmt: skip
