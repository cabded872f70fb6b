"""ExtraSS (Wu et al. 2023): ``extrass_w``, ``extrass_e`` (low resolution, extrapolation), ``extrass`` (both kinds, 2x).

Pipeline: G-buffer guided warp (section 4.2), FRNet on the downsampled warp (4.3), ExtraSSNet (4.4).
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p, rgb_to_ycocg, sum_channels, ycocg_to_rgb
from essjax.frames import (
    Frame,
    GBuffers,
    Prediction,
    depth_scale,
    network_depth,
    rendered_color,
    require,
    select_time,
    surface_guides,
)
from essjax.interfaces import Method, MethodInfo, Network, no_variables, reset_at_cut
from essjax.methods.rendered import (
    GUIDED,
    Memory,
    advance,
    guided_extrapolation,
    hole_buffers,
    push_pair,
    reset_pair,
    start_pair,
)
from essjax.networks import extrassnet, frnet
from essjax.networks.blocks import crop, mean_pool, nearest_upsample, pad_to_multiple
from essjax.typing import Array, Color, Image, Jitter, Mask, PyTree, pytree
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

RATIO_FLOOR = 0.02
"""Radiance added to both sides of FRNet's change of shading, so that black stays black."""
REFINE_DELTA = 0.1
"""delta_1 = delta_2 of eq 6."""


def extrass_w(
    *, sigma_guide: float | tuple[float, ...] = SIGMA_GUIDE, sigma_distance: float = SIGMA_DISTANCE
) -> Method:
    """G-buffer guided warping only ("Ours-W" in Table 2): extrapolates at low resolution, nothing to train.

    Args:
      sigma_guide: of the guides in eq 2, one number or one per channel (base colour, normal).
      sigma_distance: of the screen distance in eq 2, LR pixels.
    """

    def render_step(variables, history, frame, *, train=False):
        return _store(history, frame), Prediction(image=rendered_color(frame, info.name))

    def extrapolate_step(variables, history, frame, *, train=False):
        history = advance(reset_pair(frame, history), frame)
        newest, sigmas = select_time(history.frames, 0), {"sigma_guide": sigma_guide, "sigma_distance": sigma_distance}
        image = guided_extrapolation(newest, history.count, frame, **sigmas)
        return history, Prediction(image=image, aux={"warp": image})

    info = MethodInfo("extrass-w", scale=1, requires=GUIDED, predicts=frozenset({"ess"}))
    return Method(no_variables, start_pair, render_step, extrapolate_step, info)


def _store(history: Memory, frame: Frame) -> Memory:
    return push_pair(advance(reset_pair(frame, history), frame), frame)


def halve(image: Image) -> Image:
    """The downsampling ⁻ of section 4.3: 2x2 box; odd sizes repeat their last row or column."""
    return mean_pool(pad_to_multiple(image, 2))


def _enlarge(image: Image, like: Image) -> Image:
    return crop(nearest_upsample(image), *like.shape[-3:-1])


def refine(network: Network, variables: PyTree, warped: Color, gbuffers: GBuffers) -> dict:
    """Shading refinement (eq 4-6): returns ``image`` (the blend of eq 5), FRNet's half-size output and the mask.

    Args:
      network: FRNet.
      variables: its variables.
      warped: f_g(i_{t-1}) and f_g(i_{t-3}), linear, ``[2, ..., H, W, 3]``.
      gbuffers: the current ones; roughness counts as 1 where absent.
    """
    roughness = jnp.ones_like(gbuffers.depth) if gbuffers.roughness is None else gbuffers.roughness
    small = log1p(halve(warped))
    output, _ = network.apply(variables, small, halve(roughness))
    refined, warped = backward_warp(small[0], output["flow"]), warped[0]
    mask = jax.lax.stop_gradient(blend_mask(expm1(refined), warped, gbuffers))
    # Not the half-size colour itself but how FRNet changed it: the detail of the full-size warp stays.
    before, after = (_enlarge(expm1(half), warped) + RATIO_FLOOR for half in (small[0], refined))
    image = jnp.where(mask > 0, warped * jnp.clip(after / before, 0.25, 4.0), warped)
    return {"image": image, "half": refined, "flow": output["flow"], "features": output["features"], "mask": mask}


def _length(vectors: Array) -> Array:
    """``[..., 1]``; for comparisons only: at 0 it has no derivative."""
    return jnp.sqrt(sum_channels(vectors**2))


def blend_mask(refined: Color, warped: Color, gbuffers: GBuffers, *, delta: float = REFINE_DELTA) -> Mask:
    """m̂ of eq 6: 1 where FRNet's half-size ``refined`` replaces ``warped`` (both linear)."""
    base, normal = surface_guides(gbuffers)
    base_half, normal_half = _enlarge(halve(base), base), _enlarge(halve(normal), normal)
    distance = _length(base_half - base) / 3.0**0.5
    similar = (1.0 - distance) * sum_channels(normal_half * normal) > delta
    large = _enlarge(refined, warped)
    norm = jnp.maximum(_length(large), 1e-3)
    # FRNet may only act where it changed something: its input, downsampled and enlarged, is what it started from.
    before = _enlarge(halve(warped), warped)
    changed = _length(large - before) / norm > delta
    return (similar & changed).astype(warped.dtype)


@pytree
class Extrapolated:
    """What the low-resolution part of an ESS frame yields; all linear unless said otherwise.

    Attributes:
      warp: f_g(i_{t-1}), ``[..., H, W, 3]``.
      image: ī of eq 5, ``[..., H, W, 3]``.
      half: FRNet's output, log1p, ``[..., H/2, W/2, 3]``.
      flow: ``[..., H/2, W/2, 2]`` half-size pixels.
      features: three levels of FRNet's features of the predicted frame.
      mask: m̂, ``[..., H, W, 1]``.
    """

    warp: Color
    image: Color
    half: Color
    flow: Array
    features: list[Image]
    mask: Mask


def _extrapolate(network: Network, variables: PyTree, pair: Memory, frame: Frame, sigmas: dict) -> Extrapolated:
    # Rendered frames carry no parameters: without stop_gradient the warps' backward pass would be computed for nothing.
    warped = jax.lax.stop_gradient(guided_extrapolation(pair.frames, pair.count, frame, **sigmas))
    refined = refine(network, variables, warped, frame.gbuffers)
    return Extrapolated(warp=warped[0], **refined)


def _frnet_inputs(example: Frame) -> tuple[Image, Image]:
    half = halve(jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32))
    return jnp.stack([half, half]), half[..., :1]


def extrass_e(
    *,
    width: int = 16,
    sigma_guide: float | tuple[float, ...] = SIGMA_GUIDE,
    sigma_distance: float = SIGMA_DISTANCE,
) -> Method:
    """Guided warping and shading refinement ("Ours-E" in Table 2): extrapolates at low resolution.

    ``variables = {"frnet": ...}``. The extrapolated step's ``aux["extrapolated"]`` is an ``Extrapolated``.

    Args:
      width: of FRNet.
      sigma_guide: see ``extrass_w``.
      sigma_distance: see ``extrass_w``.
    """
    network = frnet(width)
    sigmas = {"sigma_guide": sigma_guide, "sigma_distance": sigma_distance}

    def init(key, example):
        require(example, sorted(GUIDED), info.name)
        return {"frnet": network.init(key, *_frnet_inputs(example))}

    def render_step(variables, history, frame, *, train=False):
        return _store(history, frame), Prediction(image=rendered_color(frame, info.name))

    def extrapolate_step(variables, history, frame, *, train=False):
        history = advance(reset_pair(frame, history), frame)
        result = _extrapolate(network, variables["frnet"], history, frame, sigmas)
        return history, Prediction(image=result.image, aux={"extrapolated": result})

    info = MethodInfo("extrass-e", scale=1, requires=GUIDED, predicts=frozenset({"ess"}))
    return Method(init, start_pair, render_step, extrapolate_step, info)


@pytree
class History:
    """The recurrent state of ``extrass``.

    Attributes:
      rendered: the two latest rendered LR frames.
      image: last HR output, linear, ``[..., sH, sW, 3]``.
      gbuffers: of the last frame, rendered or not: those that marking holes needs.
      jitter: of the last frame.
      depth_scale: unit of depth, ``[...]``.
      empty: bool ``[...]``: no output yet since the cut.
    """

    rendered: Memory
    image: Color
    gbuffers: GBuffers
    jitter: Jitter
    depth_scale: Array
    empty: Array


@pytree
class Warped:
    """f_r: the HR history warped to the current frame.

    Attributes:
      log_image: log1p, ``[..., sH, sW, 3]``.
      valid: ``[..., sH, sW, 1]``: 1 where the previous position is on screen and showed the same surface.
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
    valid_low = jnp.where(history.empty[..., None, None, None], 0.0, valid_low)
    if frame.reactive is not None:
        valid_low = valid_low * (1.0 - frame.reactive)
    valid = nearest_upsample(valid_low, scale) * inside_mask(motion)
    # Bicubic: bilinear would blur the history a little more with every frame. Its overshoot below 0 is cut by log1p.
    image = log1p(backward_warp(history.image, motion, mode="bicubic"))
    return Warped(log_image=image, valid=jax.lax.stop_gradient(valid), valid_low=jax.lax.stop_gradient(valid_low))


def _prior(valid: Mask, weight: Array | float) -> Array:
    """Logit of the current sample's share before training: ``weight`` on trusted history, nearly all elsewhere."""
    share = jnp.where(valid > 0, weight, jnp.float32(0.98))
    return jnp.log(share) - jnp.log(1.0 - share)  # never near 1: log1p would cost more and gain nothing


SAMPLE_SIGMA = 0.65
"""Standard deviation of the Gaussian that brings LR samples to the HR grid, HR pixels.

This and the next three make the best untrained network on validation frames (experiments/LOG.md)."""
SAMPLE_SHARE = 0.6
"""Share of a sample on its own HR pixel, where history is trusted, before training."""
EXTRAPOLATED_SHARE = 0.2
"""Share of the LR extrapolation on ESS frames, where history is trusted, before training."""


CLAMP_LOGIT = -1.0
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
            empty=jnp.ones(example.cut.shape, bool),
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
            "frnet": flow_network.init(key_flow, *_frnet_inputs(example)),
            "extrassnet": network.init(key_net, *inputs),
        }

    def _extras(frame: Frame, warp: Color) -> tuple[list[Image], list[Image]]:
        return [], [log1p(warp), surface_guides(frame.gbuffers)[0]]

    def _inputs(frame: Frame, history: History, warped: Warped, color: Color, extra: list[Image]):
        """Inputs of E0 or E1 at LR, and the LR colour (log1p) resampled to the HR grid."""
        encoded = log1p(color)
        current = gaussian_resample(encoded, rgb_to_ycocg(encoded), frame.jitter, jnp.float32(SAMPLE_SIGMA), scale)
        shape = frame.gbuffers.depth.shape[:-1]
        low = [
            encoded,
            network_depth(frame.gbuffers, history.depth_scale),
            warped.valid_low,
            jnp.broadcast_to(frame.jitter[..., None, None, :], (*shape, 2)),
            *extra,
        ]
        high = [space_to_depth(current.color, scale), space_to_depth(warped.log_image, scale)]
        return jnp.concatenate([*high, *low], axis=-1), current

    def _finish(history: History, frame: Frame, rendered: Memory, log_image: Image) -> tuple[History, Color]:
        image = expm1(log_image)
        history = dataclasses.replace(
            history,
            rendered=rendered,
            image=image,
            gbuffers=hole_buffers(frame.gbuffers),
            jitter=frame.jitter,
            empty=jnp.zeros_like(history.empty),
        )
        return history, image

    def render_step(variables, history, frame, *, train=False):
        history = reset(frame, history)
        warped = warp_history(history, frame, scale)
        color = rendered_color(frame, info.name)
        inputs, current = _inputs(frame, history, warped, color, _extras(frame, color)[0])
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
        low = _extrapolate(flow_network, variables["frnet"], rendered, frame, sigmas)
        inputs, current = _inputs(frame, history, warped, low.image, _extras(frame, low.warp)[1])
        (head, features), _ = network.apply(variables["extrassnet"], inputs, train=train, method="extrapolate")
        log_image = _compose(head, warped, current, EXTRAPOLATED_SHARE, scale)
        history, image = _finish(history, frame, rendered, log_image)
        aux = {"log_image": log_image, "warped": warped, "features": features, "extrapolated": low}
        return history, Prediction(image=image, aux=aux)

    info = MethodInfo("extrass", scale=scale, requires=GUIDED)
    return Method(init, start, render_step, extrapolate_step, info)
