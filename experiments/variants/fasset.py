"""FASSET, its ablations (Table 4), and what it is compared with (Table 2)."""

from functools import partial

from essjax import methods
from essjax.train import extranet_objective, fasset_objective, halving, nsrr_objective
from essjax.train.objectives.extranet import reference_shading
from experiments.variants.base import Page, StageRecipe, Variant
from experiments.variants.extranet import DECAY
from experiments.variants.nsrr import features

EPOCHS, EPOCHS_PER_HALVING = 150, 30
"""Numbers of the paper (section 3.4)."""
PRESETS = {
    #                           smoke quick  paper
    "method.width":            (8,    12,    24),
    "method.hidden":           (16,   32,    128),  # RenderINR's neurons: at output size they are most of the work
    "fasset.batch":            (2,    2,     8),
    "fasset.learning_rate":    (3e-3, 2e-3,  1e-3),
    "fasset.steps":            (6,    None,  EPOCHS * 900),
    "fasset.seconds":          (None, 590.0, None),
    "fasset.loss.hole_weight": (5.0,  0.3,   5.0),
}  # fmt: skip


def _variant(summary: str, *, page: Page | None = None, **options: bool) -> Variant:
    recipe = StageRecipe(fasset_objective, decay=partial(halving, times=EPOCHS // EPOCHS_PER_HALVING))
    factory = partial(methods.fasset, **options) if options else methods.fasset
    return Variant(summary, factory, {"fasset": recipe}, PRESETS, page=page)


VARIANTS = {
    "extranet-plus": Variant(
        "ExtraNet at output resolution on zero-upsampled frames",
        methods.extranet_plus,
        {"extranet_plus": StageRecipe(partial(extranet_objective, target_shading=reference_shading), decay=DECAY)},
        {
            #                                  smoke quick paper
            "extranet_plus.batch":            (2,    2,    8),
            "extranet_plus.clip":             (6,    6,    6),
            "extranet_plus.steps":            (6,    None, EPOCHS * 900),
            "extranet_plus.loss.hole_weight": (0.3,  1.0,  1.0),
        },
        page=Page(
            "FASSET",
            "ExtraNet fed zero-padded high-resolution frames",
            "its 0.10 M parameters are not the released net's",
            "a hole",
        ),
    ),
    "fasset": _variant(
        "FASSET: one network supersamples and extrapolates, at any output size",
        page=Page(
            "FASSET",
            "one recurrent gated U-Net for both kinds, its features decoded at any output size by an implicit MLP",
            "widths, the recurrent module, what it remembers (hidden state and last output) and how that is warped",
            "a hole",
        ),
    ),
    "fasset-no-gencoder": _variant("FASSET whose RenderINR reads the G-buffers themselves", gencoder=False),
    "fasset-no-mask": _variant("FASSET without holes in rendered frames", mask_rendered=False),
    "fasset-no-sharing": _variant("FASSET with a FrameEncoder for each task", shared=False),
    # First ExtraNet, then NSRR; the paper trains both for as many epochs as its own network.
    "extranet+nsrr": Variant(
        "ExtraNet at low resolution, then NSRR on every frame",
        methods.extranet_nsrr,
        {
            "extranet": StageRecipe(extranet_objective, method=lambda settings: methods.extranet(), decay=DECAY),
            "nsrr": StageRecipe(
                partial(nsrr_objective, half=True),
                unrolls=lambda s: methods.nsrr(scale=s.data.scale, width=s.method.width, half=True),
                vgg=features,
            ),
        },
        {
            #                             smoke quick  paper
            "method.width":              (8,    16,    32),
            "stages.clip":               (6,    9,     9),
            "stages.seconds":            (None, 145.0, None),
            "extranet.batch":            (2,    8,     8),
            "extranet.learning_rate":    (1e-3, 1e-3,  1e-3),
            "extranet.steps":            (4,    None,  EPOCHS * 900),
            "extranet.loss.hole_weight": (0.3,  1.0,   1.0),
            "nsrr.learning_rate":        (3e-3, 1e-3,  1e-4),
            "nsrr.steps":                (6,    None,  EPOCHS * 900),
            "nsrr.loss.vgg_weight":      (0.01, 0.1,   0.1),
        },
        parts={"nsrr+extranet": {}},
        page=Page(
            "FASSET, Table 2", "extrapolates at low resolution, then supersamples every frame", reactive="a hole"
        ),
    ),
    "nsrr+extranet": Variant(
        "NSRR on rendered frames, then ExtraNet at output resolution with upsampled G-buffers",
        methods.nsrr_extranet,
        weights="extranet+nsrr",
        page=Page(
            "FASSET, Table 2", "supersamples rendered frames, then extrapolates at high resolution", reactive="a hole"
        ),
    ),
}  # fmt: skip
