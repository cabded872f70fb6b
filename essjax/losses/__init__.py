"""Losses, each a named, unreduced term: a map per pixel that the training objective weighs, masks and averages.

Inputs are ``[..., H, W, C]`` with any leading axes, on whatever scale the objective works on (log(1 + x) unless said
otherwise). Gradients are finite everywhere. Reduce with ``jnp.mean``, ``masked_mean`` or ``sum_of_means``.
"""

from essjax.losses._census import census, feature_census
from essjax.losses._perceptual import perceptual
from essjax.losses.classes import class_weights, cross_entropy
from essjax.losses.holes import hardest, masked_mean, occlusion
from essjax.losses.pixel import charbonnier, l1
from essjax.losses.ssim import ssim_map
from essjax.losses.temporal import feature_l1, spatio_temporal, sum_of_means, temporal_l1
from essjax.losses.vgg import vgg16_features

__all__ = [
    "census", "charbonnier", "class_weights", "cross_entropy",
    "feature_census", "feature_l1", "hardest", "l1", "masked_mean", "occlusion",
    "perceptual", "spatio_temporal", "ssim_map", "sum_of_means", "temporal_l1", "vgg16_features",
]  # fmt: skip
