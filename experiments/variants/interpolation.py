"""Methods that interpolate between rendered frames, at the price of one frame of latency."""

from essjax import methods
from essjax.interfaces import Method
from essjax.train import ifrnet_objective
from experiments.variants.base import Page, StageRecipe, Variant


def _ifrnet_taa(*, width: int = 24) -> Method:
    return methods.with_taa(methods.ifrnet(width=width))


VARIANTS = {
    "ifrnet": Variant(
        "IFRNet: interpolation by learned optical flow, without G-buffers, low resolution (+1 frame of latency)",
        methods.ifrnet,
        {"ifrnet": StageRecipe(ifrnet_objective)},
        {
            # 300 epochs, batch 24, crops of 224, Adam 1e-4 as published, on ExtraSS's epochs.
            #                        smoke     quick     paper
            "method.width":         (8,        16,       24),
            "ifrnet.batch":         (2,        8,        24),
            "ifrnet.clip":          (3,        3,        3),
            "ifrnet.crop":          ((32, 24), (48, 48), (224, 224)),
            "ifrnet.learning_rate": (3e-3,     1e-3,     1e-4),
            "ifrnet.steps":         (6,        None,     300 * 300),
        },
        parts={"ifrnet+taa": {}},
        page=Page(
            "Kong et al. 2022",
            "flows to both neighbours, coarse to fine, with an intermediate feature",
            "jitter of its inputs",
            "no: both neighbours are read everywhere",
        ),
    ),
    "ifrnet+taa": Variant(
        "IFRNet at native resolution, then temporal anti-aliasing: half of the frames rendered, all pixels (+1 frame)",
        _ifrnet_taa,
        weights="ifrnet",
        page=Page(
            "ExtraSS 2023, Table 3",
            "IFRNet at output resolution, then TAA",
            "TAA's settings: its defaults, not tuned",
            "no: as above",
        ),
    ),
    "bsr": Variant(
        "bidirectional scene reprojection, interpolates at low resolution (+1 frame of latency)",
        methods.bsr,
        page=Page(
            "Yang et al. 2011",
            "fixed-point search for each pixel in both neighbours, then a blend",
            "iterations",
            "no: as above",
        ),
    ),
    "3d-warp": Variant(
        "forward warp of both rendered frames, interpolates at low resolution (+1 frame of latency)",
        methods.warp_3d,
        page=Page(
            "Mark et al. 1997",
            "both neighbours splatted to the middle by motion and depth",
            "hole filling",
            "no: as above",
        ),
    ),
}  # fmt: skip
