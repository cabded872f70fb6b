"""DLCTUS (thesis 002), what its tables change in training (10, 16) and at test time (13, 14)."""

from typing import Any

from essjax import methods
from essjax.train import dlctus_objective
from experiments.config import Config
from experiments.variants.base import Stage, Variant, main_budget

EPOCHS = 200
PRESETS = {
    "smoke": {"clip": 4},
    "quick": {"clip": 10, "learning_rate": 4e-3, "seconds": 290.0},
    "paper": {"clip": 30, "batch": 4, "learning_rate": 1e-4, "steps": EPOCHS * 1800, "anneal": False},
}
CROPS = {"paper": 256}
"""Output pixels: the input is cut to 256 / f_u (section 4.3.2)."""


def _stage(config: Config, theta: float | None, options: dict[str, Any]) -> Stage:
    method = methods.dlctus(scale=config.scale, **options)
    objective = dlctus_objective(method, theta=theta)
    return Stage("dlctus", method, objective, config.batch, config.learning_rate, main_budget(config))


def _trained(summary: str, *, theta: float | None = None, **options: Any) -> Variant:
    return Variant(
        summary,
        lambda config: methods.dlctus(scale=config.scale, **options),
        lambda config: [_stage(config, theta, options)],
        presets=PRESETS,
        crops=CROPS,
    )


def _at_test_time(summary: str, **options: Any) -> Variant:
    return Variant(summary, lambda config: methods.dlctus(scale=config.scale, **options), weights="dlctus")


VARIANTS = {
    "dlctus": _trained("DLCTUS: a recurrent network blends upsampled frames into the history, every frame rendered"),
    "dlctus-no-accumulation": _trained("DLCTUS without its accumulation buffer", accumulation=False),
    **{
        f"dlctus-theta-{theta:g}": _trained(f"DLCTUS with the spatio-temporal loss, theta {theta:g}", theta=theta)
        for theta in (0.1, 0.5, 0.9)
    },
    "dlctus-bilinear": _at_test_time("DLCTUS with bilinear reprojection at test time", reprojection="bilinear"),
    "dlctus-5tap": _at_test_time("DLCTUS with Unreal Engine's five fetches at test time", reprojection="5-tap"),
    "dlctus-9tap": _at_test_time("DLCTUS with bicubic reads made of nine fetches: the same", reprojection="9-tap"),
    "dlctus-dilated": _at_test_time("DLCTUS with dilated motion at test time", dilate=True),
}
