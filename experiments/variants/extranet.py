"""ExtraNet (SIGGRAPH Asia 2021), its ablations (Table 7), and ExtraNet with TAA as ExtraSS Table 3 runs it."""

from functools import partial
from typing import Any

from essjax import methods
from essjax.interfaces import Method
from essjax.train import cosine, extranet_objective
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget

EPOCHS, FIRST_EPOCHS = 150, 20
"""Of the paper: all (Table 3), and the first ones, after which the cosine decay starts (section 4.6)."""
PRESETS = {
    "smoke": {"clip": 6},
    "quick": {"clip": 6, "batch": 8, "learning_rate": 1e-3, "occlusion_weight": 1.0, "seconds": 290.0},
    "paper": {"clip": 6, "batch": 8, "learning_rate": 1e-3, "steps": EPOCHS * 900},
}


def extranet_stage(config: Config, method: Method, **losses: Any) -> Stage:
    """ExtraNet's training, in the main stage's settings."""
    objective = extranet_objective(method, hole_weight=config.occlusion_weight, **losses)
    decay = partial(cosine, start=FIRST_EPOCHS / EPOCHS)
    return Stage("extranet", method, objective, config.batch, config.learning_rate, main_budget(config), decay)


def _variant(summary: str, *, parts: tuple[str, ...] = (), shade_weight: float = 1.0, **options: bool) -> Variant:
    return Variant(
        summary,
        lambda config: methods.extranet(**options),
        lambda config: [extranet_stage(config, methods.extranet(**options), shade_weight=shade_weight)],
        parts=parts,
        presets=PRESETS,
    )


VARIANTS = {
    "extranet": _variant(
        "ExtraNet: extrapolates at low resolution from three rendered frames", parts=("extranet+taa",)
    ),
    "extranet-no-shade": _variant("ExtraNet without the shading-augmented loss", shade_weight=0.0),
    "extranet-no-history": _variant("ExtraNet without its history encoder", history=False),
    "extranet-no-omv": _variant("ExtraNet without occlusion motion vectors", occlusion=False),
    "extranet+taa": Variant(
        "ExtraNet at native resolution, then temporal anti-aliasing: half of the frames rendered, all pixels",
        lambda config: methods.with_taa(methods.extranet()),
        weights="extranet",
    ),
}
