"""Interpolation between rendered frames: one frame of latency, which extrapolation exists to avoid.

``interpolator`` holds what all of them share: the step that renders frame n returns frame n - 1, interpolated from
n - 2 and n; the step of an unrendered frame returns the rendered one before it. Two classical methods without training
follow: ``warp_3d`` (Mark et al. 1997) and ``bsr`` (Yang et al. 2011). They follow the motion between both rendered
frames, halved; of the interpolated frame they only use its motion vectors, as links of that path.
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, rendered_color, select_time
from essjax.interfaces import Init, Method, MethodInfo, expand_flag, no_variables
from essjax.methods.registry import registered
from essjax.methods.rendered import Memory, advance, map_content, push, reset_memory, start_memory
from essjax.methods.shots import unlit
from essjax.typing import Callable, Color, Flag, Jitter, Mask, Motion, Plane, PyTree, pytree
from essjax.warp import backward_warp, inside_mask, jittered_motion, sample, splat_motion

DEPTH_TOLERANCE = 0.1
"""Largest relative difference in depth at which two reads count as the same surface."""


@pytree
class Seen:
    """All that is kept of a rendered frame.

    Attributes:
      color: ``[..., H, W, 3]``.
      depth: ``[..., H, W, 1]``.
      motion: ``[..., H, W, 2]`` to the display frame before it.
    """

    color: Color
    depth: Plane
    motion: Motion


@pytree
class Pair:
    """Two rendered frames around the one that is wanted.

    Attributes:
      earlier: rendered frame n - 2.
      later: rendered frame n.
      jitter_earlier: ``[..., 2]``.
      jitter_later: ``[..., 2]``.
      jitter: of frame n - 1, whose samples are wanted.
      motion: ``[..., H, W, 2]`` from ``later`` to ``earlier``, composed along the path, unjittered.
    """

    earlier: Seen
    later: Seen
    jitter_earlier: Jitter
    jitter_later: Jitter
    jitter: Jitter
    motion: Motion


@pytree
class History:
    """The memory of interpolation.

    Attributes:
      rendered: the last rendered frame and the path to it; its content is a ``Seen``.
      waiting: bool ``[...]``: the latest frame was not rendered, its image is still due.
    """

    rendered: Memory
    waiting: Flag


Between = Callable[[PyTree, Pair, bool], tuple[Color, dict[str, PyTree]]]
"""``(variables, pair, train) -> (image halfway, aux)``."""


def interpolator(name: str, between: Between, *, init: Init = no_variables) -> Method:
    """Make a method of latency 1 that shows each rendered frame and, halfway between two, what ``between`` makes.

    It is built for the alternation: of several unrendered frames in a row all but the last repeat the rendered one. So
    does an unrendered frame before a cut, which has no later frame in its shot; one right after a cut, which has no
    earlier frame, shows the next rendered one, or ``shots.unlit`` where its shot has none. ``aux`` of a rendered
    frame's step belongs to the frame before it.

    Args:
      name: as in ``--variant``.
      between: makes the image halfway.
      init: makes its variables.
    """

    def seen(frame: Frame, color: Color) -> Seen:
        return Seen(color=color, depth=frame.gbuffers.depth, motion=frame.motion)

    def start(example: Frame) -> History:
        memory = start_memory(example, seen(example, unlit(example)), 1)
        return History(rendered=memory, waiting=jnp.zeros(example.cut.shape, bool))

    def render_step(variables, history, frame, *, train=False):
        color = rendered_color(frame, name)
        before, memory = history.rendered, advance(history.rendered, frame)
        earlier = select_time(before.frames, 0)
        pair = Pair(
            earlier=earlier.content,
            later=seen(frame, color),
            jitter_earlier=earlier.jitter,
            jitter_later=frame.jitter,
            jitter=before.jitter,
            motion=memory.frames.motion[0],
        )
        image, aux = between(variables, pair, train)
        repeat = expand_flag(~history.waiting | frame.cut, color.ndim)
        image = jnp.where(repeat, earlier.content.color, image)
        image = jnp.where(expand_flag((before.count > 0) | frame.cut, color.ndim), image, color)
        memory = reset_memory(frame.cut, start(frame).rendered, memory)
        history = History(rendered=push(memory, frame, pair.later), waiting=jnp.zeros_like(history.waiting))
        return history, Prediction(image=image, aux=aux)

    def extrapolate_step(variables, history, frame, *, train=False):
        image = history.rendered.frames.content.color[0]
        nothing = frame.cut | (history.rendered.count == 0)
        memory = advance(reset_memory(nothing, start(frame).rendered, history.rendered), frame)
        return History(rendered=memory, waiting=jnp.ones_like(history.waiting)), Prediction(image=image)

    def map_radiance(function, history):
        scaled = lambda kept: dataclasses.replace(kept, color=function(kept.color))  # noqa: E731
        return dataclasses.replace(history, rendered=map_content(scaled, history.rendered))

    info = MethodInfo(name, scale=1, latency=1, predicts=frozenset({"ess"}))
    return exposed(Method(init, start, render_step, extrapolate_step, info), map_radiance)


@pytree
class Candidate:
    """One of the two rendered frames, as it is seen at the wanted pixels.

    Attributes:
      color: ``[..., H, W, 3]``.
      nearness: ``[..., H, W, 1]``, 1 / depth, background 0.
      found: ``[..., H, W, 1]``: 1 where it was found.
    """

    color: Color
    nearness: Plane
    found: Mask


def _same_surface(first: Plane, second: Plane) -> Flag:
    return jnp.abs(first - second) <= DEPTH_TOLERANCE * jnp.maximum(first, second)


def blend(first: Candidate, second: Candidate) -> Color:
    """Take the mean where both show the same surface, else the nearer one found; the mean again where none is."""
    same = _same_surface(first.nearness, second.nearness)
    both = (first.found > 0) & (second.found > 0)
    nearer = (first.nearness > second.nearness).astype(jnp.float32)
    share = jnp.where(both, jnp.where(same, 0.5, nearer), 0.5 + 0.5 * (first.found - second.found))
    return share * first.color + (1.0 - share) * second.color


def forward_motion(pair: Pair) -> Motion:
    """Motion of ``earlier``'s pixels to ``later``, ``[..., H, W, 2]``; renderers give motion backward only.

    It is what splatting the backward motion leaves there. Where that comes from another surface or from nowhere, what
    ``earlier`` shows is hidden in ``later``: its own motion is continued instead.
    """
    to_earlier = jittered_motion(pair.motion, pair.jitter_later, pair.jitter_earlier)
    motion, depth, known = splat_motion(pair.motion, pair.later.depth, to_earlier)
    known = (known > 0) & _same_surface(nearness(depth), nearness(pair.earlier.depth))
    return jnp.where(known, -motion, -2.0 * pair.earlier.motion)


def nearness(depth: Plane) -> Plane:
    """1 / depth: background is 0, and so are differences to it finite."""
    return 1.0 / jnp.maximum(depth, 1e-6)


def _halves(pair: Pair) -> list[tuple[Seen, Motion, Jitter]]:
    """Both rendered frames with their pixels' motion until halfway, and their jitters."""
    return [
        (pair.later, 0.5 * pair.motion, pair.jitter_later),
        (pair.earlier, 0.5 * forward_motion(pair), pair.jitter_earlier),
    ]


@registered
def warp_3d() -> Method:
    """Forward warping of both rendered frames to the time between them (Mark et al. 1997).

    Every pixel carries half of its motion to where it is halfway; nearest depth wins there. Colour is then read at the
    carried motion's origin, so that reads are as exact as those of a warped mesh. The frames fill each other's holes.
    """

    def between(variables, pair, train):
        del variables, train
        sides = []
        for seen, half, jitter in _halves(pair):
            carried, depth, known = splat_motion(half, seen.depth, jittered_motion(half, jitter, pair.jitter))
            # A filled crack counts only where the other frame has nothing: at holes it is the surface next to them.
            found = (known == 1).astype(known.dtype)
            lookup = jittered_motion(-carried, pair.jitter, jitter)
            color = backward_warp(seen.color, lookup)
            sides.append(Candidate(color=color, nearness=nearness(depth), found=found))
        return blend(*sides), {}

    return interpolator("3d-warp", between)


def fixed_point(half: Motion, jitter: Jitter, jitter_wanted: Jitter, iterations: int) -> tuple[Motion, Mask]:
    """Where the pixels that arrive at each pixel halfway came from: iterates lookup = jitter difference - half(lookup).

    Args:
      half: ``[..., H, W, 2]`` motion of a rendered frame's pixels until halfway.
      jitter: ``[..., 2]`` of that frame.
      jitter_wanted: ``[..., 2]`` of the frame halfway.
      iterations: how often ``half`` is read.

    Returns:
      The lookup ``[..., H, W, 2]`` into the rendered frame, and 1 where it leads back to within half a pixel.
    """
    positions = pixel_positions(half.shape[-3], half.shape[-2])
    start = jittered_motion(jnp.zeros_like(half), jitter_wanted, jitter)

    def read(lookup: Motion) -> Motion:
        return start - sample(half, positions + lookup)

    lookup = jax.lax.fori_loop(0, iterations, lambda _, lookup: read(lookup), start)
    residual = jnp.linalg.norm(read(lookup) - lookup, axis=-1, keepdims=True)
    return lookup, (residual < 0.5).astype(half.dtype)


@registered
def bsr(*, iterations: int = 4) -> Method:
    """Bidirectional reprojection (Yang et al. 2011): fixed-point search in both rendered frames, then a blend.

    Args:
      iterations: of the search.

    Raises:
      ValueError: ``iterations`` is less than 1.
    """
    if iterations < 1:
        raise ValueError(f"iterations: expected at least 1, got {iterations}.")

    def between(variables, pair, train):
        del variables, train
        sides = []
        for seen, half, jitter in _halves(pair):
            lookup, found = fixed_point(half, jitter, pair.jitter, iterations)
            depth = backward_warp(seen.depth, lookup, mode="nearest")  # not interpolated: it may be infinite
            color = backward_warp(seen.color, lookup)
            sides.append(Candidate(color=color, nearness=nearness(depth), found=found * inside_mask(lookup)))
        return blend(*sides), {}

    return interpolator("bsr", between)
