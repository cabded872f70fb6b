"""FASSET (Qin et al.): one network supersamples rendered frames and extrapolates the others, at any output size.

Sections 3.2, 3.3. Both tasks get the same kind of input: a frame with holes, cut by the mask of a warp.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax import networks
from essjax.color import expm1, log1p
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
from essjax.interfaces import Method, MethodInfo, reset_at_cut
from essjax.methods.rendered import GUIDED, Memory, advance, hole_buffers, push, reset_memory, start_memory
from essjax.methods.shots import within_shots
from essjax.typing import Color, Image, Mask, Scalar, pytree
from essjax.warp import backward_warp, fill_holes, hole_mask, jitter_aligned_upsample, jittered_motion


@pytree
class Kept:
    """What is kept of a rendered frame.

    Attributes:
      color: log1p, ``[..., H, W, 3]``.
      hidden: the recurrent state after it, ``[..., H, W, width]``.
      surfaces: the G-buffers that tell surfaces apart.
    """

    color: Color
    hidden: Image
    surfaces: GBuffers


@pytree
class History:
    """The last rendered frame and the last frame of either kind.

    Attributes:
      rendered: memory of one frame, its content a ``Kept``.
      surfaces: G-buffers of the last frame.
      depth_scale: unit of depth, ``[...]``.
    """

    rendered: Memory
    surfaces: GBuffers
    depth_scale: Scalar


class Arrival(NamedTuple):
    """What the history shows at a frame's samples.

    Attributes:
      color: of the last rendered frame, 0 in holes.
      hidden: its recurrent state, 0 in holes.
      valid: 1 where the last rendered frame showed this surface, 0 in holes, ``[..., H, W, 1]``.
      recent: 1 where the last frame, rendered or not, did; 1 everywhere if there was none, and where the
        frame is reactive.
    """

    color: Color
    hidden: Image
    valid: Mask
    recent: Mask


def _surfaces(gbuffers: GBuffers) -> GBuffers:
    return jax.tree.map(jnp.copy, hole_buffers(gbuffers))  # streaming donates the history, not the frame


def _start(example: Frame, width: int) -> History:
    size = example.motion.shape[:-1]
    color, hidden = (jnp.zeros((*size, channels), jnp.float32) for channels in (3, width))
    kept = Kept(color=color, hidden=hidden, surfaces=_surfaces(example.gbuffers))
    return History(
        rendered=start_memory(example, kept, 1),
        surfaces=_surfaces(example.gbuffers),
        depth_scale=depth_scale(example.gbuffers),
    )


def _arrive(history: History, frame: Frame, width: int) -> tuple[History, Arrival]:
    """The history with its path extended to ``frame``, and what it shows there."""
    fresh, before = _start(frame, width), history.rendered
    before = reset_memory(frame.cut, fresh.rendered, before)
    surfaces = reset_at_cut(frame.cut, fresh.surfaces, history.surfaces)
    unit = reset_at_cut(frame.cut, fresh.depth_scale, history.depth_scale)
    empty = before.count[..., None, None, None] == 0
    recent = hole_mask(frame.gbuffers, surfaces, frame.motion, jitter=frame.jitter, jitter_previous=before.jitter)
    memory = advance(before, frame)
    last = select_time(memory.frames, 0)
    same = hole_mask(
        frame.gbuffers, last.content.surfaces, last.motion, jitter=frame.jitter, jitter_previous=last.jitter
    )
    valid = jnp.where(empty, 0.0, same * last.valid)
    recent = jnp.where(empty, 1.0, recent)
    if frame.reactive is not None and last.trust is not None:
        valid = valid * last.trust
        # What a reactive pixel shows is its own sample: nothing is cut out of it.
        recent = jnp.maximum(recent, frame.reactive)
    lookup = jax.lax.stop_gradient(jittered_motion(last.motion, frame.jitter, last.jitter))
    both = jnp.concatenate([jax.lax.stop_gradient(last.content.color), last.content.hidden], axis=-1)
    warped = valid * backward_warp(both, lookup)
    history = History(rendered=memory, surfaces=_surfaces(frame.gbuffers), depth_scale=unit)
    return history, Arrival(warped[..., :3], warped[..., 3:], valid, recent)


def fasset(
    *,
    scale: float = 2,
    width: int = 24,
    hidden: int | None = None,
    gencoder: bool = True,
    mask_rendered: bool = True,
    shared: bool = True,
) -> Method:
    """FASSET: ``variables = {"fasset": ...}``, ``aux`` holds ``log_image``, ``mask`` and ``valid``.

    A rendered frame is not warped, but the holes of the warped previous frame are cut out of it, so that both tasks
    look alike and in-painting is learned from both. The output is RenderINR's plus the upsampled input, whose holes
    are filled smoothly; output pixel P reads at (P + 0.5) / scale - jitter. The hidden state is updated by rendered
    frames, follows the motion and is 0 in holes.

    Args:
      scale: output size over input size, any positive number; output sizes are rounded.
      width: channels of each of the two feature maps.
      hidden: neurons of RenderINR's layers; None: 16/3 of the width, 128 at 24.
      gencoder: False feeds RenderINR the G-buffers themselves (Table 4, "- GEncoder").
      mask_rendered: False leaves rendered frames whole (Table 4, "- Additional mask").
      shared: False gives each task a FrameEncoder of its own (Table 4, "- Shared weights").

    Raises:
      ValueError: the scale is not positive.
    """
    if not scale > 0:
        raise ValueError(f"scale: expected a positive number, got {scale!r}.")
    hidden = width * 16 // 3 if hidden is None else hidden
    network = networks.fasset(scale, width=width, hidden=hidden, gencoder=gencoder, shared=shared)
    removed = {"no-gencoder": not gencoder, "no-mask": not mask_rendered, "no-sharing": not shared}
    name = "-".join(["fasset", *(part for part, absent in removed.items() if absent)])

    def start(example):
        return _start(example, width)

    def init(key, example):
        require(example, sorted(GUIDED), name)
        history, size = start(example), example.motion.shape[:-1]
        color, mask, hidden = (jnp.zeros((*size, channels), jnp.float32) for channels in (3, 1, width))
        inputs = color, mask, _guides(history, example), hidden
        return {"fasset": network.init(key, *inputs, example.jitter)}

    def predict(variables, history, frame, color, mask, hidden, train, task):
        """The output as log1p and the new hidden state, from a frame whose holes are 0."""
        inputs = color, mask, _guides(history, frame), hidden, frame.jitter
        (residual, hidden), _ = network.apply(variables["fasset"], *inputs, train=train, method=task)
        base = jitter_aligned_upsample(fill_holes(color, mask), scale, frame.jitter)
        return jax.lax.stop_gradient(base) + residual, hidden

    def render_step(variables, history, frame, *, train=False):
        color = log1p(rendered_color(frame, name))
        history, arrival = _arrive(history, frame, width)
        mask = arrival.recent if mask_rendered else jnp.ones_like(arrival.recent)
        visible = jnp.where(mask > 0, color, 0.0)
        log_image, hidden = predict(variables, history, frame, visible, mask, arrival.hidden, train, "render")
        kept = Kept(color=color, hidden=hidden, surfaces=_surfaces(frame.gbuffers))
        history = dataclasses.replace(history, rendered=push(history.rendered, frame, kept))
        aux = {"log_image": log_image, "mask": mask, "valid": arrival.recent}
        return history, Prediction(image=expm1(log_image), aux=aux)

    def extrapolate_step(variables, history, frame, *, train=False):
        history, arrival = _arrive(history, frame, width)
        color, hidden, mask, _ = arrival
        log_image, _ = predict(variables, history, frame, color, mask, hidden, train, "extrapolate")
        return history, Prediction(image=expm1(log_image), aux={"log_image": log_image, "mask": mask, "valid": mask})

    info = MethodInfo(name, scale=scale, requires=GUIDED)
    return within_shots(Method(init, start, render_step, extrapolate_step, info))


def _guides(history: History, frame: Frame) -> Image:
    """Albedo, depth and normal as the network sees them, ``[..., H, W, 7]``."""
    base_color, normal = surface_guides(frame.gbuffers)
    return jnp.concatenate([base_color, network_depth(frame.gbuffers, history.depth_scale), normal], axis=-1)
