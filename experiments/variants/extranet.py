"""ExtraNet (SIGGRAPH Asia 2021), its ablations (Table 7), and ExtraNet with TAA as ExtraSS Table 3 runs it."""

from collections.abc import Callable, Mapping
from functools import partial

from essjax import methods
from essjax.interfaces import Method
from essjax.train import cosine, extranet_objective
from experiments.variants.base import Page, StageRecipe, Variant

EPOCHS, FIRST_EPOCHS = 150, 20
"""Epochs of the paper: all (Table 3), and the first ones, after which the cosine decay starts (section 4.6)."""
DECAY = partial(cosine, start=FIRST_EPOCHS / EPOCHS)
PRESETS = {
    #                             smoke quick paper
    "extranet.batch":            (2,    8,    8),
    "extranet.clip":             (6,    6,    6),
    "extranet.steps":            (6,    None, EPOCHS * 900),
    "extranet.loss.hole_weight": (0.3,  1.0,  1.0),
}  # fmt: skip


def _variant(
    summary: str,
    factory: Callable[..., Method] = methods.extranet,
    objective: Callable = extranet_objective,
    *,
    page: Page | None = None,
    parts: Mapping[str, Mapping[str, str]] | None = None,
) -> Variant:
    return Variant(
        summary, factory, {"extranet": StageRecipe(objective, decay=DECAY)}, PRESETS, page=page, parts=parts or {}
    )


VARIANTS = {
    "extranet": _variant(
        "ExtraNet: extrapolates at low resolution from three rendered frames",
        parts={"extranet+taa": {}},
        page=Page(
            "ExtraNet 2021",
            "plain and occlusion-aware warps of the last frame, holes filled by a gated U-Net that also sees three "
            "encoded earlier frames",
            "thresholds of the holes depend on the scene's scale: ours are in pixel footprints",
            "a hole",
        ),
    ),
    "extranet-no-shade": _variant(
        "ExtraNet without the shading-augmented loss", objective=partial(extranet_objective, shade_weight=0.0)
    ),
    "extranet-no-history": _variant("ExtraNet without its history encoder", partial(methods.extranet, history=False)),
    "extranet-no-omv": _variant(
        "ExtraNet without occlusion motion vectors", partial(methods.extranet, occlusion=False)
    ),
    "extranet+taa": Variant(
        "ExtraNet at native resolution, then temporal anti-aliasing: half of the frames rendered, all pixels",
        lambda: methods.with_taa(methods.extranet()),
        weights="extranet",
        page=Page(
            "ExtraSS 2023, Table 3",
            "ExtraNet at output resolution, then TAA",
            "TAA's settings: its defaults, not tuned",
            "a hole",
        ),
    ),
}
