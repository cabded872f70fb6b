"""The latest rendered frames and the paths back to them: the low-resolution memory of methods that extrapolate.

ExtraSS keeps two frames (sections 4.2, 4.3), ExtraNet three (section 4.1); what a method keeps of each is its own.
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.color import demodulate, demodulation_albedo, modulate, reinhard, reinhard_inverse
from essjax.frames import Frame, GBuffers, background, rendered_color
from essjax.interfaces import expand_flag, reset_at_cut
from essjax.methods.shots import check_masks, path_trust
from essjax.typing import Array, Callable, Color, Flag, Image, Jitter, Mask, Motion, PyTree, pytree
from essjax.warp import compose_motion, gbuffer_guided_warp, guides, jittered_motion


@pytree
class Rendered:
    """Rendered frames and the paths from the latest frame back to them; the first of ``[K, ...]`` is the newest.

    Attributes:
      content: what the method keeps of a frame, a pytree of ``[K, ..., H, W, C]``.
      jitter: ``[K, ..., 2]``.
      motion: ``[K, ..., H, W, 2]`` composed motion from the latest frame's samples to that frame, unjittered.
      valid: ``[K, ..., H, W, 1]``: 1 where that path stays on screen.
      trust: ``[K, ..., H, W, 1]``: what the reactive masks along that path leave of it; None without such masks.
      age: ``[K, ...]`` float32: how many frames ago it was rendered; 1 and 3 where every other frame is.
    """

    content: PyTree
    jitter: Jitter
    motion: Motion
    valid: Mask
    trust: Mask | None
    age: Array


@pytree
class Memory:
    """The K latest rendered frames.

    Attributes:
      frames: stacked: t-1, t-3, ... at half rate; places that no frame has taken yet hold the oldest one.
      count: ``[...]`` number rendered since the last cut.
      jitter: ``[..., 2]`` of the latest frame, rendered or not.
    """

    frames: Rendered
    count: Array
    jitter: Jitter


def hole_buffers(gbuffers: GBuffers) -> GBuffers:
    """Those that marking holes needs of an earlier frame."""
    return dataclasses.replace(gbuffers, base_color=None, roughness=None, metallic=None, specular=None, n_dot_v=None)


def start_memory(example: Frame, content: PyTree, frames: int) -> Memory:
    """Make a memory of nothing, for ``frames`` frames of the shapes of ``example`` and ``content``."""

    def repeat(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, (frames, *leaf.shape))

    fresh = jax.tree.map(repeat, _remember(example, content))
    return Memory(frames=fresh, count=jnp.zeros(example.cut.shape, jnp.int32), jitter=jnp.copy(example.jitter))


def _remember(frame: Frame, content: PyTree) -> Rendered:
    """Remember a frame that was just rendered: no way back to go."""
    return Rendered(
        content=content,
        jitter=frame.jitter,
        motion=jnp.zeros_like(frame.motion),
        valid=jnp.ones_like(frame.gbuffers.depth),
        trust=None if frame.reactive is None else jnp.ones_like(frame.reactive),
        age=jnp.zeros(frame.cut.shape, jnp.float32),
    )


def reset_memory(cut: Flag, fresh: Memory, memory: Memory) -> Memory:
    """``fresh`` where ``cut``: ``interfaces.reset_at_cut`` for leaves that carry the memory's axis in front."""
    check_masks(memory.frames.trust, fresh.frames.trust)

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(expand_flag(cut, new.ndim - 1), new, old)

    frames = jax.tree.map(choose, fresh.frames, memory.frames)
    rest = {name: reset_at_cut(cut, getattr(fresh, name), getattr(memory, name)) for name in ("count", "jitter")}
    return Memory(frames=frames, **rest)


def advance(memory: Memory, frame: Frame) -> Memory:
    """Extend all paths by the motion of ``frame``, so that they start at its samples; its reactive mask is on them."""
    previous = memory.frames

    def share(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, (previous.motion.shape[0], *leaf.shape))

    motion, valid = compose_motion(
        share(frame.motion),
        previous.motion,
        jitter=share(frame.jitter),
        jitter_previous=share(memory.jitter),
        valid_previous=previous.valid,
    )
    reactive = None if frame.reactive is None else share(frame.reactive)
    trust = path_trust(previous.trust, reactive, share(jittered_motion(frame.motion, frame.jitter, memory.jitter)))
    frames = dataclasses.replace(previous, motion=motion, valid=valid, trust=trust, age=previous.age + 1.0)
    return dataclasses.replace(memory, frames=frames, jitter=frame.jitter)


def push(memory: Memory, frame: Frame, content: PyTree) -> Memory:
    """Add a rendered frame, of which ``content`` is kept, to a memory that was advanced to it."""

    def shift(new: Array, old: Array) -> Array:
        older = jnp.where(expand_flag(memory.count == 0, new.ndim), new, old[:-1])
        return jnp.concatenate([new[None], older])

    frames = jax.tree.map(shift, _remember(frame, content), memory.frames)
    return dataclasses.replace(memory, frames=frames, count=memory.count + 1)


def map_content(function: Callable[[PyTree], PyTree], memory: Memory) -> Memory:
    """``memory`` with ``function`` of what is kept of its frames."""
    frames = dataclasses.replace(memory.frames, content=function(memory.frames.content))
    return dataclasses.replace(memory, frames=frames)


def map_shading(function: Callable[[Array], Array], memory: Memory) -> Memory:
    """``memory`` with ``function`` of the shading that it keeps: what of it is radiance."""
    return map_content(lambda kept: dataclasses.replace(kept, shading=function(kept.shading)), memory)


def albedo(gbuffers: GBuffers) -> Color:
    """Return the demodulation divisor of these G-buffers; ones where base colour is absent."""
    base_color = gbuffers.base_color
    if base_color is None:
        return jnp.ones((*gbuffers.depth.shape[:-1], 3), jnp.float32)
    return demodulation_albedo(base_color, background(gbuffers), gbuffers.metallic, gbuffers.specular)


@pytree
class Shading:
    """All that guided warps keep of a rendered frame.

    Attributes:
      shading: demodulated colour ``[..., H, W, 3]``; colour where there is no base colour.
      guide: ``warp.guides`` ``[..., H, W, 6]``.
    """

    shading: Color
    guide: Image


def _shading(frame: Frame) -> Shading:
    shading = demodulate(rendered_color(frame, "extrass"), albedo(frame.gbuffers))
    return Shading(shading=shading, guide=guides(frame.gbuffers))


def start_pair(example: Frame) -> Memory:
    """ExtraSS's memory of nothing, with the shapes of ``example`` (whose colour may be None)."""
    black = dataclasses.replace(example, color=jnp.zeros((*example.motion.shape[:-1], 3), jnp.float32))
    return start_memory(example, _shading(black), 2)


def push_pair(memory: Memory, frame: Frame) -> Memory:
    """``push`` of what guided warps need."""
    return push(memory, frame, _shading(frame))


def reset_pair(frame: Frame, memory: Memory) -> Memory:
    """``memory`` of nothing where ``frame`` follows a cut.

    What it has kept stays where it is, unread while ``count`` is 0: choosing would copy it in every frame.
    """
    fresh = start_pair(frame)
    kept = reset_memory(frame.cut, _without_content(fresh), _without_content(memory))
    return dataclasses.replace(kept, frames=dataclasses.replace(kept.frames, content=memory.frames.content))


def _without_content(memory: Memory) -> Memory:
    return dataclasses.replace(memory, frames=dataclasses.replace(memory.frames, content=None))


def guided_extrapolation(
    rendered: Rendered, count: Array, frame: Frame, *, sigma_guide: float | tuple[float, ...], sigma_distance: float
) -> Color:
    """f_g: rendered frames warped to ``frame``'s samples, ``[2, ..., H, W, 3]`` (or without that axis; eq 1-3).

    Shading is warped and modulated with the *current* base colour (section 4.2); without one, colour is warped. Warps
    blend x / (1 + x), so that of four candidates a bright one does not rule. Black where nothing was rendered yet.

    Args:
      rendered: one frame or more of a ``Memory``.
      count: of that memory.
      frame: the current one, its colour unread.
      sigma_guide: see ``gbuffer_guided_warp``.
      sigma_distance: see ``gbuffer_guided_warp``.
    """
    like = rendered.motion.shape[: -frame.motion.ndim]  # (2,) or ()

    def share(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, like + leaf.shape)

    shading = gbuffer_guided_warp(
        reinhard(rendered.content.shading),
        rendered.content.guide,
        share(guides(frame.gbuffers)),
        jittered_motion(rendered.motion, share(frame.jitter), rendered.jitter),
        sigma_guide=sigma_guide,
        sigma_distance=sigma_distance,
    )
    shading = jnp.where(expand_flag(count > 0, frame.motion.ndim), reinhard_inverse(shading), 0.0)
    return modulate(shading, albedo(frame.gbuffers))
