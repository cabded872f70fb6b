"""Methods: each a factory that returns a ``Method``, two pure steps over a history (``essjax.interfaces``)."""

from essjax.methods._classifier import classifier
from essjax.methods._composed import composed, settled, with_taa
from essjax.methods._dlctus import dlctus
from essjax.methods._extranet import extranet
from essjax.methods._extranet import from_torch as extranet_from_torch
from essjax.methods._extrass import extrass
from essjax.methods._fasset import fasset
from essjax.methods._ifrnet import ifrnet
from essjax.methods._nsrr import nsrr
from essjax.methods._taau import taa, taau, taau_half, tus
from essjax.methods.baselines import bicubic, bilinear, gaussian_blur, jau, jau_image, warp
from essjax.methods.extrass_low import extrass_e, extrass_w
from essjax.methods.fasset_baselines import extranet_nsrr, extranet_plus, nsrr_extranet
from essjax.methods.interpolation import bsr, warp_3d
from essjax.methods.registry import make
from essjax.methods.weights import load, save

__all__ = [
    "bicubic", "bilinear", "bsr", "classifier", "composed", "dlctus", "extranet", "extranet_from_torch",
    "extranet_nsrr", "extranet_plus", "extrass", "extrass_e", "extrass_w", "fasset", "gaussian_blur", "ifrnet", "jau",
    "jau_image", "load", "make", "nsrr", "nsrr_extranet", "save", "settled", "taa", "taau", "taau_half", "tus", "warp",
    "warp_3d", "with_taa",
]  # fmt: skip
