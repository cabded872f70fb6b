"""FASSET (Qin et al.): one network supersamples rendered frames and extrapolates the others, at any output size.

Sections 3.2, 3.3. Both tasks get the same kind of input: a frame with holes, cut by the mask of a warp.
"""

import dataclasses

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
    surface_guides,
)
from essjax.interfaces import Method, MethodInfo, expand_flag, reset_at_cut
from essjax.methods.rendered import GUIDED
from essjax.typing import Array, Color, Image, Jitter, Mask, Motion, Scalar, pytree
from essjax.warp import backward_warp, compose_motion, fill_holes, hole_mask, jitter_aligned_upsample, jittered_motion


@pytree
class History:
    """What FASSET remembers: the last rendered frame, the path back to it, and the last frame of either kind.

    Attributes:
      color: of the last rendered frame, log1p, ``[..., H, W, 3]``.
      hidden: the recurrent state after it, ``[..., H, W, width]``, at its samples.
      rendered: its G-buffers.
      rendered_jitter: its jitter.
      motion: composed motion from the last frame's samples to it, unjittered.
      valid: ``[..., H, W, 1]``: 1 where that path stays on screen.
      gbuffers: of the last frame.
      jitter: of the last frame.
      depth_scale: unit of depth, ``[...]``.
      empty: bool ``[...]``: nothing rendered since the cut.
    """

    color: Color
    hidden: Image
    rendered: GBuffers
    rendered_jitter: Jitter
    motion: Motion
    valid: Mask
    gbuffers: GBuffers
    jitter: Jitter
    depth_scale: Scalar
    empty: Array


def _surfaces(gbuffers: GBuffers) -> GBuffers:
    """The buffers that tell surfaces apart; a history need not carry the others."""
    return dataclasses.replace(gbuffers, base_color=None, roughness=None, metallic=None, specular=None, n_dot_v=None)


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

    def init(key, example):
        require(example, sorted(GUIDED), name)
        history, color = start(example), jnp.zeros((*example.motion.shape[:-1], 3))
        inputs = color, history.valid, _guides(history, example), history.hidden, example.jitter
        return {"fasset": network.init(key, *inputs)}

    def start(example: Frame) -> History:
        size = example.motion.shape[:-1]
        copied = lambda: jax.tree.map(jnp.copy, (_surfaces(example.gbuffers), example.jitter))  # noqa: E731
        # No array twice: streaming donates the history.
        (rendered, rendered_jitter), (gbuffers, jitter) = copied(), copied()
        return History(
            color=jnp.zeros((*size, 3), jnp.float32),
            hidden=jnp.zeros((*size, width), jnp.float32),
            rendered=rendered,
            rendered_jitter=rendered_jitter,
            motion=jnp.zeros_like(example.motion),
            valid=jnp.ones((*size, 1), jnp.float32),
            gbuffers=gbuffers,
            jitter=jitter,
            depth_scale=depth_scale(example.gbuffers),
            empty=jnp.ones(example.cut.shape, bool),
        )

    def arrive(history: History, frame: Frame) -> tuple[History, Image, Mask, Mask]:
        """The history with its path extended to ``frame``; colour and hidden state warped along it; two masks.

        Their 1 means: the last rendered frame showed this surface (what is warped is valid); the last frame did.
        """
        history = reset_at_cut(frame.cut, start(frame), history)
        jitters = {"jitter": frame.jitter, "jitter_previous": history.jitter}
        motion, inside = compose_motion(frame.motion, history.motion, **jitters, valid_previous=history.valid)
        same = hole_mask(
            frame.gbuffers, history.rendered, motion, jitter=frame.jitter, jitter_previous=history.rendered_jitter
        )
        valid = jnp.where(expand_flag(history.empty, same.ndim), 0.0, same * inside)
        if frame.reactive is not None:
            valid = valid * (1.0 - frame.reactive)
        recent = hole_mask(frame.gbuffers, history.gbuffers, frame.motion, **jitters)
        lookup = jax.lax.stop_gradient(jittered_motion(motion, frame.jitter, history.rendered_jitter))
        both = jnp.concatenate([jax.lax.stop_gradient(history.color), history.hidden], axis=-1)
        history = dataclasses.replace(
            history, motion=motion, valid=inside, gbuffers=_surfaces(frame.gbuffers), jitter=frame.jitter
        )
        return history, valid * backward_warp(both, lookup), valid, recent

    def _guides(history: History, frame: Frame) -> Image:
        base_color, normal = surface_guides(frame.gbuffers)
        return jnp.concatenate([base_color, network_depth(frame.gbuffers, history.depth_scale), normal], axis=-1)

    def predict(variables, history, frame, color, mask, state, *, train: bool, task: str):
        """The output and the new hidden state from a frame with holes (0 there)."""
        inputs = color, mask, _guides(history, frame), state, frame.jitter
        (residual, state), _ = network.apply(variables["fasset"], *inputs, train=train, method=task)
        base = jitter_aligned_upsample(fill_holes(color, mask), scale, frame.jitter)
        return jax.lax.stop_gradient(base) + residual, state

    def render_step(variables, history, frame, *, train=False):
        color = log1p(rendered_color(frame, name))
        history, warped, _, recent = arrive(history, frame)
        recent = jnp.where(expand_flag(history.empty, recent.ndim), 1.0, recent)  # nothing was warped: no holes
        mask = recent if mask_rendered else jnp.ones_like(recent)
        log_image, state = predict(
            variables, history, frame, jnp.where(mask > 0, color, 0.0), mask, warped[..., 3:], train=train, task="render"
        )
        history = dataclasses.replace(
            history,
            color=color,
            hidden=state,
            rendered=jax.tree.map(jnp.copy, history.gbuffers),
            rendered_jitter=jnp.copy(frame.jitter),
            motion=jnp.zeros_like(history.motion),
            valid=jnp.ones_like(history.valid),
            empty=jnp.zeros_like(history.empty),
        )
        return history, Prediction(
            image=expm1(log_image), aux={"log_image": log_image, "mask": mask, "valid": recent}
        )

    def extrapolate_step(variables, history, frame, *, train=False):
        history, warped, mask, _ = arrive(history, frame)
        log_image, _ = predict(
            variables, history, frame, warped[..., :3], mask, warped[..., 3:], train=train, task="extrapolate"
        )
        return history, Prediction(image=expm1(log_image), aux={"log_image": log_image, "mask": mask, "valid": mask})

    info = MethodInfo(name, scale=scale, requires=GUIDED)
    return Method(init, start, render_step, extrapolate_step, info)
