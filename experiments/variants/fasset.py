"""FASSET and its ablations (Table 4)."""

from functools import partial

from essjax import methods
from essjax.interfaces import Method
from essjax.train import fasset_objective, halving
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget

EPOCHS, EPOCHS_PER_HALVING = 150, 30
"""Of the paper (section 3.4)."""
PRESETS = {
    "smoke": {"occlusion_weight": 5.0},
    "quick": {"batch": 2, "learning_rate": 2e-3, "occlusion_weight": 5.0, "seconds": 290.0},
    "paper": {"batch": 8, "learning_rate": 1e-3, "occlusion_weight": 5.0, "steps": EPOCHS * 900},
}


def _variant(summary: str, **options: bool) -> Variant:
    def method(config: Config) -> Method:
        return methods.fasset(scale=config.scale, width=config.width, **options)

    def stages(config: Config) -> list[Stage]:
        objective = fasset_objective(method(config), hole_weight=config.occlusion_weight)
        decay = partial(halving, times=EPOCHS // EPOCHS_PER_HALVING)
        return [
            Stage("fasset", method(config), objective, config.batch, config.learning_rate, main_budget(config), decay)
        ]

    return Variant(summary, method, stages, presets=PRESETS)


VARIANTS = {
    "fasset": _variant("FASSET: one network supersamples and extrapolates, at any output size"),
    "fasset-no-gencoder": _variant("FASSET whose RenderINR reads the G-buffers themselves", gencoder=False),
    "fasset-no-mask": _variant("FASSET without holes in rendered frames", mask_rendered=False),
    "fasset-no-sharing": _variant("FASSET with a FrameEncoder for each task", shared=False),
}
