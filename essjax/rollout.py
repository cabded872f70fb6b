"""Unroll a method over a sequence: one ``lax.scan``, the same for training, evaluation and benchmarks."""

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax.frames import Frame, check_dtypes, check_shapes, require, select_time, without_color
from essjax.interfaces import Method, Parted, Parts, no_variables
from essjax.networks import compute_dtype
from essjax.typing import Array, Callable, PyTree, pytree

SS, ESS = "ss", "ess"


class Schedule(NamedTuple):
    """Which frames are rendered. Make one with ``every`` or ``alternate``.

    Attributes:
      kinds: ``kinds(length)`` is the tuple of "ss" and "ess", one per frame.
      period: after ``lead`` frames the kinds repeat with this period; that body is scanned.
      lead: frames stepped before the scan.
    """

    kinds: Callable[[int], tuple[str, ...]]
    period: int
    lead: int


def every() -> Schedule:
    """Every frame is rendered."""
    return Schedule(lambda length: (SS,) * length, 1, 0)


def alternate(phase: int = 0, *, period: int = 2) -> Schedule:
    """One frame in ``period`` is rendered: ``phase``, ``phase + period``, ... and frame 0, where any history begins.

    Period 2, the papers' alternation: phase 0 renders 0, 2, 4 ..., phase 1 renders 0, 1, 3, 5 ...

    Args:
      phase: 0 ... period - 1.
      period: at least 2; ``period - 1`` frames are extrapolated from each rendered one.

    Raises:
      ValueError: either is out of range.
    """
    if not (isinstance(period, int) and period >= 2):
        raise ValueError(f"period: expected a whole number of at least 2, got {period!r}. Rendering all is every().")
    if phase not in range(period):
        raise ValueError(f"phase: expected 0 to {period - 1} (period {period}), got {phase!r}.")

    def kinds(length: int) -> tuple[str, ...]:
        return tuple(SS if n == 0 or n % period == phase else ESS for n in range(length))

    return Schedule(kinds, period, phase)


@pytree
class Rollout:
    """The result of ``unroll``, time-major.

    Attributes:
      image: ``[T, ..., h, w, 3]``, frame n's image at index n whatever the method's latency.
      aux: kind -> pytree of the frames of that kind, in order: what ``keep`` kept.
      history: the history after the last frame.
      state: entry of the variables -> its new BatchNorm statistics, the mean over the steps that returned any.
    """

    image: Array
    aux: dict[str, PyTree]
    history: PyTree
    state: dict[str, PyTree]


def check_supported(method: Method, frames: Frame, kinds: Iterable[str]) -> None:
    """Raise a ValueError where a method lacks a buffer or cannot do one of ``kinds``.

    Frames must be float32 (16 bits belong to the networks, see ``stream``), with the same leading axes everywhere.
    """
    check_shapes(frames, "frames")
    check_dtypes(frames, "frames")
    require(frames, (*(("color",) if SS in kinds else ()), *sorted(method.info.requires)), method.info.name)
    if method.info.renders_all and ESS in kinds:
        raise ValueError(
            f"{method.info.name} cannot extrapolate: it needs the colour of every frame. Use schedule every()."
        )


def _step(method: Method, variables: PyTree, history: PyTree, frame: Frame, kind: str, train: bool):
    step = method.render_step if kind == SS else method.extrapolate_step
    return step(variables, history, frame if kind == SS else without_color(frame), train=train)


def unroll(
    method: Method,
    variables: PyTree,
    frames: Frame,
    schedule: Schedule,
    *,
    train: bool = False,
    keep: Callable[[dict], PyTree] = lambda aux: {},
    remat: bool = False,
    history: PyTree | None = None,
) -> Rollout:
    """Run ``method`` over ``frames`` (leaves ``[T, ...]``, colour in every frame).

    Args:
      method: the two steps.
      variables: from ``method.init``.
      frames: the colour of extrapolated frames is removed before the method sees them.
      schedule: ``every()`` or ``alternate(phase, period=...)``.
      train: passed to the steps.
      keep: chooses from each prediction's ``aux`` what to stack in time; nothing by default.
      remat: recompute the steps in the backward pass instead of storing their intermediates.
      history: what precedes frame 0, as ``Rollout.history`` of the frames before; None: ``method.start``.

    Raises:
      ValueError: a buffer is missing, or the schedule extrapolates and the method cannot.
    """
    length = frames.motion.shape[0]
    kinds = schedule.kinds(length)
    check_supported(method, frames, kinds)
    periods = max((length - schedule.lead) // schedule.period, 0)
    body_end = schedule.lead + periods * schedule.period
    history = method.start(select_time(frames, 0)) if history is None else history

    def run(history, frame, kind):
        def step(variables, history, frame):
            return _step(method, variables, history, frame, kind, train)

        history, prediction = (jax.checkpoint(step) if remat else step)(variables, history, frame)
        return history, (prediction.image, keep(prediction.aux), prediction.state)

    def run_all(history, frames, kinds):
        outputs = []
        for n, kind in enumerate(kinds):
            history, output = run(history, select_time(frames, n), kind)
            outputs.append(output)
        return history, _collect(outputs, kinds)

    # The scan stacks what a period collected, so the size of the program does not depend on the number of frames.
    lead, body, rest = (
        jax.tree.map(lambda leaf, part=part: leaf[part], frames)
        for part in (slice(schedule.lead), slice(schedule.lead, body_end), slice(body_end, None))
    )
    history, collected = run_all(history, lead, kinds[: schedule.lead])
    parts = [collected]
    if periods:
        body = jax.tree.map(lambda leaf: leaf.reshape(periods, schedule.period, *leaf.shape[1:]), body)
        body_kinds = kinds[schedule.lead : schedule.lead + schedule.period]
        if train and method.parts is not None:
            history, collected = _scan_parts(method.parts, variables, history, body, body_kinds, keep, remat)
        else:
            history, collected = jax.lax.scan(lambda history, chunk: run_all(history, chunk, body_kinds), history, body)
        parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), collected))
    history, collected = run_all(history, rest, kinds[body_end:])
    joined = _join([*parts, collected])

    images, shift = joined["image"][""], method.info.latency
    if shift:  # step n shows frame n - latency; the last frames repeat the last image
        images = jnp.concatenate([images[shift:], jnp.repeat(images[-1:], shift, axis=0)])
    # Each step started from the same old statistics, so their mean has seen every step alike.
    state = jax.tree.map(lambda leaf: leaf.mean(axis=0), joined["state"])
    return Rollout(image=images, aux=joined["aux"], history=history, state=state)


def _scan_parts(parts: Parts, variables: PyTree, history: Parted, body: Frame, kinds: tuple[str, ...], keep, remat):
    """Scan as ``unroll`` does in training, ``body`` ``[periods, frames of a period, ...]``: all frames are observed at
    once, so that the loop that gradients go through holds only what depends on earlier output.
    """

    def frame_of(frames: Frame, n: int) -> Frame:
        return frames if kinds[n] == SS else without_color(frames)

    def remember(memory, chunk):
        notes = []
        for n in range(len(kinds)):
            memory, note = parts.remember(memory, frame_of(select_time(chunk, n), n))
            notes.append(note)
        return memory, notes

    def show(shown, seen):
        outputs = []
        for each in seen:
            step = partial(parts.show, train=True)
            shown, prediction = (jax.checkpoint(step) if remat else step)(variables, shown, each)
            outputs.append((prediction.image, keep(prediction.aux), prediction.state))
        return shown, _collect(outputs, kinds)

    memory, notes = jax.lax.scan(remember, history.memory, body)
    frames = [frame_of(jax.tree.map(lambda leaf, n=n: leaf[:, n], body), n) for n in range(len(kinds))]
    seen = [parts.observe(variables, note, frame) for note, frame in zip(notes, frames, strict=True)]
    shown, collected = jax.lax.scan(show, history.shown, seen)
    return Parted(memory=memory, shown=shown), collected


Collected = dict[str, dict[str, PyTree]]
"""Results of frames in a row, leaves ``[frames, ...]``: "image" -> "" -> images, "aux" -> kind -> what was
kept, "state" -> entry -> statistics."""


def _collect(outputs: list[tuple], kinds: tuple[str, ...]) -> Collected:
    found: dict[str, dict[str, list]] = {"image": {}, "aux": {}, "state": {}}
    for kind, (image, kept, state) in zip(kinds, outputs, strict=True):
        for part, entries in (("image", {"": image}), ("aux", {kind: kept}), ("state", state)):
            for name, value in entries.items():
                found[part].setdefault(name, []).append(value)
    return {
        part: {name: jax.tree.map(lambda *leaves: jnp.stack(leaves), *values) for name, values in entries.items()}
        for part, entries in found.items()
    }


def _join(parts: list[Collected]) -> Collected:
    """Join parts that follow each other; not all have frames of every kind."""
    return {
        what: {
            name: jax.tree.map(
                lambda *leaves: jnp.concatenate(leaves), *(p[what][name] for p in parts if name in p[what])
            )
            for name in dict.fromkeys(name for part in parts for name in part[what])
        }
        for what in ("image", "aux", "state")
    }


def bake(method: Method, variables: PyTree) -> Method:
    """Build trained ``variables`` into ``method``, for streaming and shipping; its own variables are ``{}``.

    They become constants of the compiled step: what depends on them alone (rounding, layouts) is computed when it is
    compiled, and a call passes fewer arguments. The steps cannot be trained any more.
    """
    constants = jax.device_get(variables)

    def render_step(variables, history, frame, *, train=False):
        return method.render_step(constants, history, frame, train=train)

    def extrapolate_step(variables, history, frame, *, train=False):
        return method.extrapolate_step(constants, history, frame, train=train)

    return Method(no_variables, method.start, render_step, extrapolate_step, method.info)


def stream(
    method: Method,
    variables: PyTree,
    frames: Iterable[Frame],
    kinds: Iterable[str],
    *,
    dtype: str = "float32",
    compiler_options: Mapping | None = None,
) -> Iterator[Array]:
    """Yield the image of each frame in turn, as an application would make them: one compiled step per kind of frame.

    A later stream of the same method does not compile again. The history is donated: it stays where it is.

    Args:
      method: the two steps.
      variables: from ``method.init``.
      frames: one by one, ``[..., H, W, C]``; the colour of those that are extrapolated is not looked at.
      kinds: ``SS`` or ``ESS`` for each frame, as ``schedule.kinds(length)`` or ``itertools.cycle((SS, ESS))`` says.
      dtype: the networks' compute type, "float32", "bfloat16" or "float16"; inputs and outputs stay float32.
      compiler_options: for ``jax.jit``.

    Yields:
      ``[..., h, w, 3]``, not waited for. Step n's is frame ``n - method.info.latency``'s.

    Raises:
      ValueError: a buffer is missing, or a frame is extrapolated and the method cannot.
    """
    history = None
    for frame, kind in zip(frames, kinds):  # noqa: B905  the kinds may go on for ever
        if history is None:
            check_supported(method, frame, (kind,))
            history = jax.jit(method.start)(frame)
        step = stream_step(method, kind, dtype=dtype, compiler_options=compiler_options)
        history, image = step(variables, history, frame if kind == SS else without_color(frame))
        yield image


def stream_step(method: Method, kind: str, *, dtype: str = "float32", compiler_options: Mapping | None = None):
    """Return the jitted step of ``stream``: ``(variables, history, frame) -> (history, image)``, history donated."""
    return _stream_step(method, kind, dtype, tuple((compiler_options or {}).items()))


@lru_cache(maxsize=128)
def _stream_step(method: Method, kind: str, dtype: str, compiler_options: tuple) -> Callable:
    def step(variables, history, frame):
        with compute_dtype(dtype):
            history, prediction = _step(method, variables, history, frame, kind, train=False)
        return history, prediction.image

    return jax.jit(step, donate_argnums=1, compiler_options=dict(compiler_options))
