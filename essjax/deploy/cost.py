"""Parameters, multiply-adds and latency of a method, read off the traced steps: nothing is typed in, nothing is run."""

import math
from typing import Any, NamedTuple

import jax

from essjax.frames import example_frame, without_color
from essjax.interfaces import Method
from essjax.kernels import plain
from essjax.rollout import ESS, SS
from essjax.typing import PyTree


class Cost(NamedTuple):
    """The cost of one method.

    Attributes:
      parameters: trained numbers, BatchNorm statistics aside.
      multiply_adds: kind -> multiply-adds of all convolutions and matrix products in that step, per frame.
      latency: later frames that an image needs: 0 for causal methods, 1 for interpolation.
    """

    parameters: int
    multiply_adds: dict[str, int]
    latency: int


def _jaxprs(value: Any):
    """Yield the programs inside an equation's parameter."""
    if hasattr(value, "eqns"):
        yield value
    elif hasattr(value, "jaxpr"):
        yield value.jaxpr
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _jaxprs(item)


def _count(jaxpr: Any) -> int:
    total = 0
    for equation in jaxpr.eqns:
        name, parameters = equation.primitive.name, equation.params
        shapes = [variable.aval.shape for variable in equation.invars]
        if name == "conv_general_dilated":
            output = math.prod(equation.outvars[0].aval.shape)
            kernel_outputs = shapes[1][parameters["dimension_numbers"].rhs_spec[0]]
            total += output * math.prod(shapes[1]) // kernel_outputs
        elif name == "dot_general":
            contracted = parameters["dimension_numbers"][0][0]
            total += math.prod(equation.outvars[0].aval.shape) * math.prod(shapes[0][axis] for axis in contracted)
        else:
            inner = [_count(inner) for value in parameters.values() for inner in _jaxprs(value)]
            # A conditional runs one branch, a scan its body ``length`` times.
            total += max(inner, default=0) if name == "cond" else sum(inner) * parameters.get("length", 1)
    return total


def multiply_adds(function, *arguments: PyTree) -> int:
    """Multiply-adds of the convolutions and matrix products in ``function(*arguments)``; it is traced, not run.

    Element-wise work, gathers and warps are not counted, as in the papers, nor are channels that a GPU's program adds.
    The body of a ``while`` loop counts once.

    Args:
      function: anything that ``jax.jit`` takes.
      arguments: arrays or ``jax.ShapeDtypeStruct``.
    """
    with plain():  # in a new function: JAX may remember how it traced the old one
        return _count(jax.make_jaxpr(lambda *arguments: function(*arguments))(*arguments).jaxpr)


def _depends(function, arguments: tuple, which: int) -> bool:
    """Whether any output of the traced ``function`` can depend on argument ``which``."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    counts = [len(jax.tree.leaves(argument)) for argument in arguments]
    start = sum(counts[:which])
    wanted = {id(variable) for variable in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(variable) in wanted for variable in equation.outvars):
            wanted |= {id(variable) for variable in equation.invars}
    return any(id(variable) in wanted for variable in jaxpr.invars[start : start + counts[which]])


def method_cost(method: Method, width: int, height: int) -> Cost:
    """Count what ``method`` costs per frame of ``width`` x ``height`` input pixels (native ones for native methods)."""
    frame = example_frame(width, height)
    variables = jax.eval_shape(method.init, jax.random.key(0), frame)
    history = jax.eval_shape(method.start, frame)
    kinds = (SS,) if method.info.renders_all else (SS, ESS)
    counts, latency = {}, 0
    for kind in kinds:
        step = method.render_step if kind == SS else method.extrapolate_step
        given = frame if kind == SS else without_color(frame)

        def image(variables, history, frame, step=step):
            return step(variables, history, frame)[1].image

        counts[kind] = multiply_adds(image, variables, history, given)  # traces all of the step, history included
        # Step n shows frame n - latency; the image is late by that only if it reads what came with frame n.
        if method.info.latency and _depends(image, (variables, history, given), 2):
            latency = method.info.latency
    return Cost(count_parameters(variables), counts, latency)


def count_parameters(variables: PyTree) -> int:
    """Trained numbers: the sizes of all leaves under ``params``."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(variables)
    return sum(leaf.size for path, leaf in leaves if any(getattr(part, "key", None) == "params" for part in path))
