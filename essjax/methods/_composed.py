"""Two methods in a row: the first makes a colour for every frame, the second takes all of them for rendered.

ExtraSS Table 3 feeds extrapolating methods at output resolution and smooths what comes out: ``with_taa``.
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.exposure import metered
from essjax.frames import Frame, Prediction, frame_size, without_color
from essjax.interfaces import Method, MethodInfo, Step, no_variables
from essjax.methods._taau import taa
from essjax.methods.registry import registered
from essjax.methods.shots import continued
from essjax.sizes import describe_scale, output_size
from essjax.typing import Callable, Color


def _with_color(frame: Frame, color: Color) -> Frame:
    return dataclasses.replace(frame, color=color)


def composed(
    name: str,
    first: Method,
    second: Method,
    *,
    native: bool = False,
    extrapolates: bool = False,
    between: Callable[[Frame, Color], Frame] = _with_color,
) -> Method:
    """``second.render_step`` on every image of ``first``, or ``second``'s step of the frame's own kind.

    ``variables`` are those of both, side by side. ``aux`` is the second's, and the first's prediction as ``"first"``.
    Where the first lags behind (interpolation), the second sees the frame that the image belongs to. A ``second`` that
    takes all frames for rendered starts anew with the first one that was: it does not trust ``shots.unlit`` either.
    Both work at the exposure of the frame that came in.

    Args:
      name: of the whole.
      first: makes the colours.
      second: sees no frame without colour, unless ``between`` takes it away.
      native: both work on frames of the reference's resolution.
      extrapolates: extrapolated frames go to ``second.extrapolate_step``, with the colour that ``between`` gives them.
      between: ``(frame, the first's image) -> frame`` for the second; replace it where sizes change on the way.

    Raises:
      ValueError: ``first`` lags by more than one frame, or both supersample.
    """
    if 1 not in (first.info.scale, second.info.scale):
        raise ValueError(f"{name}: expected one method of scale 1, got {first.info.scale} and {second.info.scale}.")
    if first.info.latency > 1:
        raise ValueError(f"{name}: expected a first method that lags by at most 1 frame, got {first.info.latency}.")
    late = bool(first.info.latency)

    def blank(example: Frame) -> Frame:
        size = output_size(first.info.scale, frame_size(example))
        return between(example, jnp.zeros((*example.motion.shape[:-3], *size, 3), jnp.float32))

    def init(key, example):
        keys = jax.random.split(key)
        return {**first.init(keys[0], example), **second.init(keys[1], blank(example))}

    def start(example):
        history = {"first": first.start(example), "second": second.start(blank(example))}
        history["empty"] = jnp.ones(example.cut.shape, bool)  # nothing was rendered since the last cut
        if late:  # a copy: a streaming step donates its history
            history["frame"] = jax.tree.map(jnp.copy, without_color(continued(example, history["empty"])))
        return history

    def after(step: Step, then: Step, *, rendered: bool) -> Step:
        def run(variables, history, frame, *, train=False):
            earlier, made = step(variables, history["first"], frame, train=train)
            seen = continued(frame, history["empty"])
            shown = between(history["frame"] if late else seen, made.image)
            later, result = then(variables, history["second"], shown, train=train)
            empty = jnp.zeros_like(seen.cut) if rendered else seen.cut
            history = {"first": earlier, "second": later, "empty": empty}
            history = {**history, "frame": without_color(seen)} if late else history
            aux = {**result.aux, "first": made}
            return history, Prediction(image=result.image, aux=aux, state={**made.state, **result.state})

        return run

    info = MethodInfo(
        name,
        scale=second.info.scale if first.info.scale == 1 else first.info.scale,
        latency=first.info.latency + second.info.latency,
        requires=first.info.requires | second.info.requires,
        native=native,
        renders_all=first.info.renders_all,
    )
    extrapolate = second.extrapolate_step if extrapolates else second.render_step
    return metered(
        Method(
            init,
            start,
            after(first.render_step, second.render_step, rendered=True),
            after(first.extrapolate_step, extrapolate, rendered=False),
            info,
        )
    )


def settled(method: Method) -> Method:
    """Fix the variables that ``init`` gives ``method`` as constants: a heuristic with its default settings."""

    def with_own(step: Step) -> Step:
        def run(variables, history, frame, *, train=False):
            return step(method.init(jax.random.key(0), frame), history, frame, train=train)

        return run

    return method._replace(
        init=no_variables,
        render_step=with_own(method.render_step),
        extrapolate_step=with_own(method.extrapolate_step),
        parts=None,
    )


@registered
def with_taa(first: Method, *, alpha: float = 0.5, sigma: float = 0.5) -> Method:
    """``first`` on native-resolution frames, then temporal anti-aliasing of every frame (ExtraSS Table 3).

    ``variables`` are the first's, its name gets "+taa". Frames that it makes carry the jitter of their own G-buffers,
    as rendered ones do.

    Args:
      first: makes the colour of frames that are not rendered, at their size: ``extranet()``, ``ifrnet()``.
      alpha: see ``taa``.
      sigma: see ``taa``.

    Raises:
      ValueError: ``first`` changes the size.
    """
    if first.info.scale != 1:
        scale = describe_scale(first.info.scale)
        raise ValueError(f"with_taa: expected a method of scale 1, got {first.info.name} of {scale}.")
    return composed(f"{first.info.name}+taa", first, settled(taa(alpha=alpha, sigma=sigma)), native=True)
