"""ExtraSS (Wu et al. 2023): ``extrass`` supersamples both kinds of frames, by any ratio.

Pipeline: extrapolation at low resolution (``extrass_low``, sections 4.2 and 4.3), ExtraSSNet (4.4).
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p, log1p_of_reinhard, reinhard, rgb_to_ycocg, ycocg_to_rgb
from essjax.exposure import exposed_parts
from essjax.frames import (
    Frame,
    GBuffers,
    Prediction,
    depth_scale,
    frame_size,
    network_depth,
    without_color,
)
from essjax.interfaces import Method, MethodInfo, Network, Parted, Parts, from_parts, reset_at_cut
from essjax.methods.extrass_low import Extrapolated, extrapolate, frnet_inputs
from essjax.methods.registry import registered
from essjax.methods.rendered import (
    Memory,
    Rendered,
    advance,
    hole_buffers,
    map_shading,
    push_pair,
    reset_pair,
    start_pair,
)
from essjax.methods.shots import fade, upsampled_reactive, within_shots
from essjax.networks import extrassnet, frnet
from essjax.networks.blocks import crop, nearest_upsample, pad_to_multiple
from essjax.sizes import Scale, Size, check_scale, output_size, ratios
from essjax.typing import Array, Callable, Color, Flag, Image, Jitter, Key, Mask, Motion, PyTree, pytree
from essjax.warp import (
    Resampled,
    backward_warp,
    depth_to_space,
    dilate_motion,
    gaussian_resample,
    half_grid_offset,
    hole_mask,
    inside_mask,
    space_to_depth,
    to_half_grid,
    upsample_motion,
)
from essjax.warp.gbuffer_guided import SIGMA_DISTANCE, SIGMA_GUIDE


@pytree
class Past:
    """The memory of earlier frames, whatever was shown of them.

    Attributes:
      rendered: the two latest rendered LR frames.
      gbuffers: of the last frame, rendered or not: those that marking holes needs.
      jitter: of the last frame.
      depth_scale: unit of depth, ``[...]``.
    """

    rendered: Memory
    gbuffers: GBuffers
    jitter: Jitter
    depth_scale: Array


@pytree
class Notes:
    """The part of the memory that concerns the current frame.

    Attributes:
      rendered: the two latest rendered frames with their paths from the current one, newest first; None if that is
        rendered itself.
      count: how many there are, ``[...]``.
      gbuffers: of the frame before, see ``Past``.
      jitter: of the frame before.
      depth_scale: unit of depth, ``[...]``.
    """

    rendered: tuple[Rendered, Rendered] | None
    count: Array
    gbuffers: GBuffers
    jitter: Jitter
    depth_scale: Array


@pytree
class Seen:
    """All that a frame brings, before what was shown is looked at.

    Attributes:
      cut: whether it begins a shot, ``[...]``.
      reactive: its mask at the output's pixels, or None.
      motion: to the last output, ``[..., sH, sW, 2]`` HR pixels.
      valid: see ``Warped``.
      valid_low: see ``Warped``.
      low: inputs of E0 or E1 that are LR, on the half grid (``warp.half_grid``), ``[..., h, w, C]``.
      current: the LR colour (log1p) resampled to the HR grid.
      prior: logit of its share before training, ``[..., sH, sW, 1]``.
      conditions: see ``conditions_of``.
      extrapolated: where that colour comes from if the frame is not rendered.
    """

    cut: Flag
    reactive: Mask | None
    motion: Motion
    valid: Mask
    valid_low: Mask
    low: Image
    current: Resampled
    prior: Array
    conditions: Array
    extrapolated: Extrapolated | None


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


def history_motion(frame: Frame, size: Size) -> Motion:
    """Where each HR pixel was in the last output, ``[..., *size, 2]`` HR pixels."""
    # Dilated, so that the history of a silhouette moves with the surface in front.
    return upsample_motion(dilate_motion(frame.motion, frame.gbuffers.depth), size, jitter=frame.jitter)


def trusted(frame: Frame, gbuffers: GBuffers, jitter: Jitter) -> Mask:
    """Where history may be trusted, ``[..., H, W, 1]`` in [0, 1]; ``gbuffers`` and ``jitter`` of the frame before."""
    valid = hole_mask(frame.gbuffers, gbuffers, frame.motion, jitter=frame.jitter, jitter_previous=jitter)
    valid = _mean_of_nine(valid)  # softly: at silhouettes a mask is half wrong
    valid = jnp.where(frame.cut[..., None, None, None], 0.0, valid)
    return valid if frame.reactive is None else valid * (1.0 - frame.reactive)


def warp_shown(image: Color, motion: Motion) -> Color:
    """Warp the last output, linear, along ``motion``; return log1p."""
    # Bicubic: bilinear would blur the history a little more with every frame. Of x / (1 + x): bright pixels would ring.
    return log1p_of_reinhard(backward_warp(reinhard(image), motion, mode="bicubic"))


def conditions_of(frame: Frame, age: Array | None, size: Size) -> Array:
    """Say how a frame differs from the paper's setting, ``[..., CONDITIONS]``; 0 where it does not.

    No base colour, no normals, how many frames more than one the last rendered one is away (over 2), the logarithm of
    output size over twice the input size (the mean of both sides' ones).

    Args:
      frame: its buffers.
      age: of the last rendered frame, ``[...]``; None for a rendered frame.
      size: (height, width) of the output.
    """
    like = jnp.zeros(frame.cut.shape, jnp.float32)
    absent = [like + float(image is None) for image in (frame.gbuffers.base_color, frame.gbuffers.normal)]
    farther = like if age is None else (jnp.clip(age, 1.0, 8.0) - 1.0) / 2.0
    larger = 0.5 * math.log2(math.prod(ratios(frame_size(frame), size))) - 1.0
    return jnp.stack([*absent, farther, like + larger], axis=-1)


def _mean_of_nine(mask: Mask) -> Mask:
    """Average each pixel and its eight neighbours, borders repeated."""
    for axis in (mask.ndim - 3, mask.ndim - 2):
        padded = jnp.pad(mask, [(int(k == axis),) * 2 for k in range(mask.ndim)], mode="edge")
        mask = sum(jax.lax.slice_in_dim(padded, k, k + mask.shape[axis], axis=axis) for k in range(3)) / 3.0
    return mask


def _prior(valid: Mask, weight: Array | float) -> Array:
    """Return the logit of the sample's share before training: ``weight`` on trusted history, most of it elsewhere."""
    share = valid * weight + (1.0 - valid) * jnp.maximum(weight, HOLE_SHARE)
    return jnp.log(share) - jnp.log(1.0 - share)  # never near 1: log1p would cost more and gain nothing


SAMPLE_SIGMA = 0.325
"""Standard deviation of the Gaussian that brings LR samples to the HR grid, LR pixels.

This and the next four make the best untrained network on validation frames (experiments/LOG.md)."""
SAMPLE_SHARE = 0.65
"""Share of a sample on its own HR pixel, where history is trusted, before training."""
EXTRAPOLATED_SHARE = 0.25
"""Share of the LR extrapolation on ESS frames, where history is trusted, before training."""
HOLE_SHARE = 0.85
"""Share of either where it is not: most holes are narrow, and what is beside them is a fair guess."""
CLAMP_LOGIT = 0.5
"""Logit of how far history is moved into the box of the current samples, before training."""
CLAMP_LOGIT_BARE = -1.5
"""Added to it without base colour, where extrapolated samples lack the texture that history has."""


def _compose(head: Array, warped: Color, seen: Seen) -> Image:
    """Blend warped history and the current colour (both log1p, HR) by the corrected prior and add the residual.

    TAA clamps history to the YCoCg box of the current samples: ghosts go, and so does detail finer than the samples.
    How far to go there is the network's choice.
    """
    current = seen.current
    output = crop(depth_to_space(head, 2), *current.color.shape[-3:-1])
    share = jax.nn.sigmoid(seen.prior + output[..., :1])
    bare = seen.conditions[..., None, None, :1]
    clamping = jax.nn.sigmoid(CLAMP_LOGIT + CLAMP_LOGIT_BARE * bare + output[..., 1:2])
    # One channel each: fused with the blend they would be computed for each of its three.
    share, clamping = jax.lax.optimization_barrier((share, clamping))
    clamped = ycocg_to_rgb(jnp.clip(rgb_to_ycocg(warped), current.low, current.high))
    history = warped + clamping * (clamped - warped)
    return history + share * (current.color - history) + output[..., 2:]


class Settings(NamedTuple):
    """All that the steps of ``extrass`` are made of.

    Attributes:
      flow_network: FRNet.
      network: ExtraSSNet.
      scale: see ``extrass``.
      sigmas: of the guided warp, keyword arguments of ``guided_extrapolation``.
    """

    flow_network: Network
    network: Network
    scale: Scale
    sigmas: dict[str, Any]


def _start(settings: Settings, example: Frame) -> Parted:
    past = Past(
        rendered=start_pair(example),
        gbuffers=jax.tree.map(jnp.copy, hole_buffers(example.gbuffers)),  # a streaming step donates its history
        jitter=jnp.copy(example.jitter),
        depth_scale=depth_scale(example.gbuffers),
    )
    size = output_size(settings.scale, frame_size(example))
    return Parted(memory=past, shown=jnp.zeros((*example.motion.shape[:-3], *size, 3), jnp.float32))


def _init(settings: Settings, key: Key, example: Frame) -> PyTree:
    key_flow, key_net = jax.random.split(key)
    flow = settings.flow_network.init(key_flow, *frnet_inputs(example))

    def inputs(flow, frame):
        history = _start(settings, frame)
        seen = _observe(settings, {"frnet": flow}, _remember(history.memory, frame)[1], frame)
        return _inputs(seen, history.shown), seen.conditions

    rendered = dataclasses.replace(example, color=jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32))
    kinds = [jax.eval_shape(inputs, flow, frame) for frame in (rendered, without_color(example))]
    (ss, conditions), (ess, _) = kinds
    return {"frnet": flow, "extrassnet": settings.network.init(key_net, ss, ess, conditions)}  # only shapes matter


def _remember(past: Past, frame: Frame) -> tuple[Past, Notes]:
    pair = advance(reset_pair(frame, past.rendered), frame)
    unit = reset_at_cut(frame.cut, depth_scale(frame.gbuffers), past.depth_scale)
    newest, older = (jax.tree.map(lambda leaf, k=k: leaf[k], pair.frames) for k in (0, 1))
    notes = Notes(
        rendered=(newest, older) if frame.color is None else None,
        count=pair.count,
        gbuffers=past.gbuffers,
        jitter=past.jitter,
        depth_scale=unit,
    )
    past = Past(
        rendered=pair if frame.color is None else push_pair(pair, frame),
        gbuffers=hole_buffers(frame.gbuffers),
        jitter=frame.jitter,
        depth_scale=unit,
    )
    return past, notes


def _observe(settings: Settings, variables: PyTree, notes: Notes, frame: Frame) -> Seen:
    color, extrapolated, extra = frame.color, None, []
    size = output_size(settings.scale, frame_size(frame))
    if notes.rendered is not None:
        flow = settings.flow_network, variables["frnet"]
        pair = jax.tree.map(lambda *frames: jnp.stack(frames), *notes.rendered)
        extrapolated = extrapolate(*flow, pair, notes.count, frame, settings.sigmas)
        base = frame.gbuffers.base_color
        color = extrapolated.image
        extra = [log1p(extrapolated.warp), jnp.zeros_like(color) if base is None else base]
    assert color is not None
    encoded = log1p(color)
    sigma = jnp.float32(SAMPLE_SIGMA * math.sqrt(math.prod(ratios(frame_size(frame), size))))
    current = gaussian_resample(encoded, rgb_to_ycocg(encoded), frame.jitter, sigma, size)
    motion, valid_low = history_motion(frame, size), trusted(frame, notes.gbuffers, notes.jitter)
    valid_low = jax.lax.stop_gradient(valid_low)
    low = [encoded, network_depth(frame.gbuffers, notes.depth_scale), valid_low, *extra]
    low = [to_half_grid(image, size, frame.jitter) for image in low]
    valid = crop(nearest_upsample(low[2]), *size) * inside_mask(motion)
    weight = jnp.clip(SAMPLE_SHARE * current.weight, 0.02, 0.98) if extrapolated is None else EXTRAPOLATED_SHARE
    low.insert(3, half_grid_offset(frame_size(frame), size, frame.jitter))
    return Seen(
        cut=frame.cut,
        reactive=upsampled_reactive(frame, size),
        motion=motion,
        valid=valid,
        valid_low=valid_low,
        low=jnp.concatenate(low, axis=-1),
        current=current,
        prior=_prior(valid, weight),
        conditions=conditions_of(frame, None if notes.rendered is None else notes.rendered[0].age, size),
        extrapolated=extrapolated,
    )


def _inputs(seen: Seen, warped: Color) -> Image:
    high = [space_to_depth(pad_to_multiple(image, 2), 2) for image in (seen.current.color, warped)]
    return jnp.concatenate([*high, seen.low], axis=-1)


def _show(settings: Settings, variables: PyTree, image: Color, seen: Seen, *, train: bool) -> tuple[Color, Prediction]:
    # Before the network sees it: what is reactive may not reach the output at all.
    log_warped = fade(warp_shown(image, seen.motion), seen.current.color, seen.reactive, seen.cut)
    encode = "render" if seen.extrapolated is None else "extrapolate"
    inputs = _inputs(seen, log_warped)
    given = inputs, seen.conditions
    (head, features), _ = settings.network.apply(variables["extrassnet"], *given, train=train, method=encode)
    log_image = _compose(head, log_warped, seen)
    warped = Warped(log_image=log_warped, valid=seen.valid, valid_low=seen.valid_low)
    aux = {"log_image": log_image, "warped": warped, "features": features}
    if seen.extrapolated is not None:
        aux["extrapolated"] = seen.extrapolated
    image = expm1(log_image)
    return image, Prediction(image=image, aux=aux)


def _map_memory(function: Callable[[Array], Array], past: Past) -> Past:
    return dataclasses.replace(past, rendered=map_shading(function, past.rendered))


@registered
def extrass(
    *,
    width: int = 24,
    frnet_width: int = 16,
    scale: Scale = 2,
    sigma_guide: float | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float = SIGMA_DISTANCE,
) -> Method:
    """ExtraSS: supersamples rendered frames (SS) and extrapolated ones (ESS).

    ``variables = {"frnet": ..., "extrassnet": ...}``. ``aux`` of both steps: ``log_image`` (output, log1p), ``warped``
    (a ``Warped``), ``features`` (4 levels); the ESS step adds ``extrapolated`` (an ``Extrapolated``).

    Args:
      width: of ExtraSSNet.
      frnet_width: of FRNet.
      scale: output size over input size, any number >= 1, or the output's (width, height); one set of variables serves
        all.
      sigma_guide: see ``extrass_w``.
      sigma_distance: see ``extrass_w``.
    """
    settings = Settings(
        flow_network=frnet(width=frnet_width),
        network=extrassnet(width=width),
        scale=check_scale(scale),
        sigmas={"sigma_guide": sigma_guide, "sigma_distance": sigma_distance},
    )
    parts = Parts(_remember, functools.partial(_observe, settings), functools.partial(_show, settings))
    start, init = (functools.partial(function, settings) for function in (_start, _init))
    method = from_parts(init, start, parts, MethodInfo("extrass", scale=settings.scale))
    return within_shots(exposed_parts(method, _map_memory, lambda function, image: function(image)))
