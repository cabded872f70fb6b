"""DLCTUS (thesis 002), what its tables change in training (10, 16) and at test time (13, 14)."""

from functools import partial
from typing import Any

from essjax import methods
from essjax.train import dlctus_objective
from experiments.variants.base import Page, StageRecipe, Variant

EPOCHS = 200
PRESETS = {
    #                       smoke     quick     paper
    "training.anneal":      (True,     True,     False),
    "dlctus.batch":         (2,        4,        4),
    "dlctus.clip":          (4,        10,       30),
    "dlctus.crop":          ((32, 24), (48, 48), 256),  # of the output: 256 / f_u of the input (4.3.2)
    "dlctus.learning_rate": (3e-3,     4e-3,     1e-4),
    "dlctus.steps":         (6,        None,     EPOCHS * 1800),
}  # fmt: skip


def _trained(summary: str, *, theta: float | None = None, page: Page | None = None, **options: Any) -> Variant:
    objective = dlctus_objective if theta is None else partial(dlctus_objective, theta=theta)
    factory = partial(methods.dlctus, **options) if options else methods.dlctus
    return Variant(summary, factory, {"dlctus": StageRecipe(objective)}, PRESETS, page=page)


def _at_test_time(summary: str, **options: Any) -> Variant:
    return Variant(summary, partial(methods.dlctus, **options), weights="dlctus")


VARIANTS = {
    "dlctus": _trained(
        "DLCTUS: a recurrent network blends upsampled frames into the history, every frame rendered",
        page=Page(
            "DLCTUS thesis",
            "a small residual network at a quarter of the output size blends jitter-aligned input and warped history, "
            "with its own count of samples",
            "colour must lie in [0, 1]: x / (1 + x)",
        ),
    ),
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
