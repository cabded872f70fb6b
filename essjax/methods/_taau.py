"""Temporal accumulation: TAAU (upsampling), TAAU on half the frames, TAA (native resolution), TUS. One code path.

Thesis 002 section 2.4, "TUS" (eq 34, 38-42). All inside x / (1 + x), per channel: as in practice, so that one bright
sample does not rule a pixel for many frames.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.color import reinhard, reinhard_inverse, rgb_to_ycocg, ycocg_to_rgb
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, frame_size, rendered_color
from essjax.interfaces import Method, MethodInfo, expand_flag, refuse_extrapolation
from essjax.methods.registry import registered
from essjax.methods.shots import path_trust, upsampled_reactive, within_shots
from essjax.sizes import Scale, Size, check_scale, output_size
from essjax.typing import Array, PyTree
from essjax.warp import (
    Resampled,
    backward_warp,
    dilate_motion,
    gaussian_resample,
    inside_mask,
    jitter_aligned_upsample,
    tent_resample,
    upsample_motion,
)

CLAMPS = ("none", "rgb", "ycocg")
RECTIFICATIONS = ("clamp", "clip")
KERNELS = ("gaussian", "tent")
ACCUMULATIONS = ("bounded", "constant", "average")
UPSAMPLED_WEIGHT = 1e-3
"""The weight of a jitter-aligned upsampled colour where no sample of its frame fell into the pixel (β = 0): history
that the first sample replaces."""


class Settings(NamedTuple):
    """Settings that are fixed at trace time; see ``taau``."""

    scale: Scale
    clamp: str
    dilate: bool
    history_mode: str
    rectification: str = "clamp"
    kernel: str = "gaussian"
    accumulation: str = "bounded"


def clip_to_box(color: Array, low: Array, high: Array, center: Array) -> Array:
    """Move ``color`` towards ``center``, which lies in the box, until it is in it too (AABB clipping, section 2.4.4).

    Unlike a clamp it keeps the direction from the centre, hence the hue.

    Args:
      color: ``[..., C]``.
      low: ``[..., C]`` smallest corner of the box.
      high: largest corner.
      center: where colours move to.
    """
    direction = color - center
    room = jnp.where(direction > 0, high, low) - center
    shares = jnp.where(direction == 0, 1.0, room / jnp.where(direction == 0, 1.0, direction))
    return center + jnp.clip(jnp.min(shares, axis=-1, keepdims=True), 0.0, 1.0) * direction


def _rectify(history: Array, current: Resampled, settings: Settings) -> Array:
    if settings.clamp == "none":
        return history
    encode, decode = (rgb_to_ycocg, ycocg_to_rgb) if settings.clamp == "ycocg" else (lambda x: x, lambda x: x)
    if settings.rectification == "clip":
        return decode(clip_to_box(encode(history), current.low, current.high, current.average))
    return decode(jnp.clip(encode(history), current.low, current.high))


def _size(frame: Frame, settings: Settings) -> Size:
    return output_size(settings.scale, frame_size(frame))


def _output_motion(frame: Frame, settings: Settings) -> Array:
    motion = dilate_motion(frame.motion, frame.gbuffers.depth) if settings.dilate else frame.motion
    return upsample_motion(motion, _size(frame, settings), jitter=frame.jitter)


def _path(history: PyTree, frame: Frame, settings: Settings) -> tuple[Array, Array | None]:
    """From this frame to the image in the history, at output resolution: motion, and what masks leave of it."""
    motion, reactive = _output_motion(frame, settings), upsampled_reactive(frame, _size(frame, settings))
    if "motion" not in history:  # every frame is rendered: the image is the previous frame's
        return motion, None if reactive is None else 1.0 - reactive
    trust = path_trust(history["trust"], reactive, motion)
    return motion + backward_warp(history["motion"], motion), trust


def _reproject(
    history: PyTree, motion: Array, trust: Array | None, frame: Frame, settings: Settings
) -> tuple[Array, Array]:
    """Read the history's image at the current pixels, x / (1 + x), and its count: 0 where none (off screen, cut)."""
    color = jnp.clip(backward_warp(reinhard(history["color"]), motion, mode=settings.history_mode), 0.0, 1.0)
    count = backward_warp(history["count"], motion) * inside_mask(motion)
    count = count if trust is None else count * trust
    return color, jnp.where(expand_flag(frame.cut, count.ndim), 0.0, count)


def _blend(count: Array, weight: Array, alpha: Array, settings: Settings) -> tuple[Array, Array]:
    """α β of eq 39, and the count that remains: the sum of the βs so far, which is N for a box."""
    if settings.accumulation == "constant":  # its count is 1, less where history is not trusted in full
        rate = alpha * weight
        return rate + (1.0 - rate) * (1.0 - count), jnp.ones_like(count)
    total = count + weight
    if settings.accumulation == "bounded":  # α at least 1 / N: a new pixel converges as fast as an average does
        total = jnp.minimum(total, 1.0 / alpha)
    if settings.kernel == "tent":
        total = jnp.maximum(total, UPSAMPLED_WEIGHT)
    return jnp.minimum(weight / total, 1.0), total


def _render_step(settings: Settings, variables: PyTree, history: PyTree, frame: Frame) -> tuple[PyTree, Prediction]:
    color = reinhard(rendered_color(frame, "taau"))
    bounded = rgb_to_ycocg(color) if settings.clamp == "ycocg" else color
    if settings.kernel == "tent":
        current = tent_resample(color, bounded, frame.jitter, _size(frame, settings))
    else:
        current = gaussian_resample(color, bounded, frame.jitter, variables["sigma"], _size(frame, settings))
    past, count = _reproject(history, *_path(history, frame, settings), frame, settings)
    rate, total = _blend(count, current.weight, variables["alpha"], settings)
    rate = jnp.where(count > 0, rate, 1.0)
    past = _rectify(past, current, settings)
    image = past + rate * (current.color - past)
    upsampled = jitter_aligned_upsample(color, _size(frame, settings), frame.jitter)
    image = jnp.where(count > 0, image, upsampled)
    image = reinhard_inverse(image)
    new = {"color": image, "count": total}
    if "motion" in history:
        new["motion"] = jnp.zeros_like(history["motion"])
        new["trust"] = jax.tree.map(jnp.ones_like, history["trust"])
    return new, Prediction(image=image, aux={"rate": rate})


def _warp_step(settings: Settings, history: PyTree, frame: Frame) -> tuple[PyTree, Prediction]:
    motion, trust = _path(history, frame, settings)
    image, _ = _reproject(history, motion, trust, frame, settings)
    return {**history, "motion": motion, "trust": trust}, Prediction(image=reinhard_inverse(image))


def _accumulator(name: str, settings: Settings, alpha: float, sigma: float, *, half: bool, native: bool) -> Method:
    choices = {"clamp": CLAMPS, "rectification": RECTIFICATIONS, "kernel": KERNELS, "accumulation": ACCUMULATIONS}
    for option, allowed in choices.items():
        if getattr(settings, option) not in allowed:
            raise ValueError(f"{option}: expected one of {', '.join(allowed)}, got {getattr(settings, option)!r}.")
    settings = settings._replace(scale=check_scale(settings.scale))
    if not (0 < alpha <= 1 and sigma > 0):
        raise ValueError(f"expected 0 < alpha <= 1 and sigma > 0, got alpha = {alpha} and sigma = {sigma}.")

    def init(key, example: Frame) -> PyTree:
        return {"alpha": jnp.asarray(alpha, jnp.float32), "sigma": jnp.asarray(sigma, jnp.float32)}

    def start(example: Frame) -> PyTree:
        size = (*example.motion.shape[:-3], *_size(example, settings))
        history = {"color": jnp.zeros((*size, 3), jnp.float32), "count": jnp.zeros((*size, 1), jnp.float32)}
        if half:
            history["motion"] = jnp.zeros((*size, 2), jnp.float32)
            history["trust"] = None if example.reactive is None else jnp.ones((*size, 1), jnp.float32)
        return history

    def render_step(variables, history, frame, *, train=False):
        return _render_step(settings, variables, history, frame)

    def extrapolate_step(variables, history, frame, *, train=False):
        return _warp_step(settings, history, frame)

    def map_radiance(function, history):
        return {**history, "color": function(history["color"])}

    info = MethodInfo(
        name=name,
        scale=settings.scale,
        predicts=frozenset({"ss", "ess"} if half else {"ss"}),
        native=native,
        renders_all=not half,
    )
    if not half:
        return exposed(Method(init, start, render_step, refuse_extrapolation(name), info), map_radiance)
    return within_shots(exposed(Method(init, start, render_step, extrapolate_step, info), map_radiance))


@registered
def taau(
    *,
    scale: Scale = 2,
    alpha: float = 0.7,
    sigma: float = 0.8,
    clamp: str = "ycocg",
    dilate: bool = True,
    history_mode: str = "bicubic",
    rectification: str = "clamp",
    kernel: str = "gaussian",
    accumulation: str = "bounded",
) -> Method:
    """Temporal upsampling of a sequence that is rendered in every frame: the reference with twice the input.

    Each frame: samples of the current frame are resampled (eq 38), history is reprojected with dilated motion and
    clamped to the neighbourhood of the current samples, and both are blended with α β (eq 39). Where there is no
    history (first frame, cut, off screen) it is the jitter-aligned upsampled frame, and α is at least 1 / N (N:
    accumulated βs), so a new pixel first averages.

    The defaults are the best of a grid on validation frames (built-in scenes 24.6 dB against 22.4 of ``bilinear`` after
    ``color.display``; chess clip 31.4 against 29.2 after x / (1 + x)). Static scenes want a smaller alpha.

    ``variables`` are ``{"alpha", "sigma"}``, float32 scalars: a grid over them needs no new compilation.

    Args:
      scale: output size over input size, any number >= 1, or the output's (width, height).
      alpha: share of the current sample, (0, 1]. "bounded": N is at most 1 / alpha, our reading; "constant": there are
        at most (2 - alpha) / alpha effective samples (eq 37).
      sigma: standard deviation of the Gaussian, output pixels.
      clamp: "none", "rgb" or "ycocg": history must be in the box from minimum to maximum of the nearest 3 x 3 samples.
      dilate: take motion from the nearest surface of the 3 x 3 neighbourhood, so that silhouettes keep their history.
      history_mode: how history is read, see ``warp.sample``.
      rectification: "clamp" each channel to that box, or "clip" towards the samples' mean (``clip_to_box``).
      kernel: "gaussian" (eq 41), β its largest weight (eq 42), or "tent" of one output pixel (eq 40), β 1 in the pixel
        that a sample fell into and 0 elsewhere.
      accumulation: "bounded": the larger of α β and β / N, N the sum of the βs; "constant": α β, eq 39 as it is;
        "average": β / N, without a bound (``alpha`` is not used).

    Raises:
      ValueError: an unknown name, or settings out of range.
    """
    settings = Settings(scale, clamp, dilate, history_mode, rectification, kernel, accumulation)
    return _accumulator("taau", settings, alpha, sigma, half=False, native=False)


@registered
def taau_half(
    *,
    scale: Scale = 2,
    alpha: float = 0.7,
    sigma: float = 0.8,
    clamp: str = "ycocg",
    dilate: bool = True,
    history_mode: str = "bicubic",
    rectification: str = "clamp",
    kernel: str = "gaussian",
    accumulation: str = "bounded",
) -> Method:
    """``taau`` on rendered frames only; in between, its last output warped by motion. Same arguments.

    The history stays the last *rendered* output, and motion is composed along the path to it: every image, rendered or
    not, is one resampling away from it, however many frames lie between.
    """
    settings = Settings(scale, clamp, dilate, history_mode, rectification, kernel, accumulation)
    return _accumulator("taau-half", settings, alpha, sigma, half=True, native=False)


@registered
def taa(
    *,
    alpha: float = 0.5,
    sigma: float = 0.5,
    clamp: str = "ycocg",
    dilate: bool = True,
    history_mode: str = "bicubic",
    rectification: str = "clamp",
    kernel: str = "gaussian",
    accumulation: str = "bounded",
) -> Method:
    """Temporal anti-aliasing of native-resolution frames with their own jitter: ``taau`` at scale 1. Same arguments."""
    settings = Settings(1, clamp, dilate, history_mode, rectification, kernel, accumulation)
    return _accumulator("taa", settings, alpha, sigma, half=False, native=True)


@registered
def tus(*, scale: Scale = 2, alpha: float | None = None, sigma: float = 0.65, clamp: str = "rgb") -> Method:
    """Make the TUS row of thesis 002 (section 5.3.1): history clamping, bicubic (a = -0.75), no dilation.

    Constant α, and history that is started and padded with the jitter-aligned upsampled frame, as in ``dlctus``. Our
    reading of what is not said: the Gaussian, and the clamp's box in RGB. On the built-in scenes at 2x2 (validation,
    thesis jitter) it gets 26.0 dB, with the tent 24.6.

    Args:
      scale: see ``taau``.
      alpha: share of the current sample; None: 0.5, and 1 for scale 4, as in the thesis.
      sigma: standard deviation of the Gaussian, output pixels.
      clamp: see ``taau``.

    Raises:
      ValueError: see ``taau``.
    """
    alpha = (1.0 if scale == 4 else 0.5) if alpha is None else alpha
    settings = Settings(scale, clamp, False, "bicubic-0.75", accumulation="constant")
    return _accumulator("tus", settings, alpha, sigma, half=False, native=False)
