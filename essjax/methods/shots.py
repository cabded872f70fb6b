"""The limits of history: a frame takes nothing across a cut, and nothing where it is reactive.

A shot begins with its first *rendered* frame. What comes before that shows ``unlit`` and is not remembered.
"""

import dataclasses

import jax.numpy as jnp

from essjax.exposure import metered
from essjax.frames import Frame, frame_size
from essjax.interfaces import Method, Parted, Parts, expand_flag, from_parts
from essjax.sizes import Scale, Size, output_size
from essjax.typing import Color, Flag, Image, Mask, Motion, PyTree, pytree
from essjax.warp import backward_warp, jitter_aligned_upsample


@pytree
class Shot:
    """The history of a method inside ``within_shots``.

    Attributes:
      inner: the method's own.
      empty: bool ``[...]``: nothing was rendered since the last cut.
    """

    inner: PyTree
    empty: Flag


def unlit(frame: Frame, scale: Scale = 1) -> Color:
    """Show a frame while nothing was rendered in its shot: its base colour as if lit evenly, else black.

    Base colour over exposure, which is the radiance that is displayed as the base colour.

    Args:
      frame: its colour is not read.
      scale: of the method; at 1 the picture lies at the frame's own samples.

    Returns:
      ``[..., H', W', 3]``.
    """
    base, size = frame.gbuffers.base_color, output_size(scale, frame_size(frame))
    if base is None:
        return jnp.zeros((*frame.motion.shape[:-3], *size, 3), jnp.float32)
    radiance = base / expand_flag(frame.exposure, base.ndim)
    return radiance if scale == 1 else jitter_aligned_upsample(radiance, size, frame.jitter)


def upsampled_reactive(frame: Frame, size: Size) -> Mask | None:
    """Bring the frame's reactive mask to an output of ``size``, each pixel as the nearest sample; None without one."""
    if frame.reactive is None:
        return None
    return jitter_aligned_upsample(frame.reactive, size, frame.jitter, mode="nearest")


def check_masks(earlier: Mask | None, reactive: Mask | None) -> None:
    """Raise a ValueError unless this frame has a reactive mask just as those before it: histories keep their shape."""
    if (earlier is None) != (reactive is None):
        raise ValueError(
            f"reactive: expected a mask in every frame or in none, got {'none' if reactive is None else 'one'} after "
            "others. Fill the missing ones with 0."
        )


def path_trust(earlier: Mask | None, reactive: Mask | None, motion: Motion) -> Mask | None:
    """Return the trust in a path that ``motion`` makes longer: 1 - reactive here, times what was left there.

    Args:
      earlier: of the path from the previous frame on, ``[..., H, W, 1]``; None where frames have no masks.
      reactive: this frame's mask, the same size; or None.
      motion: ``[..., H, W, 2]`` to the pixels of ``earlier``.

    Raises:
      ValueError: one of the two masks is missing.
    """
    check_masks(earlier, reactive)
    if earlier is None or reactive is None:
        return None
    return (1.0 - reactive) * backward_warp(earlier, motion, mode="nearest")


def without_history(history: Image, current: Image, frame: Frame) -> Image:
    """``history``, but ``current`` as far as the frame is reactive, and everywhere where it begins a shot.

    Args:
      history: what was shown, at the output pixels of ``frame``, ``[..., H', W', C]``.
      current: what the frame's own samples show there.
      frame: its mask and whether it is a cut.
    """
    return fade(history, current, upsampled_reactive(frame, current.shape[-3:-1]), frame.cut)


def fade(history: Image, current: Image, reactive: Mask | None, cut: Flag) -> Image:
    """``without_history`` of a frame with this mask at the output's pixels (``upsampled_reactive``)."""
    if reactive is not None:
        mixed = (1.0 - reactive) * history + reactive * current
        history = jnp.where(reactive < 1.0, mixed, current)  # at 1 nothing is left, not even NaN
    return jnp.where(expand_flag(cut, current.ndim), current, history)


def continued(frame: Frame, empty: Flag) -> Frame:
    """``frame`` as one that begins its shot where nothing was rendered yet in it (``empty``)."""
    return dataclasses.replace(frame, cut=frame.cut | empty)


def within_shots(method: Method) -> Method:
    """Let the shots of ``method`` begin with their first rendered frame.

    A frame that is not rendered and has no rendered one before it in its shot shows ``unlit``, and the frame after it
    is a cut for ``method``, which so neither trusts that picture nor remembers anything from before the shot.

    Args:
      method: without latency; its own steps forget everything where ``frame.cut``. Frames without an exposure are
        metered for it and for ``unlit``.

    Raises:
      ValueError: the method lags: its step's image is not that of the step's frame.
    """
    if method.info.latency:
        raise ValueError(f"within_shots: expected a method without latency, got {method.info.name}.")

    if method.parts is not None:
        return _parts_within_shots(method, method.parts)

    def start(example: Frame) -> Shot:
        return Shot(inner=method.start(example), empty=jnp.ones(example.cut.shape, bool))

    def render_step(variables, history, frame, *, train=False):
        seen = continued(frame, history.empty)
        inner, prediction = method.render_step(variables, history.inner, seen, train=train)
        return Shot(inner=inner, empty=jnp.zeros_like(history.empty)), prediction

    def extrapolate_step(variables, history, frame, *, train=False):
        seen = continued(frame, history.empty)
        inner, prediction = method.extrapolate_step(variables, history.inner, seen, train=train)
        fallback = unlit(frame, method.info.scale)
        image = jnp.where(expand_flag(seen.cut, fallback.ndim), fallback, prediction.image)
        return Shot(inner=inner, empty=seen.cut), dataclasses.replace(prediction, image=image)

    return metered(method._replace(start=start, render_step=render_step, extrapolate_step=extrapolate_step))


def _parts_within_shots(method: Method, parts: Parts) -> Method:
    """Do the same for a method that is made of parts."""

    def start(example: Frame) -> Parted:
        history = method.start(example)
        empty = jnp.ones(example.cut.shape, bool)
        return dataclasses.replace(history, memory=Shot(inner=history.memory, empty=empty))

    def remember(memory, frame):
        seen = continued(frame, memory.empty)
        inner, notes = parts.remember(memory.inner, seen)
        empty = seen.cut if frame.color is None else jnp.zeros_like(memory.empty)
        return Shot(inner=inner, empty=empty), (notes, seen.cut)

    def observe(variables, notes, frame):
        notes, cut = notes
        seen = parts.observe(variables, notes, dataclasses.replace(frame, cut=cut))
        return seen, (cut, unlit(frame, method.info.scale)) if frame.color is None else None

    def show(variables, shown, seen, *, train):
        seen, fallback = seen
        shown, prediction = parts.show(variables, shown, seen, train=train)
        if fallback is not None:
            cut, image = fallback
            image = jnp.where(expand_flag(cut, image.ndim), image, prediction.image)
            prediction = dataclasses.replace(prediction, image=image)
        return shown, prediction

    return metered(from_parts(method.init, start, Parts(remember, observe, show), method.info))
