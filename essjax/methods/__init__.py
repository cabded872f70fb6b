"""Methods: each a factory that returns a ``Method``, two pure steps over a history (``essjax.interfaces``)."""

from essjax.methods.baselines import bicubic, bilinear, gaussian_blur, jau, jau_image, warp
<<<<<<< HEAD
from essjax.methods.extranet import extranet
from essjax.methods.extranet import from_torch as extranet_from_torch
=======
from essjax.methods.dlctus import dlctus
>>>>>>> main
from essjax.methods.extrass import extrass, extrass_e, extrass_w
from essjax.methods.nsrr import nsrr
from essjax.methods.taau import gaussian_resample, taa, taau, taau_half

__all__ = [
<<<<<<< HEAD
    "bicubic", "bilinear", "extranet", "extranet_from_torch", "extrass", "extrass_e", "extrass_w", "gaussian_blur",
    "gaussian_resample", "jau", "jau_image", "taa", "taau", "taau_half", "warp",
=======
    "bicubic", "bilinear", "dlctus", "extrass", "extrass_e", "extrass_w", "gaussian_blur", "gaussian_resample", "jau",
    "jau_image", "nsrr", "taa", "taau", "taau_half", "warp",
>>>>>>> main
]  # fmt: skip
