"""Score a rolled-out sequence frame by frame, and average what was scored."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import display
from essjax.losses.pixel import as_float32
from essjax.metrics.psnr import psnr
from essjax.metrics.ssim import ssim
from essjax.metrics.temporal import spatio_temporal_error, tpsnr, warped_error
from essjax.typing import Array, Color, Mask, Motion

METRICS = (
    "psnr", "ssim", "psnr_holes", "hole_share", "tpsnr", "warped_error", "warped_error_reference", "ssim_dlctus",
    "spatial_error", "temporal_error",
)  # fmt: skip
"""Names of what ``score_rollout`` measures, in the order of the tables. ``ssim_dlctus`` has the constant C2 = 0.02^2 of
thesis 002 (section 4.3.5) instead of 0.03^2; the last two are its spatio-temporal loss with theta 0 and 1."""

NEED_THE_PREVIOUS_FRAME = ("tpsnr", "warped_error", "warped_error_reference", "spatial_error", "temporal_error")
MIN_HOLE_PIXELS = 16
"""Frames with fewer hole pixels have no ``psnr_holes``: the PSNR of a handful of pixels is noise."""


def score_rollout(
    images: Color,
    targets: Color,
    *,
    scored: Sequence[int],
    kinds: Sequence[str],
    holes: Mask | None = None,
    motion: Motion | None = None,
) -> dict[int, dict[str, Any]]:
    """Metrics of the chosen frames of one sequence, on display-referred images (``color.display`` is applied here).

    Args:
      images: ``[T, H, W, 3]`` linear HDR, what a method returned.
      targets: the same shape, what it should have returned.
      scored: indices of the frames to score; the frames before them are read for the temporal metrics.
      kinds: "ss" or "ess" for each of the T frames.
      holes: ``[T, H, W, 1]``, 1 on disoccluded pixels, at the images' resolution; without it ``psnr_holes`` and
        ``hole_share`` are None and the warped error looks at all pixels.
      motion: ``[T, H, W, 2]`` pixels at the images' resolution, with the jitter difference where the images are
        jittered; without it the errors that follow it are None.

    Returns:
      frame index -> ``{"kind": ..., metric: float or None}`` for every name in ``METRICS``: dB for the PSNRs, shares
      and mean absolute differences in [0, 1] for the rest. None where a metric does not exist (frame 0 has no
      predecessor; fewer than ``MIN_HOLE_PIXELS`` pixels are holes) or is not finite; ``"non_finite"`` is 1 where image
      or target, of this frame or of the one before, hold NaN or infinity, else 0.

    Raises:
      ValueError: shapes differ, images hold integers, or a frame index or the number of kinds does not fit.
    """
    length = images.shape[0]
    images, targets = as_float32(images, targets, ("images", "targets"))
    if len(kinds) != length:
        raise ValueError(f"kinds: expected one per frame, {length}, got {len(kinds)}.")
    outside = [n for n in scored if not 0 <= n < length]
    if outside:
        raise ValueError(f"scored: expected frames from 0 to {length - 1}, got {outside}.")
    for name, value in (("holes", holes), ("motion", motion)):
        if value is not None and value.shape[:-1] != images.shape[:-1]:
            raise ValueError(
                f"{name}: expected {tuple(images.shape[:-1])} as the images, got {tuple(value.shape[:-1])}."
            )
    if not scored:
        return {}
    now = np.asarray(scored)
    before = np.maximum(now - 1, 0)
    batch = (images[now], images[before], targets[now], targets[before])
    measured = _score_frames(batch, *(None if value is None else value[now] for value in (holes, motion)))
    columns = {name: np.asarray(values) for name, values in measured.items()}
    rows = {}
    for k, n in enumerate(scored):
        values = {name: _number(columns[name][k]) if name in columns else None for name in METRICS}
        if n == 0:
            values |= dict.fromkeys(NEED_THE_PREVIOUS_FRAME)
        rows[n] = {"kind": kinds[n], **values, "non_finite": int(columns["non_finite"][k])}
    return rows


@jax.jit
def _score_frames(batch: tuple[Color, ...], holes: Mask | None, motion: Motion | None) -> dict[str, Array]:
    """Frame by frame (``lax.map``), so that memory does not grow with the length of the sequence."""
    return jax.lax.map(lambda frame: _score_frame(*frame), (batch, holes, motion))


def _score_frame(batch: tuple[Color, ...], hole: Mask | None, motion: Motion | None) -> dict[str, Array]:
    image, image_before, target, target_before = (display(picture) for picture in batch)
    result = {
        "non_finite": ~jnp.all(jnp.stack([jnp.all(jnp.isfinite(picture)) for picture in batch])),
        "psnr": psnr(image, target),
        "ssim": ssim(image, target),
        "ssim_dlctus": ssim(image, target, c2=0.02**2),
        "tpsnr": tpsnr(image, image_before, target, target_before),
    }
    if hole is not None:
        enough = jnp.sum(hole) >= MIN_HOLE_PIXELS
        result["psnr_holes"] = jnp.where(enough, psnr(image, target, mask=hole), jnp.nan)
        result["hole_share"] = jnp.mean(hole)
    if motion is not None:
        valid = None if hole is None else 1.0 - hole
        result["warped_error"] = warped_error(image, image_before, motion, valid=valid)
        result["warped_error_reference"] = warped_error(target, target_before, motion, valid=valid)
        for name, theta in (("spatial_error", 0.0), ("temporal_error", 1.0)):
            result[name] = spatio_temporal_error(image, image_before, target, target_before, motion, theta=theta)
    return result


def _number(value: np.ndarray) -> float | None:
    return float(value) if math.isfinite(value) else None


def mean_over(rows: Iterable[Mapping[str, Any]], name: str) -> float | None:
    """Mean of one metric over frames (or over sequences) that have it.

    Args:
      rows: dictionaries as ``score_rollout`` (or ``aggregate``) returns them.
      name: of the metric.

    Returns:
      None where no row has it, and where one with ``"non_finite"`` frames lacks it: a mean of what is left would look
      better than the images are.
    """
    rows = list(rows)
    values = [row[name] for row in rows if row.get(name) is not None]
    spoiled = any(row.get(name) is None and row.get("non_finite") for row in rows)
    return math.fsum(values) / len(values) if values and not spoiled else None


def aggregate(rows: Iterable[Mapping[str, Any]]) -> dict[str, float | None]:
    """Mean of every metric over frames (or over sequences): the mean of PSNRs, not the PSNR of a mean.

    Args:
      rows: dictionaries as ``score_rollout`` returns them; entries that are not numbers are left out.

    Returns:
      metric -> its ``mean_over`` the rows; ``"frame_count"``, the number of rows; and ``"non_finite"``, how many frames
      hold NaN or infinity, or follow one that does.
    """
    rows = list(rows)
    means = {name: mean_over(rows, name) for name in METRICS}
    return {**means, "frame_count": len(rows), "non_finite": sum(row.get("non_finite", 0) for row in rows)}
