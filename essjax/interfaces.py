"""The one abstraction: a method is two pure steps over a history, a network is init and apply.

The same two steps are scanned in training, in evaluation, streamed frame by frame, benchmarked and exported.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from essjax.frames import Frame, Prediction, rendered_color, without_color
from essjax.sizes import Scale
from essjax.typing import Array, Callable, Flag, Key, PyTree, pytree


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
    """Facts that a caller must know of a method.

    Attributes:
      name: as in ``--variant``.
      scale: how much larger its output is than its input, see ``sizes.check_scale``; 1 where it supersamples nothing.
      latency: frames by which step n's image lags behind frame n (interpolation: 1).
      requires: names of the buffers its frames must have, besides colour and motion.
      predicts: the kinds of frames it is scored on: "ss" (rendered), "ess" (extrapolated).
      native: its input is native-resolution frames (TAA).
      renders_all: it must be given every frame rendered (schedule ``every``).
    """

    name: str
    scale: Scale
    latency: int = 0
    requires: frozenset[str] = frozenset()
    predicts: frozenset[str] = frozenset({"ss", "ess"})
    native: bool = False
    renders_all: bool = False


class Parts(NamedTuple):
    """The three parts of a method's steps; a rollout that trains takes the first two out of the loop that it trains.

    ``frame.color`` is None in what is not rendered. A step is one after the other, see ``from_parts``.

    Attributes:
      remember: ``(memory, frame) -> (memory, notes)``: what frames leave for later ones; cheap, no networks.
      observe: ``(variables, notes, frame) -> seen``: all else that does not depend on the method's earlier output, of
        one frame or, with a time axis in front of all leaves, of many at once.
      show: ``(variables, shown, seen, *, train) -> (shown, Prediction)``: what depends on it.
    """

    remember: Callable[[PyTree, Frame], tuple[PyTree, PyTree]]
    observe: Callable[[PyTree, PyTree, Frame], PyTree]
    show: Callable[..., tuple[PyTree, Prediction]]


@pytree
class Parted:
    """The history of a method that is made of ``Parts``.

    Attributes:
      memory: what ``remember`` carries on.
      shown: what ``show`` carries on.
    """

    memory: PyTree
    shown: PyTree


class Network(NamedTuple):
    """A neural network as two pure functions.

    Attributes:
      init: ``(key, *inputs) -> variables``, a plain dict.
      apply: ``(variables, *inputs, train=False) -> (output, state)``; ``state`` is {} without BatchNorm or ``train``.
    """

    init: Any
    apply: Any


class Recipe(NamedTuple):
    """How ``methods.make`` makes a method again.

    Attributes:
      name: of its factory.
      arguments: (name, value) of each of the factory's arguments, defaults too; a value may be a method.
    """

    name: str
    arguments: tuple[tuple[str, Any], ...]


class Method(NamedTuple):
    """A pair of pure steps with what they need.

    Attributes:
      init: ``(key, example) -> variables``.
      start: ``(example) -> history``, a pytree of arrays.
      render_step: for a frame with colour (SS).
      extrapolate_step: for a frame without (ESS).
      info: see ``MethodInfo``.
      parts: of the steps where they have such; None after a change to the steps alone.
      networks: (entry of the variables, network) of those that an objective applies by themselves.
      recipe: how it was made, where a factory of ``essjax.methods`` did.
    """

    init: Init
    start: Start
    render_step: Step
    extrapolate_step: Step
    info: MethodInfo
    parts: Parts | None = None
    networks: tuple[tuple[str, Network], ...] = ()
    recipe: Recipe | None = None

    def network(self, entry: str) -> Network:
        """Return the network whose variables are ``entry``; a ValueError if there is none."""
        if entry not in dict(self.networks):
            names = ", ".join(dict(self.networks)) or "none"
            raise ValueError(f"{self.info.name}: expected a method with a network {entry!r}; its networks: {names}.")
        return dict(self.networks)[entry]


def from_parts(init: Init, start: Start, parts: Parts, info: MethodInfo) -> Method:
    """Make a method whose steps are its parts, one after the other; ``start`` gives a ``Parted``."""

    def step(variables: PyTree, history: Parted, frame: Frame, train: bool) -> tuple[Parted, Prediction]:
        memory, notes = parts.remember(history.memory, frame)
        seen = parts.observe(variables, notes, frame)
        shown, prediction = parts.show(variables, history.shown, seen, train=train)
        return Parted(memory=memory, shown=shown), prediction

    def render_step(variables, history, frame, *, train=False):
        rendered_color(frame, info.name)
        return step(variables, history, frame, train)

    def extrapolate_step(variables, history, frame, *, train=False):
        return step(variables, history, without_color(frame), train)

    return Method(init, start, render_step, extrapolate_step, info, parts)


def expand_flag(flag: Flag, ndim: int) -> Array:
    """Append axes to a flag ``[...]`` until it broadcasts against an array of ``ndim`` axes."""
    return flag.reshape(flag.shape + (1,) * (ndim - flag.ndim))


def reset_at_cut(cut: Flag, fresh: PyTree, history: PyTree) -> PyTree:
    """``fresh`` where ``cut``, else ``history``, leaf by leaf; ``cut`` has the leaves' leading axes."""
    return jax.tree.map(lambda new, old: jnp.where(expand_flag(cut, old.ndim), new, old), fresh, history)


def no_variables(key: Key, example: Frame) -> dict:
    """Serve as the ``init`` of a heuristic: nothing to learn."""
    del key, example
    return {}


def refuse_extrapolation(name: str) -> Step:
    """Make the ``extrapolate_step`` of a method that needs colour in every frame: it raises a ValueError."""

    def extrapolate_step(variables, history, frame, *, train=False):
        raise ValueError(f"{name} cannot extrapolate: it needs the colour of every frame. Use schedule every().")

    return extrapolate_step
