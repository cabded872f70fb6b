"""Baselines without training."""

from essjax import methods
from experiments.variants.base import Variant

VARIANTS = {
    "warp": Variant("plain warp of the last rendered frame, low resolution", lambda c: methods.warp()),
    "warp-blur": Variant(
        "the same of a frame blurred by 0.5 px: what denoising alone is worth", lambda c: methods.warp(blur=0.5)
    ),
    "bilinear": Variant("bilinear upscaling of each rendered frame", lambda c: methods.bilinear(scale=c.scale)),
    "bicubic": Variant("bicubic upscaling of each rendered frame", lambda c: methods.bicubic(scale=c.scale)),
    "jau": Variant("jitter-aligned bilinear upscaling", lambda c: methods.jau(scale=c.scale)),
    "jau-bicubic": Variant("jitter-aligned bicubic upscaling", lambda c: methods.jau(scale=c.scale, mode="bicubic")),
    "tus": Variant(
        "temporal upsampling with the settings of the DLCTUS thesis, every frame rendered",
        lambda c: methods.tus(scale=c.scale),
    ),
    "taau": Variant(
        "temporal anti-aliasing with upsampling on every frame (twice the input)",
        lambda c, **settings: methods.taau(scale=c.scale, **settings),
        tuned=True,
    ),
    "taau-half": Variant(
        "the same on rendered frames, its output warped in between",
        lambda c, **settings: methods.taau_half(scale=c.scale, **settings),
        tuned=True,
    ),
    "taa": Variant(
        "temporal anti-aliasing at native resolution (the reference that costs four times the pixels)",
        lambda c, **settings: methods.taa(**settings),
        tuned=True,
    ),
}
