"""NSRR (Xiao et al. 2020): supersampling of a sequence that is rendered in every frame."""

from functools import partial

from essjax import methods
from essjax.losses import vgg16_features
from essjax.train import nsrr_objective
from essjax.train.objectives.nsrr import VGG_LAYERS
from experiments.variants.base import Page, StageRecipe, Variant

features = partial(vgg16_features, layers=VGG_LAYERS)
"""Features of its perceptual term."""

VARIANTS = {
    "nsrr": Variant(
        "NSRR: a U-Net over five frames, supersampling with every frame rendered (twice the input)",
        partial(methods.nsrr, half=False),
        {"nsrr": StageRecipe(partial(nsrr_objective, half=False), vgg=features)},
        {
            # 300 epochs as in thesis 002; crops of 256 output pixels, Adam 1e-4 as published.
            #                        smoke     quick     paper
            "method.width":         (8,        16,       32),
            "nsrr.clip":            (5,        5,        5),
            "nsrr.crop":            ((32, 24), (48, 48), 256),
            "nsrr.learning_rate":   (3e-3,     1e-3,     1e-4),
            "nsrr.steps":           (6,        None,     300 * 900),
            "nsrr.loss.vgg_weight": (0.01,     0.1,      0.1),
        },
        page=Page(
            "Xiao et al. 2020",
            "five zero-upsampled frames with learned features, warped to the current one, reweighted, reconstructed by "
            "a U-Net",
            "no YCbCr, as the thesis trains it",
        ),
    ),
}  # fmt: skip
