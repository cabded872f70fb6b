"""Methods: each a factory that returns a ``Method``, two pure steps over a history (``essjax.interfaces``)."""

from essjax.methods.baselines import bicubic, bilinear, gaussian_blur, jau, jau_image, warp
from essjax.methods.classifier import classification_network, classifier
from essjax.methods.composed import composed, settled, with_taa
from essjax.methods.dlctus import dlctus
from essjax.methods.extranet import extranet
from essjax.methods.extranet import from_torch as extranet_from_torch
from essjax.methods.extrass import extrass
from essjax.methods.extrass_low import extrass_e, extrass_w
from essjax.methods.fasset import fasset
from essjax.methods.fasset_baselines import extranet_nsrr, extranet_plus, nsrr_extranet
from essjax.methods.ifrnet import ifrnet
from essjax.methods.interpolation import bsr, warp_3d
from essjax.methods.nsrr import nsrr
from essjax.methods.taau import taa, taau, taau_half, tus

__all__ = [
    "bicubic", "bilinear", "bsr", "classification_network", "classifier", "composed", "dlctus", "extranet",
    "extranet_from_torch", "extranet_nsrr", "extranet_plus", "extrass", "extrass_e", "extrass_w", "fasset",
    "gaussian_blur", "ifrnet", "jau", "jau_image", "nsrr", "nsrr_extranet", "settled", "taa", "taau", "taau_half",
    "tus", "warp", "warp_3d", "with_taa",
]  # fmt: skip
