"""ExtraSS at low resolution (Wu et al. 2023): ``extrass_w``, ``extrass_e`` extrapolate frames, 1x.

Pipeline: G-buffer guided warp (section 4.2), FRNet on the downsampled warp (4.3).
"""

import jax
import jax.numpy as jnp

from essjax.color import expm1, log1p, sum_channels
from essjax.exposure import exposed
from essjax.frames import Frame, GBuffers, Prediction, rendered_color, select_time
from essjax.interfaces import Method, MethodInfo, Network, no_variables
from essjax.methods.registry import registered
from essjax.methods.rendered import (
    Memory,
    Rendered,
    advance,
    guided_extrapolation,
    map_shading,
    push_pair,
    reset_pair,
    start_pair,
)
from essjax.methods.shots import within_shots
from essjax.networks import frnet
from essjax.networks.blocks import crop, mean_pool, nearest_upsample, pad_to_multiple
from essjax.typing import Array, Color, Image, Mask, PyTree, Resized, pytree
from essjax.warp import backward_warp, normals_from_depth
from essjax.warp.gbuffer_guided import SIGMA_DISTANCE, SIGMA_GUIDE

RATIO_FLOOR = 0.02
"""Exposed radiance added to both sides of FRNet's change of shading, so that black stays black."""
REFINE_DELTA = 0.1
"""delta_1 = delta_2 of eq 6."""


@registered
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

    info = MethodInfo("extrass-w", scale=1, predicts=frozenset({"ess"}))
    return within_shots(exposed(Method(no_variables, start_pair, render_step, extrapolate_step, info), map_shading))


def _store(history: Memory, frame: Frame) -> Memory:
    return push_pair(advance(reset_pair(frame, history), frame), frame)


def halve(image: Image) -> Image:
    """Downsample as ⁻ of section 4.3 does: 2x2 box; odd sizes repeat their last row or column."""
    return mean_pool(pad_to_multiple(image, 2))


def _enlarge(image: Image, like: Image) -> Image:
    return crop(nearest_upsample(image), *like.shape[-3:-1])


def refine(network: Network, variables: PyTree, warped: Color, gbuffers: GBuffers, ages: Array) -> dict:
    """Shading refinement (eq 4-6): returns ``image`` (the blend of eq 5), FRNet's half-size output and the mask.

    Args:
      network: FRNet.
      variables: its variables.
      warped: the two latest rendered frames, warped by f_g, linear, ``[2, ..., H, W, 3]``.
      gbuffers: the current ones; roughness counts as 1 where absent.
      ages: how many frames ago the two were rendered, ``[2, ...]``.
    """
    roughness = jnp.ones_like(gbuffers.depth) if gbuffers.roughness is None else gbuffers.roughness
    small = log1p(halve(warped))
    output, _ = network.apply(variables, small, halve(roughness), ages)
    refined, warped = backward_warp(small[0], output["flow"]), warped[0]
    mask = jax.lax.stop_gradient(blend_mask(expm1(refined), warped, gbuffers))
    # Not the half-size colour itself but how FRNet changed it: the detail of the full-size warp stays.
    before, after = (_enlarge(expm1(half), warped) + RATIO_FLOOR for half in (small[0], refined))
    image = jnp.where(mask > 0, warped * jnp.clip(after / before, 0.25, 4.0), warped)
    return {"image": image, "half": refined, "flow": output["flow"], "features": output["features"], "mask": mask}


def _length(vectors: Array) -> Array:
    """``[..., 1]``; for comparisons only: at 0 it has no derivative."""
    return jnp.sqrt(sum_channels(vectors**2))


def blend_mask(refined: Resized, warped: Color, gbuffers: GBuffers, *, delta: float = REFINE_DELTA) -> Mask:
    """m̂ of eq 6: 1 where FRNet's half-size ``refined`` replaces ``warped`` (both linear); base colour may be absent."""
    normal = normals_from_depth(gbuffers.depth) if gbuffers.normal is None else gbuffers.normal
    base, distance = gbuffers.base_color, 0.0
    if base is not None:
        distance = _length(_enlarge(halve(base), base) - base) / 3.0**0.5
    normal_half = _enlarge(halve(normal), normal)
    similar = (1.0 - distance) * sum_channels(normal_half * normal) > delta
    large = _enlarge(refined, warped)
    norm = jnp.maximum(_length(large), 1e-3)
    # FRNet may only act where it changed something: its input, downsampled and enlarged, is what it started from.
    before = _enlarge(halve(warped), warped)
    changed = _length(large - before) / norm > delta
    return (similar & changed).astype(warped.dtype)


@pytree
class Extrapolated:
    """The results of an ESS frame's low-resolution part; all linear unless said otherwise.

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


def extrapolate(
    network: Network, variables: PyTree, pair: Rendered, count: Array, frame: Frame, sigmas: dict
) -> Extrapolated:
    """Warp the two latest rendered frames to ``frame`` and refine them (sections 4.2, 4.3).

    Args:
      network: FRNet.
      variables: its variables.
      pair: the rendered frames, their paths from ``frame``; the newest first, ``[2, ...]``.
      count: how many were rendered, ``[...]``.
      frame: the current one, its colour unread.
      sigmas: of the guided warp, keyword arguments of ``guided_extrapolation``.
    """
    # Rendered frames carry no parameters: without stop_gradient the warps' backward pass would be computed for nothing.
    warped = jax.lax.stop_gradient(guided_extrapolation(pair, count, frame, **sigmas))
    refined = refine(network, variables, warped, frame.gbuffers, pair.age)
    return Extrapolated(warp=warped[0], **refined)


def frnet_inputs(example: Frame) -> tuple[Image, Image, Array]:
    """Zeros of the shapes that FRNet is applied to, for its ``init``."""
    half = halve(jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32))
    return jnp.stack([half, half]), half[..., :1], jnp.zeros((2, *half.shape[:-3]))


@registered
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
    network = frnet(width=width)
    sigmas = {"sigma_guide": sigma_guide, "sigma_distance": sigma_distance}

    def init(key, example):
        return {"frnet": network.init(key, *frnet_inputs(example))}

    def render_step(variables, history, frame, *, train=False):
        return _store(history, frame), Prediction(image=rendered_color(frame, info.name))

    def extrapolate_step(variables, history, frame, *, train=False):
        history = advance(reset_pair(frame, history), frame)
        result = extrapolate(network, variables["frnet"], history.frames, history.count, frame, sigmas)
        return history, Prediction(image=result.image, aux={"extrapolated": result})

    info = MethodInfo("extrass-e", scale=1, predicts=frozenset({"ess"}))
    method = Method(init, start_pair, render_step, extrapolate_step, info, networks=(("frnet", network),))
    return within_shots(exposed(method, map_shading))
