"""ExtraSS (SIGGRAPH Asia 2023) and its parts."""

from essjax import methods
from essjax.losses import vgg16_features
from essjax.train import extrass_objective, frnet_objective
from experiments.settings import Settings
from experiments.variants.base import Page, StageRecipe, Variant

FRNET = {
    #                       smoke quick paper
    "frnet.learning_rate": (1e-3, 1e-3, 1e-4),
    "frnet.steps":         (4,    None, 100 * 900),
    "frnet.seconds":       (None, 30.0, None),
}  # fmt: skip
LOW = {"width": "frnet_width"}
"""The low-resolution part's arguments, in the whole."""


def _low(settings: Settings):
    return VARIANTS["extrass-e"].method(settings, LOW)


VARIANTS = {
    "extrass": Variant(
        "ExtraSS: G-buffer guided warp, FRNet, ExtraSSNet; every frame at twice the size from half of the frames",
        methods.extrass,
        {
            "frnet": StageRecipe(frnet_objective, method=_low),
            "extrassnet": StageRecipe(extrass_objective, vgg=vgg16_features),
        },
        {
            #                                    smoke quick  paper
            "method.width":                     (8,    16,    24),
            "method.frnet_width":               (8,    16,    24),
            **FRNET,
            "extrassnet.batch":                 (2,    4,     12),
            "extrassnet.learning_rate":         (3e-3, 3e-3,  4e-4),
            "extrassnet.steps":                 (6,    None,  120 * 600),
            "extrassnet.seconds":               (None, 260.0, None),
            "extrassnet.loss.occlusion_weight": (0.3,  0.3,   1.0),
            "extrassnet.loss.temporal_weight":  (0.1,  0.1,   1.0),
        },
        parts={"extrass-e": LOW},
        page=Page(
            "ExtraSS 2023",
            "G-buffer guided warp and FRNet extrapolate at low resolution; one U-Net with two encoders supersamples "
            "rendered and extrapolated frames alike",
            "FRNet's layers, all sigmas, how the output is composed: coarse-to-fine flow after IFRNet, tuned sigmas, a "
            "blend of clamped history and samples plus a residual",
            "nothing of the history at output resolution",
        ),
    ),
    "extrass-e": Variant(
        "guided warp + FRNet, extrapolates at low resolution",
        methods.extrass_e,
        {"frnet": StageRecipe(frnet_objective)},
        {"method.width": (8, 16, 24), **FRNET},
        page=Page(
            "ExtraSS 2023",
            "its low-resolution part: guided warp, then FRNet's flow",
            "as above",
            "no: the guided warp goes by G-buffers alone",
        ),
    ),
    "extrass-w": Variant(
        "G-buffer guided warp only, extrapolates at low resolution",
        methods.extrass_w,
        page=Page(
            "ExtraSS 2023",
            "its guided warp alone: 33 candidates, the 4 most similar are blended",
            "sigmas",
            "no: as above",
        ),
    ),
}  # fmt: skip
