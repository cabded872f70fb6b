"""ExtraSS (Wu et al. 2023): ``extrass`` supersamples both kinds of frames, 2x.

Pipeline: extrapolation at low resolution (``extrass_low``, sections 4.2 and 4.3), ExtraSSNet (4.4).
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p, log1p_of_reinhard, reinhard, rgb_to_ycocg, ycocg_to_rgb
from essjax.exposure import exposed
from essjax.frames import (
    Frame,
    GBuffers,
    Prediction,
    depth_scale,
    network_depth,
    rendered_color,
    require,
    surface_guides,
)
from essjax.interfaces import Method, MethodInfo, reset_at_cut
from essjax.methods.extrass_low import extrapolate, frnet_inputs
from essjax.methods.rendered import (
    GUIDED,
    Memory,
    advance,
    hole_buffers,
    map_shading,
    push_pair,
    reset_pair,
    start_pair,
)
from essjax.methods.shots import within_shots, without_history
from essjax.networks import extrassnet, frnet
from essjax.networks.blocks import nearest_upsample
from essjax.typing import Array, Color, Image, Jitter, Mask, pytree
from essjax.warp import (
    Resampled,
    backward_warp,
    depth_to_space,
    dilate_motion,
    gaussian_resample,
    hole_mask,
    inside_mask,
    space_to_depth,
    upsample_motion,
)
from essjax.warp.gbuffer_guided import SIGMA_DISTANCE, SIGMA_GUIDE


@pytree
class History:
    """The recurrent state of ``extrass``.

    Attributes:
      rendered: the two latest rendered LR frames.
      image: last HR output, linear, ``[..., sH, sW, 3]``.
      gbuffers: of the last frame, rendered or not: those that marking holes needs.
      jitter: of the last frame.
      depth_scale: unit of depth, ``[...]``.
    """

    rendered: Memory
    image: Color
    gbuffers: GBuffers
    jitter: Jitter
    depth_scale: Array


@pytree
class Warped:
    """f_r: the HR history warped to the current frame.

    Attributes:
      log_image: log1p, ``[..., sH, sW, 3]``.
      valid: ``[..., sH, sW, 1]`` in [0, 1]: the share of the 3 x 3 LR pixels around that are no holes; 0 off screen.
      valid_low: the same at LR.
    """

    log_image: Color
    valid: Mask
    valid_low: Mask


def warp_history(history: History, frame: Frame, scale: int) -> Warped:
    """Backward warp of the HR output and where it may be trusted (f_r of eq 10)."""
    # Dilated, so that the history of a silhouette moves with the surface in front.
    motion = upsample_motion(dilate_motion(frame.motion, frame.gbuffers.depth), scale, jitter=frame.jitter)
    valid_low = hole_mask(
        frame.gbuffers, history.gbuffers, frame.motion, jitter=frame.jitter, jitter_previous=history.jitter
    )
    valid_low = _mean_of_nine(valid_low)  # softly: at silhouettes a mask is half wrong
    valid_low = jnp.where(frame.cut[..., None, None, None], 0.0, valid_low)
    if frame.reactive is not None:
        valid_low = valid_low * (1.0 - frame.reactive)
    valid = nearest_upsample(valid_low, scale) * inside_mask(motion)
    # Bicubic: bilinear would blur the history a little more with every frame. Of x / (1 + x): bright pixels would ring.
    image = log1p_of_reinhard(backward_warp(reinhard(history.image), motion, mode="bicubic"))
    return Warped(log_image=image, valid=jax.lax.stop_gradient(valid), valid_low=jax.lax.stop_gradient(valid_low))


def _mean_of_nine(mask: Mask) -> Mask:
    """The mean over each pixel and its eight neighbours, borders repeated."""
    for axis in (mask.ndim - 3, mask.ndim - 2):
        padded = jnp.pad(mask, [(int(k == axis),) * 2 for k in range(mask.ndim)], mode="edge")
        mask = sum(jax.lax.slice_in_dim(padded, k, k + mask.shape[axis], axis=axis) for k in range(3)) / 3.0
    return mask


def _prior(valid: Mask, weight: Array | float) -> Array:
    """Logit of the current sample's share before training: ``weight`` on trusted history, most of it elsewhere."""
    share = valid * weight + (1.0 - valid) * jnp.maximum(weight, HOLE_SHARE)
    return jnp.log(share) - jnp.log(1.0 - share)  # never near 1: log1p would cost more and gain nothing


SAMPLE_SIGMA = 0.65
"""Standard deviation of the Gaussian that brings LR samples to the HR grid, HR pixels.

This and the next four make the best untrained network on validation frames (experiments/LOG.md)."""
SAMPLE_SHARE = 0.65
"""Share of a sample on its own HR pixel, where history is trusted, before training."""
EXTRAPOLATED_SHARE = 0.25
"""Share of the LR extrapolation on ESS frames, where history is trusted, before training."""
HOLE_SHARE = 0.85
"""Share of either where it is not: most holes are narrow, and what is beside them is a fair guess."""
CLAMP_LOGIT = 0.5
"""Logit of how far history is moved into the box of the current samples, before training."""


def _compose(head: Array, warped: Warped, current: Resampled, weight: Array | float, scale: int) -> Image:
    """Blend history and ``current`` (both log1p, HR) by the corrected prior and add the residual.

    TAA clamps history to the YCoCg box of the current samples: ghosts go, and so does detail finer than the samples.
    How far to go there is the network's choice.
    """
    output = depth_to_space(head, scale)
    share = jax.nn.sigmoid(_prior(warped.valid, weight) + output[..., :1])
    clamping = jax.nn.sigmoid(CLAMP_LOGIT + output[..., 1:2])
    # One channel each: fused with the blend they would be computed for each of its three.
    share, clamping = jax.lax.optimization_barrier((share, clamping))
    clamped = ycocg_to_rgb(jnp.clip(rgb_to_ycocg(warped.log_image), current.low, current.high))
    history = warped.log_image + clamping * (clamped - warped.log_image)
    return history + share * (current.color - history) + output[..., 2:]


def extrass(
    *,
    width: int = 24,
    frnet_width: int = 16,
    scale: int = 2,
    sigma_guide: float | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float = SIGMA_DISTANCE,
) -> Method:
    """ExtraSS: supersamples rendered frames (SS) and extrapolated ones (ESS).

    ``variables = {"frnet": ..., "extrassnet": ...}``. ``aux`` of both steps: ``log_image`` (output, log1p), ``warped``
    (a ``Warped``), ``features`` (4 levels); the ESS step adds ``extrapolated`` (an ``Extrapolated``).

    Args:
      width: of ExtraSSNet.
      frnet_width: of FRNet.
      scale: output size over input size.
      sigma_guide: see ``extrass_w``.
      sigma_distance: see ``extrass_w``.
    """
    flow_network, network = frnet(frnet_width), extrassnet(width, scale)
    sigmas = {"sigma_guide": sigma_guide, "sigma_distance": sigma_distance}

    def start(example: Frame) -> History:
        image = nearest_upsample(jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32), scale)
        return History(
            rendered=start_pair(example),
            image=image,
            gbuffers=jax.tree.map(jnp.copy, hole_buffers(example.gbuffers)),  # a streaming step donates its history
            jitter=jnp.copy(example.jitter),
            depth_scale=depth_scale(example.gbuffers),
        )

    def reset(frame: Frame, history: History) -> History:
        fresh = start(frame)
        rendered = reset_pair(frame, history.rendered)
        rest = reset_at_cut(
            frame.cut, dataclasses.replace(fresh, rendered=None), dataclasses.replace(history, rendered=None)
        )
        return dataclasses.replace(rest, rendered=rendered)

    def init(key, example):
        require(example, sorted(GUIDED), info.name)
        key_flow, key_net = jax.random.split(key)

        def both_inputs(example):
            history, color = start(example), jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32)
            warped = warp_history(history, example, scale)
            return [_inputs(example, history, warped, color, extra)[0] for extra in _extras(example, color)]

        inputs = jax.eval_shape(both_inputs, example)  # only shapes matter
        return {
            "frnet": flow_network.init(key_flow, *frnet_inputs(example)),
            "extrassnet": network.init(key_net, *inputs),
        }

    def _extras(frame: Frame, warp: Color) -> tuple[list[Image], list[Image]]:
        return [], [log1p(warp), surface_guides(frame.gbuffers)[0]]

    def _inputs(frame: Frame, history: History, warped: Warped, color: Color, extra: list[Image]):
        """Inputs of E0 or E1 at LR, the LR colour (log1p) resampled to the HR grid, and the usable history."""
        encoded = log1p(color)
        current = gaussian_resample(encoded, rgb_to_ycocg(encoded), frame.jitter, jnp.float32(SAMPLE_SIGMA), scale)
        # Before the network sees it: what is reactive may not reach the output at all.
        kept = without_history(warped.log_image, current.color, frame, scale)
        warped = dataclasses.replace(warped, log_image=kept)
        shape = frame.gbuffers.depth.shape[:-1]
        low = [
            encoded,
            network_depth(frame.gbuffers, history.depth_scale),
            warped.valid_low,
            jnp.broadcast_to(frame.jitter[..., None, None, :], (*shape, 2)),
            *extra,
        ]
        high = [space_to_depth(current.color, scale), space_to_depth(warped.log_image, scale)]
        return jnp.concatenate([*high, *low], axis=-1), current, warped

    def _finish(history: History, frame: Frame, rendered: Memory, log_image: Image) -> tuple[History, Color]:
        image = expm1(log_image)
        history = dataclasses.replace(
            history,
            rendered=rendered,
            image=image,
            gbuffers=hole_buffers(frame.gbuffers),
            jitter=frame.jitter,
        )
        return history, image

    def render_step(variables, history, frame, *, train=False):
        history = reset(frame, history)
        warped = warp_history(history, frame, scale)
        color = rendered_color(frame, info.name)
        inputs, current, warped = _inputs(frame, history, warped, color, _extras(frame, color)[0])
        (head, features), _ = network.apply(variables["extrassnet"], inputs, train=train, method="render")
        weight = jnp.clip(SAMPLE_SHARE * current.weight, 0.02, 0.98)
        log_image = _compose(head, warped, current, weight, scale)
        rendered = push_pair(advance(history.rendered, frame), frame)
        history, image = _finish(history, frame, rendered, log_image)
        aux = {"log_image": log_image, "warped": warped, "features": features}
        return history, Prediction(image=image, aux=aux)

    def extrapolate_step(variables, history, frame, *, train=False):
        history = reset(frame, history)
        warped = warp_history(history, frame, scale)
        rendered = advance(history.rendered, frame)
        low = extrapolate(flow_network, variables["frnet"], rendered, frame, sigmas)
        inputs, current, warped = _inputs(frame, history, warped, low.image, _extras(frame, low.warp)[1])
        (head, features), _ = network.apply(variables["extrassnet"], inputs, train=train, method="extrapolate")
        log_image = _compose(head, warped, current, EXTRAPOLATED_SHARE, scale)
        history, image = _finish(history, frame, rendered, log_image)
        aux = {"log_image": log_image, "warped": warped, "features": features, "extrapolated": low}
        return history, Prediction(image=image, aux=aux)

    def map_radiance(function, history):
        rendered = map_shading(function, history.rendered)
        return dataclasses.replace(history, image=function(history.image), rendered=rendered)

    info = MethodInfo("extrass", scale=scale, requires=GUIDED)
    return within_shots(exposed(Method(init, start, render_step, extrapolate_step, info), map_radiance))
