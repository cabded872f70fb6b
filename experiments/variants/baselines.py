"""Baselines without training."""

from functools import partial

from essjax import methods
from experiments.variants.base import Page, Variant

VARIANTS = {
    "warp": Variant(
        "plain warp of the last rendered frame, low resolution",
        methods.warp,
        page=Page("–", "bilinear warp of the last rendered frame", reactive="no: there is nothing else to show"),
    ),
    "warp-blur": Variant(
        "the same of a frame blurred by 0.5 px: what denoising alone is worth", partial(methods.warp, blur=0.5)
    ),
    "bilinear": Variant(
        "bilinear upscaling of each rendered frame",
        methods.bilinear,
        page=Page("–", "upsampling that does not know where the samples lie"),
    ),
    "bicubic": Variant(
        "bicubic upscaling of each rendered frame", methods.bicubic, page=Page("–", "the same, bicubic")
    ),
    "jau": Variant(
        "jitter-aligned bilinear upscaling",
        methods.jau,
        page=Page("DLCTUS thesis", "upsampling that knows where the samples lie"),
    ),
    "jau-bicubic": Variant("jitter-aligned bicubic upscaling", partial(methods.jau, mode="bicubic")),
    "tus": Variant(
        "temporal upsampling with the settings of the DLCTUS thesis, every frame rendered",
        methods.tus,
        page=Page("DLCTUS thesis", "TAAU with the thesis' own settings"),
    ),
    "taau": Variant(
        "temporal anti-aliasing with upsampling on every frame (twice the input)",
        methods.taau,
        tuned=True,
        page=Page(
            "Yang et al. 2020", "temporal accumulation of jittered samples on the output grid", "best setting, tuned"
        ),
    ),
    "taau-half": Variant(
        "the same on rendered frames, its output warped in between",
        methods.taau_half,
        tuned=True,
        page=Page(
            "–",
            "TAAU on rendered frames, its output warped in between",
            "best setting, tuned",
            "warped all the same: there is nothing else; new in the next rendered frame",
        ),
    ),
    "taa": Variant(
        "temporal anti-aliasing at native resolution (the reference that costs four times the pixels)",
        methods.taa,
        tuned=True,
        page=Page("Karis 2014", "temporal accumulation at native resolution", "best setting, tuned"),
    ),
}
