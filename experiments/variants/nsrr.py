"""NSRR (Xiao et al. 2020): supersampling of a sequence that is rendered in every frame."""

from essjax import methods
from essjax.interfaces import Method
from essjax.losses import vgg16_features
from essjax.train import nsrr_objective
from essjax.train.objectives.nsrr import VGG_LAYERS
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget


def _nsrr(config: Config, *, half: bool = False) -> Method:
    return methods.nsrr(scale=config.scale, width=config.width, half=half)


def nsrr_stage(config: Config, *, half: bool = False, within: Method | None = None) -> Stage:
    """NSRR's training; ``half``: on every other frame; ``within``: a method that holds its variables beside others."""
    method = _nsrr(config, half=half)
    features = vgg16_features(config.vgg, layers=VGG_LAYERS) if config.vgg else None
    objective = nsrr_objective(method, vgg_weight=config.vgg_weight, vgg_features=features, half=half)
    return Stage("nsrr", within or method, objective, config.batch, config.learning_rate, main_budget(config), vgg=True)


VARIANTS = {
    "nsrr": Variant(
        "NSRR: a U-Net over five frames, supersampling with every frame rendered (twice the input)",
        _nsrr,
        lambda config: [nsrr_stage(config)],
        presets={
            "smoke": {"clip": 5},
            "quick": {"clip": 5, "vgg_weight": 0.1, "learning_rate": 1e-3, "seconds": 290.0},
            # 300 epochs as in thesis 002; crops of 256 output pixels, Adam 1e-4 as published.
            "paper": {
                "clip": 5, "batch": 8, "width": 32, "vgg_weight": 0.1, "learning_rate": 1e-4, "steps": 300 * 900,
            },
        },
        crops={"paper": 256},
    ),
}  # fmt: skip
