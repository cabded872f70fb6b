"""Methods: each a factory that returns a ``Method``, two pure steps over a history (``essjax.interfaces``)."""

from essjax.methods.baselines import bicubic, bilinear, gaussian_blur, jau, jau_image, warp
from essjax.methods.classifier import classification_network, classifier
from essjax.methods.dlctus import dlctus
from essjax.methods.extrass import extrass, extrass_e, extrass_w
from essjax.methods.fasset import fasset
from essjax.methods.nsrr import nsrr
from essjax.methods.taau import taa, taau, taau_half, tus

__all__ = [
    "bicubic", "bilinear", "classification_network", "classifier", "dlctus", "extrass", "extrass_e", "extrass_w",
    "fasset", "gaussian_blur", "jau", "jau_image", "nsrr", "taa", "taau", "taau_half", "tus", "warp",
]  # fmt: skip
