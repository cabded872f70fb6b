"""Score a rolled-out sequence frame by frame, and average what was scored."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import display
from essjax.exposure import clip_exposure
from essjax.losses.pixel import as_float32
from essjax.metrics._psnr import psnr
from essjax.metrics._ssim import ssim
from essjax.metrics.temporal import spatio_temporal_error, tpsnr, warped_error
from essjax.typing import Array, Color, Int, Mask, Motion, Scalar
from essjax.warp import compose_motion

METRICS = (
    "psnr", "ssim", "psnr_holes", "hole_share", "tpsnr", "warped_error", "warped_error_reference", "ssim_dlctus",
    "spatial_error", "temporal_error",
)  # fmt: skip
"""Names of what ``score_rollout`` measures, in the order of the tables. ``ssim_dlctus`` has the constant C2 = 0.02^2 of
thesis 002 (section 4.3.5) instead of 0.03^2; the last two are its spatio-temporal loss with theta 0 and 1."""

SAME_PHASE = ("tpsnr", "warped_error", "warped_error_reference")
"""Metrics that look ``period`` frames back. Where one frame in so many is rendered, that one was made alike; where all
are, it is as far back as well, so that equal pictures score alike whatever the schedule. The frame just before is of
another kind in the first case (or, from a method that extrapolates nothing, a repetition)."""
CONSECUTIVE = ("spatial_error", "temporal_error")
"""Metrics of a frame and the one just before, as the thesis defines them: only where every frame is rendered."""
MIN_HOLE_PIXELS = 16
"""Frames with fewer hole pixels have no ``psnr_holes``: the PSNR of a handful of pixels is noise."""


def score_rollout(
    images: Color,
    targets: Color,
    *,
    scored: Sequence[int],
    kinds: Sequence[str],
    period: int = 2,
    exposure: Scalar | float | None = None,
    holes: Mask | None = None,
    motion: Motion | None = None,
    cuts: Sequence[bool] | np.ndarray | None = None,
) -> dict[int, dict[str, Any]]:
    """Metrics of the chosen frames of one sequence, on display-referred images (``color.display`` is applied here).

    Args:
      images: ``[T, H, W, 3]`` linear HDR, what a method returned.
      targets: the same shape, what it should have returned.
      scored: indices of the frames to score; the ``period`` frames before them are read for the temporal metrics.
      kinds: "ss" or "ess" for each of the T frames.
      period: how many frames back temporal metrics look: one frame in so many is rendered.
      exposure: ``[T]`` or one number, what radiance is multiplied with before it is displayed, frames that are compared
        with frame n by that of frame n; None: ``exposure.clip_exposure`` of the targets, one number.
      holes: ``[T, H, W, 1]``, 1 on disoccluded pixels, at the images' resolution; without it ``psnr_holes`` and
        ``hole_share`` are None and the warped error looks at all pixels.
      motion: ``[T, H, W, 2]`` to the frame before, pixels at the images' resolution, with the jitter difference where
        the images are jittered; without it the errors that follow it are None.
      cuts: for each of the T frames, whether a shot starts there; None: only at frame 0.

    Returns:
      frame index -> ``{"kind": ..., metric: float or None}`` for every name in ``METRICS``: dB for the PSNRs, shares
      and mean absolute differences in [0, 1] for the rest. Temporal metrics compare a frame with the one ``period``
      before it (those in ``CONSECUTIVE`` with the one just before). None where a metric does not exist (no such frame
      in the shot, or one of another kind; fewer than ``MIN_HOLE_PIXELS`` pixels are holes) or is not finite;
      ``"non_finite"`` is 1 where image or target, of this frame or of those that it is compared with, hold NaN or
      infinity, else 0.

    Raises:
      ValueError: shapes differ, images hold integers, or a frame index or the number of kinds or cuts does not fit.
    """
    length = images.shape[0]
    images, targets = as_float32(images, targets, ("images", "targets"))
    if len(kinds) != length:
        raise ValueError(f"kinds: expected one per frame, {length}, got {len(kinds)}.")
    if cuts is not None and len(cuts) != length:
        raise ValueError(f"cuts: expected one per frame, {length}, got {len(cuts)}.")
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
    since_cut = _frames_since_cut(length, cuts)
    made = has_source(kinds, np.zeros(length, bool) if cuts is None else cuts)
    ages = distances(kinds)
    alike = np.array([since_cut[n] >= period and ages[n] == ages[n - period] and made[n - period] for n in scored])
    consecutive = (since_cut[now] >= 1) & ("ess" not in kinds)
    # Where there is nothing to compare with: the frame itself, whose values are dropped below.
    before, like = np.where(consecutive, now - 1, now), np.where(alike, now - period, now)
    shown = np.broadcast_to(clip_exposure(targets) if exposure is None else np.asarray(exposure), length)
    places = np.stack([now, before, like], axis=-1)
    measured = _score_frames(images, targets, jnp.asarray(shown, jnp.float32), holes, motion, places, period)
    columns = {name: np.asarray(values) for name, values in measured.items()}
    rows = {}
    for k, n in enumerate(scored):
        values = {name: _number(columns[name][k]) if name in columns else None for name in METRICS}
        values |= dict.fromkeys(() if alike[k] else SAME_PHASE) | dict.fromkeys(() if consecutive[k] else CONSECUTIVE)
        rows[n] = {"kind": kinds[n], **values, "non_finite": int(columns["non_finite"][k])}
    return rows


def has_source(kinds: Sequence[str], cuts: Sequence[bool] | np.ndarray) -> np.ndarray:
    """Whether each frame has anything to be made of: it, or one before it in its shot, was rendered; bool ``[T]``.

    Others show what a method falls back to (``methods.shots.unlit``), and say nothing about it.

    Args:
      kinds: "ss" or "ess" for each frame.
      cuts: for each frame, whether a shot starts there; one does at frame 0.
    """
    return distances(kinds) <= _frames_since_cut(len(kinds), cuts)


def distances(kinds: Sequence[str]) -> np.ndarray:
    """Count how many frames ago the latest rendered one was, int ``[T]``: 0 of one that is rendered itself.

    Args:
      kinds: "ss" or "ess" for each frame; before the first "ss", the distance is that to frame -1.
    """
    number = np.arange(len(kinds))
    return number - np.maximum.accumulate(np.where(np.asarray(kinds) == "ss", number, -1))


def _frames_since_cut(length: int, cuts: Sequence[bool] | np.ndarray | None) -> np.ndarray:
    """How many frames before each one belong to the same shot."""
    starts = np.zeros(length, bool) if cuts is None else np.array(cuts, bool)
    starts[0] = True
    return np.arange(length) - np.maximum.accumulate(np.where(starts, np.arange(length), 0))


@partial(jax.jit, static_argnames="period")
def _score_frames(
    images: Color,
    targets: Color,
    exposure: Scalar,
    holes: Mask | None,
    motion: Motion | None,
    places: Int[Array, "N 3"],
    period: int,
) -> dict[str, Array]:
    """Frame by frame (``lax.map``), so that memory does not grow with the length of the sequence."""
    return jax.lax.map(lambda place: _score_frame(images, targets, exposure, holes, motion, place, period), places)


def _score_frame(
    images: Color,
    targets: Color,
    exposure: Scalar,
    holes: Mask | None,
    motion: Motion | None,
    place: Int[Array, "3"],
    period: int,
) -> dict[str, Array]:
    """Metrics of a frame; ``place`` is its index, that of the one just before and that of the one of its phase."""
    pictures = images[place], targets[place]
    image, image_before, image_like = display(exposure[place[0]] * pictures[0])
    target, target_before, target_like = display(exposure[place[0]] * pictures[1])
    result = {
        "non_finite": ~jnp.all(jnp.isfinite(jnp.stack(pictures))),
        "psnr": psnr(image, target),
        "ssim": ssim(image, target),
        "ssim_dlctus": ssim(image, target, c2=0.02**2),
        "tpsnr": tpsnr(image, image_like, target, target_like),
    }
    if holes is not None:
        hole = holes[place[0]]
        enough = jnp.sum(hole) >= MIN_HOLE_PIXELS
        result["psnr_holes"] = jnp.where(enough, psnr(image, target, mask=hole), jnp.nan)
        result["hole_share"] = jnp.mean(hole)
    if motion is not None:
        last = motion[place[0]]
        path, valid = _path(motion, holes, place[0], period)
        result["warped_error"] = warped_error(image, image_like, path, valid=valid)
        result["warped_error_reference"] = warped_error(target, target_like, path, valid=valid)
        for name, theta in (("spatial_error", 0.0), ("temporal_error", 1.0)):
            result[name] = spatio_temporal_error(image, image_before, target, target_before, last, theta=theta)
    return result


def _path(motion: Motion, holes: Mask | None, now: Array, period: int) -> tuple[Motion, Mask | None]:
    """Motion from frame ``now`` to the one ``period`` before it, and where no hole is on the way (None: not known)."""
    before = jnp.maximum(now - period + 1, 0)
    path, valid = motion[before], None if holes is None else 1.0 - holes[before]
    for back in range(period - 2, -1, -1):
        frame = jnp.maximum(now - back, 0)
        path, known = compose_motion(motion[frame], path, valid_previous=valid)
        valid = None if holes is None else known * (1.0 - holes[frame])
    return path, valid


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
