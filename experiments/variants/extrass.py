"""ExtraSS (SIGGRAPH Asia 2023) and its parts."""

from essjax import methods
from essjax.interfaces import Method
from essjax.losses import vgg16_features
from essjax.train import extrass_objective, frnet_objective
from experiments.config import Config
from experiments.variants.base import Stage, Variant, first_budget, main_budget


def _extrass_e(config: Config) -> Method:
    return methods.extrass_e(width=config.first_width)


def _extrass(config: Config) -> Method:
    return methods.extrass(width=config.width, frnet_width=config.first_width, scale=config.scale)


def _frnet_stage(config: Config) -> Stage:
    method = _extrass_e(config)
    return Stage(
        "frnet",
        method,
        frnet_objective(method, feature_weight=config.feature_weight),
        config.first_batch,
        config.first_learning_rate,
        first_budget(config),
    )


def _extrass_stage(config: Config) -> Stage:
    method = _extrass(config)
    objective = extrass_objective(
        method,
        occlusion_weight=config.occlusion_weight,
        vgg_weight=config.vgg_weight,
        temporal_weight=config.temporal_weight,
        vgg_features=vgg16_features(config.vgg) if config.vgg else None,
    )
    return Stage("extrassnet", method, objective, config.batch, config.learning_rate, main_budget(config), vgg=True)


VARIANTS = {
    "extrass": Variant(
        "ExtraSS: G-buffer guided warp, FRNet, ExtraSSNet; every frame at twice the size from half of the frames",
        _extrass,
        lambda config: [_frnet_stage(config), _extrass_stage(config)],
        parts=("extrass-e",),
    ),
    "extrass-e": Variant(
        "guided warp + FRNet, extrapolates at low resolution", _extrass_e, lambda config: [_frnet_stage(config)]
    ),
    "extrass-w": Variant("G-buffer guided warp only, extrapolates at low resolution", lambda c: methods.extrass_w()),
}
