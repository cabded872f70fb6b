"""The two latest rendered frames and the paths back to them: ExtraSS's low-resolution memory (sections 4.2, 4.3)."""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.color import demodulate, demodulation_albedo, modulate
from essjax.frames import Frame, GBuffers, background, rendered_color, surface_guides
from essjax.interfaces import expand_flag, reset_at_cut
from essjax.typing import Array, Color, Flag, Image, Jitter, Mask, Motion, pytree
from essjax.warp import compose_motion, gbuffer_guided_warp, guides, jittered_motion

GUIDED = frozenset({"base_color", "normal"})
"""``MethodInfo.requires`` of every method that warps guided by G-buffers."""


@pytree
class Rendered:
    """Rendered frames and the paths from the latest frame back to them; [2, ...]: the newest and the older one.

    Attributes:
      shading: demodulated colour ``[2, ..., H, W, 3]``.
      guide: base colour and normal ``[2, ..., H, W, 6]``.
      jitter: ``[2, ..., 2]``.
      motion: ``[2, ..., H, W, 2]`` composed motion from the latest frame's samples to that frame, unjittered.
      valid: ``[2, ..., H, W, 1]``: 1 where that path stays on screen.
    """

    shading: Color
    guide: Image
    jitter: Jitter
    motion: Motion
    valid: Mask


@pytree
class RenderedPair:
    """The two latest rendered frames.

    Attributes:
      frames: stacked: t-1 and t-3 in the alternation; equal while only one has been rendered.
      count: ``[...]`` number rendered since the last cut.
      jitter: ``[..., 2]`` of the latest frame, rendered or not.
    """

    frames: Rendered
    count: Array
    jitter: Jitter


def albedo(gbuffers: GBuffers) -> Color:
    """The demodulation divisor of these G-buffers."""
    base_color, _ = surface_guides(gbuffers)
    return demodulation_albedo(base_color, background(gbuffers), gbuffers.metallic, gbuffers.specular)


def _remember(frame: Frame) -> Rendered:
    """A frame that was just rendered: no way back to go."""
    return Rendered(
        shading=demodulate(rendered_color(frame, "extrass"), albedo(frame.gbuffers)),
        guide=guides(frame.gbuffers),
        jitter=frame.jitter,
        motion=jnp.zeros_like(frame.motion),
        valid=jnp.ones_like(frame.gbuffers.depth),
    )


def start_pair(example: Frame) -> RenderedPair:
    """A memory of nothing, with the shapes of ``example`` (whose colour may be None)."""
    empty = _remember(dataclasses.replace(example, color=jnp.zeros((*example.motion.shape[:-1], 3))))
    count = jnp.zeros(example.cut.shape, jnp.int32)
    return RenderedPair(frames=jax.tree.map(_twice, empty), count=count, jitter=jnp.copy(example.jitter))


def reset_pair(cut: Flag, fresh: RenderedPair, pair: RenderedPair) -> RenderedPair:
    """``fresh`` where ``cut``: ``interfaces.reset_at_cut`` for leaves that carry the pair's axis in front."""

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(expand_flag(cut, new.ndim - 1), new, old)

    frames = jax.tree.map(choose, fresh.frames, pair.frames)
    rest = {name: reset_at_cut(cut, getattr(fresh, name), getattr(pair, name)) for name in ("count", "jitter")}
    return RenderedPair(frames=frames, **rest)


def _twice(leaf: Array) -> Array:
    return jnp.stack([leaf, leaf])


def advance(pair: RenderedPair, frame: Frame) -> RenderedPair:
    """Extend both paths by the motion of ``frame``, so that they start at its samples."""
    motion, valid = compose_motion(
        _twice(frame.motion),
        pair.frames.motion,
        jitter=_twice(frame.jitter),
        jitter_previous=_twice(pair.jitter),
        valid_previous=pair.frames.valid,
    )
    frames = dataclasses.replace(pair.frames, motion=motion, valid=valid)
    return dataclasses.replace(pair, frames=frames, jitter=frame.jitter)


def push(pair: RenderedPair, frame: Frame) -> RenderedPair:
    """Add a rendered frame to a memory that was advanced to it."""

    def shift(new: Array, old: Array) -> Array:
        return jnp.stack([new, jnp.where(expand_flag(pair.count == 0, new.ndim), new, old[0])])

    frames = jax.tree.map(shift, _remember(frame), pair.frames)
    return dataclasses.replace(pair, frames=frames, count=pair.count + 1)


def guided_extrapolation(
    rendered: Rendered, frame: Frame, *, sigma_guide: float | tuple[float, ...], sigma_distance: float
) -> Color:
    """f_g: rendered frames warped to ``frame``'s samples, ``[2, ..., H, W, 3]`` (or without the pair's axis; eq 1-3).

    Shading is warped and modulated with the *current* base colour (section 4.2).
    """
    like = rendered.shading.shape[: -frame.motion.ndim]  # (2,) or ()

    def share(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, like + leaf.shape)

    shading = gbuffer_guided_warp(
        rendered.shading,
        rendered.guide,
        share(guides(frame.gbuffers)),
        jittered_motion(rendered.motion, share(frame.jitter), rendered.jitter),
        sigma_guide=sigma_guide,
        sigma_distance=sigma_distance,
    )
    return modulate(shading, albedo(frame.gbuffers))
