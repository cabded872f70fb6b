"""Classifier-guided temporal supersampling (Guo et al. 2022, supplementary): ``classifier``, every frame rendered.

A network says per output pixel whether history may be used (visibility ghosting, shading ghosting, none) and how many
samples the pixel needs (geometry aliasing, texture aliasing, none). History is rectified accordingly, and a second
network says how much of the current sample is blended in. Classes act through their probabilities, so that both
networks see a gradient; all colour is x / (1 + x).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.color import reinhard, reinhard_inverse, rgb_to_ycocg, ycocg_to_rgb
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, depth_scale, frame_size, rendered_color
from essjax.interfaces import Method, MethodInfo, expand_flag, refuse_extrapolation, reset_at_cut
from essjax.methods.registry import registered
from essjax.methods.shots import upsampled_reactive
from essjax.networks import classifier_network, composition_network
from essjax.sizes import Scale, Size, output_size
from essjax.typing import Array, Callable, Color, Flag, Image, Mask, Motion, Plane, pytree
from essjax.warp import (
    Resampled,
    backward_warp,
    dilate_motion,
    gaussian_resample,
    inside_mask,
    jitter_aligned_upsample,
    upsample_motion,
)

PRIOR = (-2.0, -1.0, 1.0, -0.5, 0.0, 0.5)
"""Logits before training, about as often as the classes are: most pixels keep their history."""
RANGE_RATE = 0.1
"""How fast the colour range of the history shrinks towards the current colour, per frame."""


@pytree
class History:
    """The recurrent state, at the output's resolution ``[..., sH, sW, C]``.

    Attributes:
      image: last output, linear; the steps see it as x / (1 + x), like ``low`` and ``high``.
      counter: valid frames accumulated so far, ``[..., 1]``; 0 after visibility ghosting.
      low: lower end of the colours that were accumulated, linear.
      high: upper end.
      closeness: reversed depth of the last frame, see ``closeness``.
      logits: of the last classification, ``[..., 6]``.
      depth_scale: unit of depth ``[...]``.
      empty: bool ``[...]``: no output yet since the cut.
    """

    image: Color
    counter: Plane
    low: Color
    high: Color
    closeness: Plane
    logits: Image
    depth_scale: Array
    empty: Flag


def map_colors(function: Callable[[Array], Array], history: History) -> History:
    """Apply ``function`` to the three colours of a history."""
    colors = {name: function(getattr(history, name)) for name in ("image", "low", "high")}
    return dataclasses.replace(history, **colors)


class Current(NamedTuple):
    """The rendered frame, seen from the output grid.

    Attributes:
      color: un-jittered and bicubically enlarged, x / (1 + x).
      samples: the nearest samples: their weight and their box in YCoCg.
      closeness: of the nearest sample.
      motion: of the nearest sample's 3 x 3 neighbourhood's closest surface, output pixels.
      trust: 1 - reactive of the nearest sample, ``[..., sH, sW, 1]``; 1 without a mask.
    """

    color: Color
    samples: Resampled
    closeness: Plane
    motion: Motion
    trust: Array | float


class Warped(NamedTuple):
    """The history at the current frame's pixels.

    Attributes:
      image: read bicubically.
      counter: read nearest, like the next three.
      low: of the range; the current colour where there is no history.
      high: the same.
      closeness: of the previous frame.
      logits: read bilinearly; 0 where there is no history.
      known: ``[..., sH, sW, 1]``: 1 where there is history (not off screen, not cut, not reactive).
    """

    image: Color
    counter: Plane
    low: Color
    high: Color
    closeness: Plane
    logits: Image
    known: Mask


def closeness(frame: Frame, scale: Array) -> Plane:
    """Reversed depth ``scale / depth``, 0 on the background: the paper's D, larger = closer."""
    depth = frame.gbuffers.depth
    return jnp.where(jnp.isfinite(depth), expand_flag(scale, depth.ndim) / depth, 0.0)


def look(frame: Frame, unit: Array, size: Size, sigma: float) -> Current:
    """Bring the frame's buffers to the output's resolution (section 3)."""
    color = reinhard(rendered_color(frame, "classifier"))
    samples = gaussian_resample(color, rgb_to_ycocg(color), frame.jitter, jnp.float32(sigma), size)
    motion = upsample_motion(
        dilate_motion(frame.motion, frame.gbuffers.depth), size, jitter=frame.jitter, mode="nearest"
    )
    reactive = upsampled_reactive(frame, size)
    return Current(
        color=jnp.clip(jitter_aligned_upsample(color, size, frame.jitter, mode="bicubic"), 0.0, 1.0),
        samples=samples,
        closeness=jitter_aligned_upsample(closeness(frame, unit), size, frame.jitter, mode="nearest"),
        motion=jax.lax.stop_gradient(motion),
        trust=1.0 if reactive is None else 1.0 - reactive,
    )


def warp_history(history: History, current: Current) -> Warped:
    """Counter, range and depth are read nearest, logits bilinearly (section 3), the image bicubically."""
    known = inside_mask(current.motion) * ~expand_flag(history.empty, current.motion.ndim) * current.trust
    exact = jnp.concatenate([history.counter, history.low, history.high, history.closeness], axis=-1)
    exact = backward_warp(exact, current.motion, mode="nearest")
    there = known > 0
    return Warped(
        image=jnp.clip(backward_warp(history.image, current.motion, mode="bicubic"), 0.0, 1.0),
        counter=exact[..., :1] * known,
        low=jnp.where(there, exact[..., 1:4], current.color),
        high=jnp.where(there, exact[..., 4:7], current.color),
        closeness=exact[..., 7:],
        logits=backward_warp(history.logits, current.motion) * known,
        known=known,
    )


def depth_difference(reprojected: Plane, current: Plane) -> Plane:
    """Eq 10: (D_rp - D_cur) / max(D_rp, D_cur) of reversed depths, in [-1, 1]; 0 where both are background."""
    largest = jnp.maximum(reprojected, current)
    return jnp.where(largest > 0, (reprojected - current) / jnp.where(largest > 0, largest, 1.0), 0.0)


def classifier_inputs(current: Current, warped: Warped) -> Image:
    """Make the classifier's 20 channels (section 3), at the output's resolution, each about in [-1, 1]."""
    motion = current.motion
    return jnp.concatenate(
        [
            current.color,
            current.closeness / (1.0 + current.closeness),
            jnp.sign(motion) * jnp.log1p(jnp.abs(motion)),
            1.0 / (1.0 + warped.counter),
            warped.low,
            warped.high,
            depth_difference(warped.closeness, current.closeness) * warped.known,
            warped.logits,
        ],
        axis=-1,
    )


def probabilities(logits: Image, distrust: Mask) -> tuple[Image, Image]:
    """Ghosting and aliasing probabilities ``[..., 3]``; where ``distrust`` is 1 it is visibility ghosting for sure."""
    ghosting, aliasing = jax.nn.softmax(logits[..., :3]), jax.nn.softmax(logits[..., 3:])
    certain = jnp.array([1.0, 0.0, 0.0], ghosting.dtype)
    return (1.0 - distrust) * ghosting + distrust * certain, aliasing


def rectify(image: Color, current: Current, ghosting: Image) -> Color:
    """History by class: rejected at visibility ghosting, clamped to the current samples at shading ghosting, else kept.

    Each class has the share of its probability.
    """
    clamped = ycocg_to_rgb(jnp.clip(rgb_to_ycocg(image), current.samples.low, current.samples.high))
    return ghosting[..., :1] * current.color + ghosting[..., 1:2] * clamped + ghosting[..., 2:] * image


def blending_prior(counter: Plane, weight: Mask, alpha: float) -> Plane:
    """Return the current sample's share before training: an average so far, at least ``alpha * weight``."""
    return jnp.clip(jnp.maximum(alpha * weight, 1.0 / (1.0 + counter)), 0.02, 0.98)


def _inverse_sigmoid(share: Array) -> Array:
    return jnp.log(share) - jnp.log1p(-share)


@registered
def classifier(
    *, scale: Scale = 2, width: int = 32, composition_width: int = 64, alpha: float = 0.5, sigma: float = 0.8
) -> Method:
    """Classifier-guided supersampling of a sequence whose frames are all rendered.

    ``variables = {"classifier": ..., "composition": ...}``; without the second the weight is its prior. ``aux``: the
    classifier's ``inputs`` and ``logits`` ``[..., sH, sW, 6]``, ``ghosting`` and ``aliasing`` probabilities (3 each)
    in the order of ``labels.GHOSTING`` and ``labels.ALIASING``, ``weight``, x / (1 + x) of the output (``encoded``) and
    of the warped history (``warped``), and ``known``: where there is any. Before training it is close to ``taau``.

    Args:
      scale: see ``sizes.check_scale``.
      width: channels of the classifier's finest scale, a multiple of 8.
      composition_width: of the composition network's hidden layer.
      alpha: smallest share of a sample on its own output pixel, before training.
      sigma: of the Gaussian that says how near a sample is, output pixels.
    """
    network, composition = classifier_network(width=width, prior=PRIOR), composition_network(width=composition_width)

    def start(example: Frame) -> History:
        shape = (*example.motion.shape[:-3], *output_size(scale, frame_size(example)))

        def zeros(channels: int) -> Array:  # new each time: a streaming step donates every array of the history
            return jnp.zeros((*shape, channels), jnp.float32)

        return History(
            image=zeros(3),
            counter=zeros(1),
            low=zeros(3),
            high=zeros(3),
            closeness=zeros(1),
            logits=zeros(6),
            depth_scale=depth_scale(example.gbuffers),
            empty=jnp.ones(example.cut.shape, bool),
        )

    def composition_inputs(current: Current, rectified: Color, classes: Image, counter: Plane) -> Image:
        difference = jnp.abs(current.color - rectified)
        parts = [current.color, rectified, difference, classes, 1.0 / (1.0 + counter), current.samples.weight]
        return jnp.concatenate(parts, axis=-1)

    def init(key, example: Frame):
        key_classifier, key_composition = jax.random.split(key)
        shape = (*example.motion.shape[:-3], *output_size(scale, frame_size(example)))
        channels = {"classifier": 20, "composition": 17}
        inputs = {name: jax.ShapeDtypeStruct((*shape, count), jnp.float32) for name, count in channels.items()}
        return {
            "classifier": network.init(key_classifier, inputs["classifier"]),
            "composition": composition.init(key_composition, inputs["composition"]),
        }

    def render_step(variables, history: History, frame: Frame, *, train=False):
        history = map_colors(reinhard, reset_at_cut(frame.cut, start(frame), history))
        current = look(frame, history.depth_scale, output_size(scale, frame_size(frame)), sigma)
        warped = warp_history(history, current)
        inputs = classifier_inputs(current, warped)
        logits, state = network.apply(variables["classifier"], inputs, train=train)
        ghosting, aliasing = probabilities(logits, 1.0 - warped.known)
        rejected = ghosting[..., :1]
        counter = (1.0 - rejected) * (warped.counter + 1.0)
        rectified = rectify(warped.image, current, ghosting)
        prior = blending_prior(counter, current.samples.weight, alpha)
        classes = jnp.concatenate([ghosting, aliasing], axis=-1)
        logit = _inverse_sigmoid(prior)
        if "composition" in variables:  # not yet where the classifier is trained
            seen = composition_inputs(current, rectified, classes, counter)
            logit = logit + composition.apply(variables["composition"], seen)[0]
        weight = jax.nn.sigmoid(logit)
        image = rectified + weight * (current.color - rectified)
        low = jnp.minimum(current.color, warped.low + RANGE_RATE * (current.color - warped.low))
        high = jnp.maximum(current.color, warped.high + RANGE_RATE * (current.color - warped.high))
        new = dataclasses.replace(
            history,
            image=image,
            counter=counter,
            low=low + rejected * (current.color - low),
            high=high + rejected * (current.color - high),
            closeness=current.closeness,
            logits=logits,
            empty=jnp.zeros_like(history.empty),
        )
        aux = {
            "inputs": inputs, "logits": logits, "ghosting": ghosting, "aliasing": aliasing, "weight": weight,
            "encoded": image, "warped": warped.image, "known": warped.known,
        }  # fmt: skip
        states = {"classifier": state} if state else {}
        new = map_colors(reinhard_inverse, new)
        return new, Prediction(image=new.image, aux=aux, state=states)

    info = MethodInfo("classifier", scale=scale, predicts=frozenset({"ss"}), renders_all=True)
    networks = (("classifier", network),)
    method = Method(init, start, render_step, refuse_extrapolation("classifier"), info, networks=networks)
    return exposed(method, map_colors)
