"""Methods that interpolate between rendered frames, at the price of one frame of latency."""

from essjax import methods
from essjax.interfaces import Method
from essjax.train import ifrnet_objective
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget


def _ifrnet(config: Config) -> Method:
    return methods.ifrnet(width=config.width)


def _ifrnet_taa(config: Config) -> Method:
    return methods.with_taa(_ifrnet(config))


def _stages(config: Config) -> list[Stage]:
    method = _ifrnet(config)
    objective = ifrnet_objective(method, feature_weight=config.feature_weight)
    return [Stage("ifrnet", method, objective, config.batch, config.learning_rate, main_budget(config))]


VARIANTS = {
    "ifrnet": Variant(
        "IFRNet: interpolation by learned optical flow, without G-buffers, low resolution (+1 frame of latency)",
        _ifrnet,
        _stages,
        parts=("ifrnet+taa",),
        presets={
            "smoke": {"clip": 3, "feature_weight": 0.01},
            "quick": {
                "clip": 3, "batch": 8, "feature_weight": 0.01, "learning_rate": 1e-3, "seconds": 290.0,
            },
            # 300 epochs, batch 24, crops of 224, Adam 1e-4 as published, on ExtraSS's epochs.
            "paper": {
                "clip": 3, "crop": (224, 224), "batch": 24, "feature_weight": 0.01, "learning_rate": 1e-4,
                "steps": 300 * 300,
            },
        },
    ),
    "ifrnet+taa": Variant(
        "IFRNet at native resolution, then temporal anti-aliasing: half of the frames rendered, all pixels (+1 frame)",
        _ifrnet_taa,
        weights="ifrnet",
    ),
    "bsr": Variant(
        "bidirectional scene reprojection, interpolates at low resolution (+1 frame of latency)",
        lambda c: methods.bsr(),
    ),
    "3d-warp": Variant(
        "forward warp of both rendered frames, interpolates at low resolution (+1 frame of latency)",
        lambda c: methods.warp_3d(),
    ),
}  # fmt: skip
