"""ExtraNet (Guo et al. 2021): extrapolates at the input's resolution from the three latest rendered frames.

Pipeline (section 4.1): the rendered frames are demodulated and warped to the new frame, by plain and by occlusion
motion; disoccluded pixels are marked; the network repairs them and moves shadows and reflections; its output is
modulated with the new frame's base colour.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp

from essjax import networks
from essjax.color import demodulate, expm1, log1p, modulate
from essjax.exposure import exposed
from essjax.frames import Frame, GBuffers, Prediction, background, rendered_color, require, surface_guides
from essjax.interfaces import Method, MethodInfo, expand_flag
from essjax.methods.registry import registered
from essjax.methods.rendered import Memory, advance, albedo, hole_buffers, map_shading, push, reset_memory, start_memory
from essjax.methods.shots import within_shots
from essjax.networks._extranet import FRAMES, input_shapes
from essjax.networks._extranet import from_torch as network_from_torch
from essjax.tensors import read_tensors
from essjax.typing import Array, Color, Image, Mask, Motion, Plane, PyTree, pytree
from essjax.warp import backward_warp, hole_mask, jittered_motion, occlusion_motion

REQUIRES = frozenset({"base_color", "normal", "roughness", "metallic"})
WINDOW = 2 * FRAMES
"""Frames from the oldest one that a prediction looks back at to itself: t-5, t-3, t-1 are rendered."""

ENGINE = (1.0, -1.0, 1.0)
"""World axes of Unreal, which is left-handed, over ours: its import presets negate y."""


@pytree
class Kept:
    """All that is kept of a rendered frame.

    Attributes:
      shading: demodulated colour ``[..., H, W, 3]``.
      gbuffers: what marking holes needs.
    """

    shading: Color
    gbuffers: GBuffers


@pytree
class Inputs:
    """All that the network sees of an extrapolated frame; colours demodulated, log1p.

    Attributes:
      warped: newest rendered frame by plain motion, ``[..., H, W, 3]``, and by occlusion motion, 3 more.
      mask: 1 where the plain warp found the same surface, ``[..., H, W, 1]``.
      features: normal, depth, roughness, metallic, ``[..., H, W, 6]``.
      history: three rendered frames by plain motion and their masks, newest first, ``[3, ..., H, W, 4]``.
    """

    warped: Image
    mask: Mask
    features: Image
    history: Image


def _kept(color: Color, gbuffers: GBuffers) -> Kept:
    return Kept(shading=demodulate(color, albedo(gbuffers)), gbuffers=hole_buffers(gbuffers))


def _start(example: Frame) -> Memory:
    black = jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32)
    return start_memory(example, _kept(black, example.gbuffers), FRAMES)


def _advance(memory: Memory, frame: Frame) -> Memory:
    return advance(reset_memory(frame.cut, _start(frame), memory), frame)


def relative_depth(gbuffers: GBuffers) -> Plane:
    """Depth as the published weights know it: 0 on the background, then minimum to maximum of the image is [0, 1]."""
    depth = jnp.where(background(gbuffers), 0.0, gbuffers.depth)
    low, high = (f(depth, axis=(-3, -2), keepdims=True) for f in (jnp.min, jnp.max))
    return (depth - low) / (high - low + 1e-6)


def _around(memory: Memory, frame: Frame, valid: Mask) -> Motion:
    """Lookup in the newest rendered frame: by occlusion motion in holes, by plain motion elsewhere."""
    motion = jittered_motion(memory.frames.motion[0], frame.jitter, memory.frames.jitter[0])
    return occlusion_motion(motion, frame.gbuffers.depth, valid)


def network_inputs(
    memory: Memory, frame: Frame, *, occlusion: bool = True, published: bool = False, mode: str = "bilinear"
) -> Inputs:
    """Warps, masks and features for ``frame``, to which ``memory`` was advanced; no gradient.

    Every rendered frame is warped along its own composed path and has a hole mask of its own (section 4.4), 0 where
    the path leaves the screen, is reactive or nothing was rendered yet. Jitter differences are part of every warp.

    Args:
      memory: of rendered frames.
      frame: the new one.
      occlusion: also warp by occlusion motion vectors (section 4.2); False: Table 7's "w/o OMV".
      published: as published weights need it, see ``extranet``: a black sky, normals of a left-handed world.
      mode: how shading is read, see ``warp.sample``; it may have more than three channels.
    """
    frames, kept = memory.frames, memory.frames.content

    def share(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, (FRAMES, *leaf.shape))

    jitter = share(frame.jitter)
    motion = jittered_motion(frames.motion, jitter, frames.jitter)
    surfaces = jax.tree.map(share, frame.gbuffers)
    valid = hole_mask(surfaces, kept.gbuffers, frames.motion, jitter=jitter, jitter_previous=frames.jitter)
    valid = jnp.where(expand_flag(memory.count == 0, valid.ndim - 1), 0.0, valid * frames.valid)
    if frames.trust is not None:
        valid = valid * frames.trust
    shading = jnp.where(background(kept.gbuffers), 0.0, kept.shading) if published else kept.shading
    plain = log1p(backward_warp(shading, motion, mode=mode))
    warped = [plain[0]]
    if occlusion:
        warped.append(log1p(backward_warp(shading[0], _around(memory, frame, valid[0]), mode=mode)))
    normal = surface_guides(frame.gbuffers)[1]
    if published:
        normal = normal * jnp.asarray(ENGINE)
    # Nothing was hit: the published weights were trained with (-1, -1, -1) there.
    normal = jnp.where(background(frame.gbuffers), -1.0, normal)
    features = [normal, relative_depth(frame.gbuffers), frame.gbuffers.roughness, frame.gbuffers.metallic]
    inputs = Inputs(
        warped=jnp.concatenate(warped, axis=-1),
        mask=valid[0],
        features=jnp.concatenate(features, axis=-1),
        history=jnp.concatenate([plain, valid], axis=-1),
    )
    return jax.lax.stop_gradient(inputs)


@registered
def extranet(*, history: bool = True, occlusion: bool = True, published: bool = False) -> Method:
    """ExtraNet: extrapolates frames between rendered ones at low resolution; rendered ones are returned as they are.

    ``variables = {"extranet": {"params", "batch_stats"}}``, 262,141 parameters; ``from_torch`` reads published ones,
    for which ``published`` must be True. A fresh network returns the plain warp of the demodulated frame. ``aux`` of an
    extrapolated step: ``log_shading`` (the output, demodulated, log1p) and ``inputs`` (``Inputs``).

    Args:
      history: with the history encoder (Table 7, HE).
      occlusion: with a warp by occlusion motion vectors (Table 7, OMV).
      published: for published weights, which never saw a sky and were trained in Unreal's left-handed world (z up). The
        network sees a black background, which is warped instead (by occlusion motion where it was disoccluded), and
        normals whose y is negated: so they are the engine's again in frames that ``essjax import`` turned right-handed.
    """
    network = networks.extranet(history=history)

    def init(key, example):
        require(example, sorted(REQUIRES), info.name)
        return {"extranet": network.init(key, *input_shapes(1, occlusion=occlusion))}

    def render_step(variables, history, frame, *, train=False):
        color = rendered_color(frame, info.name)
        memory = push(_advance(history, frame), frame, _kept(color, frame.gbuffers))
        return memory, Prediction(image=color)

    def extrapolate_step(variables, history, frame, *, train=False):
        memory = _advance(history, frame)
        seen = network_inputs(memory, frame, occlusion=occlusion, published=published)
        inputs = seen.warped, seen.mask, seen.features, seen.history
        log_shading, state = network.apply(variables["extranet"], *inputs, train=train)
        image = modulate(expm1(log_shading), albedo(frame.gbuffers))
        if published:  # the sky is not modulated: shading is colour
            behind = backward_warp(memory.frames.content.shading[0], _around(memory, frame, seen.mask))
            image = jnp.where(background(frame.gbuffers), jax.lax.stop_gradient(behind), image)
        aux = {"log_shading": log_shading, "inputs": seen}
        return memory, Prediction(image=image, aux=aux, state={"extranet": state} if state else {})

    info = MethodInfo("extranet", scale=1, requires=REQUIRES, predicts=frozenset({"ess"}))
    return within_shots(exposed(Method(init, _start, render_step, extrapolate_step, info), map_shading))


def from_torch(weights: str | Path | Mapping[str, Array]) -> PyTree:
    """Variables of ``extranet(published=True)`` from published weights.

    Args:
      weights: a file (see ``tensors.read_tensors``; a ``.pth.tar`` needs no PyTorch), or arrays by the published names.

    Raises:
      ValueError: the file cannot be read, or its entries are not those of ExtraNet.
    """
    tensors = weights if isinstance(weights, Mapping) else read_tensors(weights, "ExtraNet weights")
    return {"extranet": network_from_torch(tensors)}
