"""Metrics on display-referred images in [0, 1]: one value per image, data range 1.

``score_rollout`` and everything printed take linear HDR, multiply it by an exposure (``essjax.exposure``) and apply
``essjax.color.display`` (x / (1 + x), then sRGB);
the single metrics take images that already are display-referred, with any leading axes.
"""

from essjax.losses import ssim_map
from essjax.metrics._psnr import MAX_PSNR, psnr
from essjax.metrics._ssim import ssim
from essjax.metrics.score import METRICS, MIN_HOLE_PIXELS, aggregate, distances, has_source, mean_over, score_rollout
from essjax.metrics.temporal import flicker, spatio_temporal_error, tpsnr, warped_error

__all__ = [
    "MAX_PSNR", "METRICS", "MIN_HOLE_PIXELS", "aggregate", "distances", "flicker", "has_source", "mean_over", "psnr",
    "score_rollout", "spatio_temporal_error", "ssim", "ssim_map", "tpsnr", "warped_error",
]  # fmt: skip
