"""Exposure: what radiance is multiplied with before it is encoded, so that its unit does not matter (ADR 11).

A frame's recorded exposure, else middle grey over a mean of the logarithm of luminance: methods use that of the frames
they have been given so far (``metered``), metrics that of the clip's reference (``clip_exposure``).
"""

import dataclasses
import math

import jax
import jax.numpy as jnp

from essjax.color import expose, sum_channels
from essjax.frames import Frame
from essjax.interfaces import Method, Parts, Step, from_parts
from essjax.typing import Array, Callable, Color, Flag, PyTree, Scalar, pytree

GREY = 0.18
"""The exposed mean luminance."""
DARK = 0.01
"""A pixel of this share of the frame's mean luminance counts half: black must not rule a night scene."""


def log_luminance(color: Color) -> tuple[Scalar, Flag]:
    """Weighted mean of log luminance ``[...]`` of each image, and whether there is any light (else it is 0).

    A pixel's weight is x / (x + ``DARK``) of its luminance x over the frame's mean: black ones have none, however dark
    the rest. Infinite and undefined pixels count as black.
    """
    luminance = sum_channels(color * jnp.array([0.2126, 0.7152, 0.0722], color.dtype))[..., 0]
    luminance = jnp.where(jnp.isfinite(luminance), jnp.maximum(luminance, 0.0), 0.0)
    mean = jnp.mean(luminance, axis=(-2, -1), keepdims=True)
    lit = luminance > 0
    weight = jnp.where(lit, luminance / jnp.where(lit, luminance + DARK * mean, 1.0), 0.0)
    total = jnp.sum(weight * jnp.log(jnp.where(lit, luminance, 1.0)), axis=(-2, -1))
    weights = jnp.sum(weight, axis=(-2, -1))
    return total / jnp.where(weights > 0, weights, 1.0), weights > 0


_measure = jax.jit(log_luminance)


def clip_exposure(reference: Color) -> float:
    """``GREY`` over the log-mean of luminance of a clip's frames ``[T, H, W, 3]``, one number; 1 if all are black."""
    found = [(float(mean), bool(lit)) for mean, lit in map(_measure, reference)]
    means = [mean for mean, lit in found if lit]
    return GREY / math.exp(math.fsum(means) / len(means)) if means else 1.0


@pytree
class Meter:
    """The exposure of a stream so far.

    Attributes:
      log_mean: mean of ``log_luminance`` over the shot's rendered frames ``[...]``.
      count: how many ``[...]``; 0 since a cut: ``log_mean`` is still that of the shot before.
    """

    log_mean: Scalar
    count: Scalar


def start_meter(example: Frame) -> Meter:
    """Start a meter that has seen nothing: exposure 1."""
    zero = jnp.zeros(example.cut.shape, jnp.float32)
    return Meter(log_mean=zero + math.log(GREY), count=zero)


def read_meter(meter: Meter, frame: Frame) -> tuple[Meter, Scalar]:
    """Show ``frame`` to the meter; returns it and the frame's exposure, in which its own colour counts.

    A cut starts a new mean. Until the new shot has shown any light, the exposure stays what it was.
    """
    count = jnp.where(frame.cut, 0.0, meter.count)
    log_mean = meter.log_mean
    if frame.color is not None:
        measured, lit = log_luminance(jax.lax.stop_gradient(frame.color))
        total = count + lit
        log_mean = jnp.where(lit, (log_mean * count + measured) / jnp.maximum(total, 1.0), log_mean)
        count = total
    return Meter(log_mean=log_mean, count=count), GREY * jnp.exp(-log_mean)


@pytree
class Metered:
    """History of a ``metered`` method over frames without a recorded exposure.

    Attributes:
      meter: what exposure follows from.
      history: the method's own.
    """

    meter: Meter
    history: PyTree


def _assumed(example: Frame) -> Frame:
    """Give ``example`` an exposure, 1 where it has none: for what only depends on shapes."""
    if example.exposure is not None:
        return example
    return dataclasses.replace(example, exposure=jnp.ones(example.cut.shape, jnp.float32))


def metered(method: Method) -> Method:
    """Let ``method`` take frames without an exposure: it is metered from those rendered so far.

    Frames with an exposure are passed on as they are, and the history is the method's own.
    """
    if method.parts is not None:
        return _metered_parts(method, method.parts)

    def init(key, example):
        return method.init(key, _assumed(example))

    def start(example):
        if example.exposure is not None:
            return method.start(example)
        return Metered(meter=start_meter(example), history=method.start(_assumed(example)))

    def measuring(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            if frame.exposure is not None:
                return step(variables, history, frame, train=train)
            meter, exposure = read_meter(history.meter, frame)
            frame = dataclasses.replace(frame, exposure=exposure)
            inner, prediction = step(variables, history.history, frame, train=train)
            return Metered(meter=meter, history=inner), prediction

        return run

    steps = {"render_step": measuring(method.render_step), "extrapolate_step": measuring(method.extrapolate_step)}
    return method._replace(init=init, start=start, **steps)


def _metered_parts(method: Method, parts: Parts) -> Method:
    """Do the same for a method that is made of parts: its memory is ``Metered``."""

    def init(key, example):
        return method.init(key, _assumed(example))

    def start(example):
        if example.exposure is not None:
            return method.start(example)
        history = method.start(_assumed(example))
        return dataclasses.replace(history, memory=Metered(meter=start_meter(example), history=history.memory))

    def remember(memory, frame):
        if frame.exposure is not None:
            memory, notes = parts.remember(memory, frame)
            return memory, (notes, None)
        meter, exposure = read_meter(memory.meter, frame)
        inner, notes = parts.remember(memory.history, dataclasses.replace(frame, exposure=exposure))
        return Metered(meter=meter, history=inner), (notes, exposure)

    def observe(variables, notes, frame):
        notes, exposure = notes
        frame = frame if exposure is None else dataclasses.replace(frame, exposure=exposure)
        return parts.observe(variables, notes, frame)

    return from_parts(init, start, Parts(remember, observe, parts.show), method.info)


MapRadiance = Callable[[Callable[[Array], Array], PyTree], PyTree]
"""``(function, history) -> history`` with the function applied to each image of linear radiance in it."""


def _no_radiance(function: Callable[[Array], Array], history: PyTree) -> PyTree:
    return history


def exposed(method: Method, map_radiance: MapRadiance = _no_radiance) -> Method:
    """Let ``method``, which works on exposed colour, take radiance in any unit; ``metered`` where none is recorded.

    Colour is multiplied by the frame's exposure before the step, the image divided after it. Between the steps the
    history is scene radiance, so that it stays true when the exposure changes; the method sees it at the current
    frame's exposure. ``aux`` stays exposed and gets ``"exposure"``, what a target must be multiplied with.

    Args:
      method: its steps take linear colour of about the range of a display; its ``start`` holds no light.
      map_radiance: where its history holds linear colour; what is kept in another form keeps the exposure of its frame.
    """

    def scaled(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            up, down = frame.exposure, 1.0 / frame.exposure
            history = map_radiance(lambda image: expose(image, up), history)
            history, prediction = step(variables, history, _exposed_frame(frame), train=train)
            history = map_radiance(lambda image: expose(image, down), history)
            image, aux = expose(prediction.image, down), {**prediction.aux, "exposure": up}
            return history, dataclasses.replace(prediction, image=image, aux=aux)

        return run

    steps = {"render_step": scaled(method.render_step), "extrapolate_step": scaled(method.extrapolate_step)}
    return metered(method._replace(parts=None, **steps))


def _exposed_frame(frame: Frame) -> Frame:
    color = None if frame.color is None else expose(frame.color, frame.exposure)
    return dataclasses.replace(frame, color=color, exposure=jnp.ones_like(frame.exposure))


def exposed_parts(method: Method, map_memory: MapRadiance, map_shown: MapRadiance) -> Method:
    """``exposed`` of a method that is made of parts.

    Args:
      method: as for ``exposed``.
      map_memory: as ``map_radiance``, of the memory alone.
      map_shown: of what was shown.
    """
    parts = method.parts
    assert parts is not None

    def remember(memory, frame):
        up, down = frame.exposure, 1.0 / frame.exposure
        memory = map_memory(lambda image: expose(image, up), memory)
        memory, notes = parts.remember(memory, _exposed_frame(frame))
        return map_memory(lambda image: expose(image, down), memory), notes

    def observe(variables, notes, frame):
        return parts.observe(variables, notes, _exposed_frame(frame)), frame.exposure

    def show(variables, shown, seen, *, train):
        seen, up = seen
        shown = map_shown(lambda image: expose(image, up), shown)
        shown, prediction = parts.show(variables, shown, seen, train=train)
        shown = map_shown(lambda image: expose(image, 1.0 / up), shown)
        image, aux = expose(prediction.image, 1.0 / up), {**prediction.aux, "exposure": up}
        return shown, dataclasses.replace(prediction, image=image, aux=aux)

    return metered(from_parts(method.init, method.start, Parts(remember, observe, show), method.info))
