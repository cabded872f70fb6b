"""Baselines without history of their own: spatial upscalers, and the plain warp of the last rendered frame."""

import dataclasses
import math

import jax.numpy as jnp

from essjax.color import reinhard, reinhard_inverse
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, frame_size, rendered_color
from essjax.interfaces import Method, MethodInfo, no_variables
from essjax.methods.registry import registered
from essjax.methods.shots import within_shots
from essjax.sizes import Scale, Size, check_scale, output_size
from essjax.typing import Array, Callable, Image, PyTree
from essjax.warp import backward_warp, compose_motion, jitter_aligned_upsample, jittered_motion


def jau_image(frame: Frame, size: Size, *, mode: str = "bilinear") -> Array:
    """Upsample the frame's colour from where its samples lie (JAU, SPEC 4), ``[..., *size, 3]``.

    Inside x / (1 + x): a highlight then does not bleed over its neighbours and bicubic kernels hardly ring. It is the
    stronger baseline (bilinear on the chess clip: 29.7 dB, on radiance 29.1, after x / (1 + x)).
    """
    color = reinhard(rendered_color(frame, "upscaling"))
    return reinhard_inverse(jitter_aligned_upsample(color, size, frame.jitter, mode=mode))


def _spatial(name: str, scale: Scale, upscale: Callable[[Frame, Size], Array]) -> Method:
    """Make a method that upscales each rendered frame by itself and repeats it on frames without colour."""
    scale = check_scale(scale)

    def start(example: Frame) -> PyTree:
        size = output_size(scale, frame_size(example))
        return {"image": jnp.zeros((*example.motion.shape[:-3], *size, 3), jnp.float32)}

    def render_step(variables, history, frame, *, train=False):
        image = upscale(frame, output_size(scale, frame_size(frame)))
        return {"image": image}, Prediction(image=image)

    def extrapolate_step(variables, history, frame, *, train=False):
        return history, Prediction(image=history["image"])

    def map_radiance(function, history):
        return {"image": function(history["image"])}

    info = MethodInfo(name=name, scale=scale, predicts=frozenset({"ss"}))
    return within_shots(exposed(Method(no_variables, start, render_step, extrapolate_step, info), map_radiance))


def _without_jitter(frame: Frame) -> Frame:
    return dataclasses.replace(frame, jitter=jnp.zeros_like(frame.jitter))


@registered
def bilinear(*, scale: Scale = 2) -> Method:
    """Bilinear upscaling of each rendered frame in x / (1 + x); like a plain upscaler it ignores the jitter.

    Frames without colour repeat the last image and are not scored.

    Args:
      scale: output size over input size, any number >= 1, or the output's (width, height).
    """
    return _spatial("bilinear", scale, lambda frame, size: jau_image(_without_jitter(frame), size))


@registered
def bicubic(*, scale: Scale = 2) -> Method:
    """Bicubic (a = -0.5) upscaling of each rendered frame on x / (1 + x); ignores the jitter. See ``bilinear``.

    Args:
      scale: output size over input size, any number >= 1, or the output's (width, height).
    """
    return _spatial("bicubic", scale, lambda frame, size: jau_image(_without_jitter(frame), size, mode="bicubic"))


@registered
def jau(*, scale: Scale = 2, mode: str = "bilinear") -> Method:
    """Jitter-aligned upsampling of each rendered frame: it reads where the samples really lie. See ``bilinear``.

    Args:
      scale: output size over input size, any number >= 1, or the output's (width, height).
      mode: "nearest", "bilinear", "bicubic" or "bicubic-0.75"; not bilinear is named ``jau-<mode>``.
    """
    name = "jau" if mode == "bilinear" else f"jau-{mode}"
    return _spatial(name, scale, lambda frame, size: jau_image(frame, size, mode=mode))


def gaussian_blur(image: Image, std: float) -> Array:
    """Separable Gaussian blur with ``std`` in pixels, radius ``ceil(3 std)``, borders repeated; 0 changes nothing."""
    radius = math.ceil(3.0 * std)
    if radius == 0:
        return image
    weights = [math.exp(-0.5 * (k / std) ** 2) for k in range(-radius, radius + 1)]
    for axis in (-3, -2):
        size = image.shape[axis]
        padding = [(0, 0)] * image.ndim
        padding[axis] = (radius, radius)
        padded = jnp.pad(image, padding, mode="edge")
        taps = [jnp.take(padded, jnp.arange(k, k + size), axis=axis) * w for k, w in enumerate(weights)]
        image = sum(taps) / sum(weights)  # type: ignore[assignment]
    return image


@registered
def warp(*, blur: float = 0.0) -> Method:
    """Plain bilinear backward warp of the last rendered LR frame to the sample positions of the current one.

    Not demodulated, jitter difference included, border repeated, one resampling however many frames are
    extrapolated in a row: motion is composed along the path back to the rendered frame. A rendered frame is stored
    and returned as it is. All of it is linear, so the exposure is of no account.

    Args:
      blur: standard deviation in pixels of a Gaussian on the frame before the warp. It removes noise, and nothing
        else: a method must beat this row before its gain over ``warp`` is called guidance. Named ``warp-blur`` if > 0.

    Raises:
      ValueError: ``blur`` is negative.
    """
    if blur < 0:
        raise ValueError(f"blur: expected a standard deviation >= 0 in pixels, got {blur}.")

    def start(example: Frame) -> PyTree:
        return {
            "color": jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32),
            "color_jitter": jnp.zeros_like(example.jitter),
            "motion": jnp.zeros_like(example.motion),  # from the last frame, at its pixels, to the rendered one
            "motion_jitter": jnp.zeros_like(example.jitter),
        }

    def render_step(variables, history, frame, *, train=False):
        color = rendered_color(frame, "warp")
        history = {
            "color": gaussian_blur(color, blur),
            "color_jitter": frame.jitter,
            "motion": jnp.zeros_like(frame.motion),
            "motion_jitter": frame.jitter,
        }
        return history, Prediction(image=color)

    def extrapolate_step(variables, history, frame, *, train=False):
        motion, valid = compose_motion(
            frame.motion, history["motion"], jitter=frame.jitter, jitter_previous=history["motion_jitter"]
        )
        image = backward_warp(history["color"], jittered_motion(motion, frame.jitter, history["color_jitter"]))
        history = {**history, "motion": motion, "motion_jitter": frame.jitter}
        return history, Prediction(image=image, aux={"valid": valid})

    info = MethodInfo(name="warp-blur" if blur else "warp", scale=1, predicts=frozenset({"ess"}))
    return within_shots(Method(no_variables, start, render_step, extrapolate_step, info))
