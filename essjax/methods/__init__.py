"""Methods: each a factory that returns a ``Method``, two pure steps over a history (``essjax.interfaces``)."""

from essjax.methods.baselines import bicubic, bilinear, gaussian_blur, jau, jau_image, warp
from essjax.methods.composed import composed, extranet_taa, settled
from essjax.methods.dlctus import dlctus
from essjax.methods.extranet import extranet
from essjax.methods.extranet import from_torch as extranet_from_torch
from essjax.methods.extrass import extrass, extrass_e, extrass_w
from essjax.methods.fasset import fasset
from essjax.methods.nsrr import nsrr
from essjax.methods.taau import taa, taau, taau_half, tus

__all__ = [
    "bicubic", "bilinear", "composed", "dlctus", "extranet", "extranet_from_torch", "extranet_taa", "extrass",
    "extrass_e", "extrass_w", "fasset", "gaussian_blur", "jau", "jau_image", "nsrr", "settled", "taa", "taau",
    "taau_half", "tus", "warp",
]  # fmt: skip
