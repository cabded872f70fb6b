"""The one abstraction: a method is two pure steps over a history, a network is init and apply.

The same two steps are scanned in training, in evaluation, streamed frame by frame, benchmarked and exported.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from essjax.frames import Frame, Prediction
from essjax.typing import Array, Flag, Key, PyTree


class Step(Protocol):
    """``(variables, history, frame, *, train) -> (history, Prediction)``."""

    def __call__(
        self, variables: PyTree, history: PyTree, frame: Frame, *, train: bool = False
    ) -> tuple[PyTree, Prediction]:
        """Take one frame, return the new history and the prediction."""
        ...


class Init(Protocol):
    """``(key, example) -> variables``."""

    def __call__(self, key: Key, example: Frame) -> PyTree:
        """Make the variables; {} for a heuristic."""
        ...


class Start(Protocol):
    """``(example) -> history``."""

    def __call__(self, example: Frame) -> PyTree:
        """Make the history that precedes ``example``."""
        ...


class MethodInfo(NamedTuple):
    """What a caller must know of a method.

    Attributes:
      name: as in ``--variant``.
      scale: output size over input size: 2 or 4 for supersamplers, 1 otherwise.
      latency: frames by which step n's image lags behind frame n (interpolation: 1).
      requires: names of the buffers its frames must have, besides colour and motion.
      predicts: the kinds of frames it is scored on: "ss" (rendered), "ess" (extrapolated).
      native: its input is native-resolution frames (TAA).
      renders_all: it must be given every frame rendered (schedule ``every``).
    """

    name: str
    scale: float
    latency: int = 0
    requires: frozenset[str] = frozenset()
    predicts: frozenset[str] = frozenset({"ss", "ess"})
    native: bool = False
    renders_all: bool = False


class Method(NamedTuple):
    """A pair of pure steps with what they need.

    Attributes:
      init: ``(key, example) -> variables``.
      start: ``(example) -> history``, a pytree of arrays.
      render_step: for a frame with colour (SS).
      extrapolate_step: for a frame without (ESS).
      info: see ``MethodInfo``.
    """

    init: Init
    start: Start
    render_step: Step
    extrapolate_step: Step
    info: MethodInfo


class Network(NamedTuple):
    """A neural network as two pure functions.

    Attributes:
      init: ``(key, *inputs) -> variables``, a plain dict.
      apply: ``(variables, *inputs, train=False) -> (output, state)``; ``state`` is {} without BatchNorm or ``train``.
    """

    init: Any
    apply: Any


def expand_flag(flag: Flag, ndim: int) -> Array:
    """A flag ``[...]`` with axes appended until it broadcasts against an array of ``ndim`` axes."""
    return flag.reshape(flag.shape + (1,) * (ndim - flag.ndim))


def reset_at_cut(cut: Flag, fresh: PyTree, history: PyTree) -> PyTree:
    """``fresh`` where ``cut``, else ``history``, leaf by leaf; ``cut`` has the leaves' leading axes."""
    return jax.tree.map(lambda new, old: jnp.where(expand_flag(cut, old.ndim), new, old), fresh, history)


def no_variables(key: Key, example: Frame) -> dict:
    """The ``init`` of a heuristic: nothing to learn."""
    del key, example
    return {}


def refuse_extrapolation(name: str) -> Step:
    """The ``extrapolate_step`` of a method that needs colour in every frame: raises a ValueError that says so."""

    def extrapolate_step(variables, history, frame, *, train=False):
        raise ValueError(f"{name} cannot extrapolate: it needs the colour of every frame. Use schedule every().")

    return extrapolate_step
