"""DLCTUS: a network says how much of the new sample each output pixel takes (thesis 002 section 4.1).

Reprojected history and the jitter-aligned upsampled (JAU) frame are blended by one number per pixel. A fourth channel
of the history, whose decay the network controls as well, can remember how good each pixel is: 1 where it is no more
than the JAU frame. It works on [0, 1]: colour goes through x / (1 + x) and back.
"""

import functools

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.color import reinhard, reinhard_inverse
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, frame_size, rendered_color
from essjax.interfaces import Method, MethodInfo, refuse_extrapolation
from essjax.methods.registry import registered
from essjax.methods.shots import continued, without_history
from essjax.networks import dlctus_network
from essjax.sizes import Size, output_size
from essjax.typing import Array, Callable, Image, Motion, Plane
from essjax.warp import (
    backward_warp,
    dilate_motion,
    inside_mask,
    jitter_aligned_upsample,
    sample_by_fetches,
    upsample_motion,
    zero_upsample,
)

SCALES = (2, 4)


def _by_fetches(image: Image, motion: Motion, fetches: int) -> Array:
    height, width = motion.shape[-3:-1]
    return sample_by_fetches(image, pixel_positions(height, width) + motion, fetches=fetches)


REPROJECTIONS: dict[str, Callable[[Image, Motion], Array]] = {
    "bicubic-0.75": functools.partial(backward_warp, mode="bicubic-0.75"),
    "bilinear": backward_warp,
    "5-tap": functools.partial(_by_fetches, fetches=5),
    "9-tap": functools.partial(_by_fetches, fetches=9),
}
"""How history is read (table 13): "9-tap" equals "bicubic-0.75" up to rounding, "5-tap" is Unreal Engine's shortcut."""


def linear_depth(depth: Plane, near: float, far: float) -> Plane:
    """View-space z from the near plane (0) to the far plane (1), the background included; appendix A.1."""
    return jnp.clip((depth - near) / (far - near), 0.0, 1.0)


@jax.custom_vjp
def returning_clip(x: Array) -> Array:
    """``clip(x, 0, 1)`` whose gradient outside [0, 1] is that of the identity where descent leads back inside.

    ``clip`` itself has no gradient there: when all outputs of the network have left the range, in one large step of the
    optimiser, training is over and the image is the JAU frame. What would lead farther away has none here either.
    """
    return jnp.clip(x, 0.0, 1.0)


def _returning_clip_forward(x: Array) -> tuple[Array, Array]:
    return returning_clip(x), x


def _returning_clip_backward(x: Array, gradient: Array) -> tuple[Array]:
    away = ((x < 0.0) & (gradient > 0.0)) | ((x > 1.0) & (gradient < 0.0))  # a step goes against the gradient
    return (jnp.where(away, 0.0, gradient),)


returning_clip.defvjp(_returning_clip_forward, _returning_clip_backward)


def map_color(function: Callable[[Array], Array], history: dict) -> dict:
    """Apply ``function`` to the colour of a history, which is linear; its fourth channel stays as it is."""
    image = history["image"]
    return {**history, "image": jnp.concatenate([function(image[..., :3]), image[..., 3:]], axis=-1)}


def _name(reprojection: str, dilate: bool, accumulation: bool) -> str:
    parts = ["" if accumulation else "no-accumulation", "dilated" if dilate else ""]
    parts += ["" if reprojection == "bicubic-0.75" else reprojection.replace("-", "")]
    return "-".join(["dlctus", *(part for part in parts if part)])


@registered
def dlctus(
    *,
    scale: int = 2,
    reprojection: str = "bicubic-0.75",
    dilate: bool = False,
    accumulation: bool = True,
    near: float = 0.1,
    far: float = 100.0,
) -> Method:
    """Deep Learning Controlled Temporal Upsampling: 78,112 parameters for both factors, every frame rendered.

    Each frame: history is reprojected with bilinearly upsampled motion; off screen, on the first frame, at a cut and as
    far as a frame is reactive it is the JAU frame, whose accumulation is 1. The network sees the zero-upsampled RGB-D
    and that history, and returns o1 and o2, clamped to [0, 1]: ``JAU o1 + history (1 - o1)`` on all four channels (eq
    44), then the accumulation times o2 (eq 45).

    Variables are ``{"dlctus": ...}``; reprojection and dilation may differ between training and test (tables 13, 14).
    ``aux`` has ``encoded``, the image in x / (1 + x), ``rate`` (o1) and ``accumulation`` (the fourth channel, or None).

    Args:
      scale: 2 or 4.
      reprojection: how history is read, one of ``REPROJECTIONS``.
      dilate: take motion from the nearest surface of the 3 x 3 input pixels.
      accumulation: false leaves out the history's fourth channel and o2 (table 16; our reading: 7 input channels, and
        nothing uses the second output).
      near: depth that the network sees as 0, metres.
      far: depth that it sees as 1, metres; farther is 1, and so is the background.

    Raises:
      ValueError: an unknown reprojection, another scale, or planes that are not 0 <= near < far.
    """
    if scale not in SCALES:
        raise ValueError(f"scale: expected 2 or 4, got {scale!r}.")
    if reprojection not in REPROJECTIONS:
        raise ValueError(f"reprojection: expected one of {', '.join(REPROJECTIONS)}, got {reprojection!r}.")
    if not 0 <= near < far:
        raise ValueError(f"expected 0 <= near < far, got near = {near} and far = {far}.")
    name = _name(reprojection, dilate, accumulation)
    network, channels = dlctus_network(), 4 if accumulation else 3

    def size_of(frame: Frame) -> Size:
        return output_size(scale, frame_size(frame))

    def init(key, example: Frame):
        shape = (*example.motion.shape[:-3], *size_of(example), 4 + channels)
        return {"dlctus": network.init(key, jax.ShapeDtypeStruct(shape, jnp.float32))}

    def start(example: Frame):
        image = jnp.zeros((*example.motion.shape[:-3], *size_of(example), channels), jnp.float32)
        return {"image": image, "empty": jnp.ones(example.cut.shape, bool)}

    def reproject(history, frame: Frame, fallback: Image) -> Array:
        motion = dilate_motion(frame.motion, frame.gbuffers.depth) if dilate else frame.motion
        motion = jax.lax.stop_gradient(upsample_motion(motion, size_of(frame), jitter=frame.jitter))
        image = map_color(reinhard, history)["image"]
        past = jnp.where(inside_mask(motion) > 0, REPROJECTIONS[reprojection](image, motion), fallback)
        return without_history(past, fallback, continued(frame, history["empty"]))

    def render_step(variables, history, frame: Frame, *, train: bool = False):
        color = reinhard(rendered_color(frame, name))
        depth = linear_depth(frame.gbuffers.depth, near, far)
        sampled = zero_upsample(jnp.concatenate([color, depth], axis=-1), size_of(frame), frame.jitter)
        aligned = jitter_aligned_upsample(color, size_of(frame), frame.jitter)
        if accumulation:
            aligned = jnp.concatenate([aligned, jnp.ones_like(aligned[..., :1])], axis=-1)
        past = reproject(history, frame, aligned)
        outputs, _ = network.apply(variables["dlctus"], jnp.concatenate([sampled, past], axis=-1), train=train)
        rate, decay = (returning_clip(outputs[..., k : k + 1]) for k in range(2))
        mixed = aligned * rate + past * (1.0 - rate)  # eq 44
        quality = mixed[..., 3:] * decay if accumulation else None  # eq 45
        encoded = jnp.clip(mixed[..., :3], 0.0, 1.0)
        kept = encoded if quality is None else jnp.concatenate([encoded, jnp.clip(quality, 0.0, 1.0)], axis=-1)
        history = map_color(reinhard_inverse, {"image": kept, "empty": jnp.zeros_like(history["empty"])})
        aux = {"encoded": encoded, "rate": rate, "accumulation": quality}
        return history, Prediction(image=history["image"][..., :3], aux=aux)

    info = MethodInfo(name=name, scale=scale, predicts=frozenset({"ss"}), renders_all=True)
    return exposed(Method(init, start, render_step, refuse_extrapolation(name), info), map_color)
