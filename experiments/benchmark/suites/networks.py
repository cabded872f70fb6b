"""Forward passes of the networks, one frame, weights as arguments."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from essjax import networks
from essjax.deploy import count_parameters
from essjax.interfaces import Network
from essjax.networks import compute_dtype
from essjax.networks._extranet import input_shapes
from essjax.networks._extrassnet import CONDITIONS
from essjax.networks._fasset import LOCAL, PAST
from essjax.networks._nsrr import FEATURES, PREVIOUS
from experiments.benchmark import inputs, peers
from experiments.benchmark.measure import Case, measure
from experiments.benchmark.suites import Options, Row


class Forward(NamedTuple):
    """A forward pass.

    Attributes:
      name: with its sizes.
      network: init and apply.
      init: shapes that ``init`` takes.
      inputs: shapes that ``apply`` takes.
      method: of ``apply``; None: the default.
      pixels: of the output.
      output: which of several named ones is compared with those of other implementations.
    """

    name: str
    network: Network
    init: tuple
    inputs: tuple
    method: str | None
    pixels: int
    output: str | None = None


def _shape(*size: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(size, jnp.float32)


def forwards(width: int, height: int) -> list[Forward]:
    """Every network at the sizes at which a method runs it when frames are ``width`` x ``height`` and output twice."""
    low, high = (1, height, width), (1, 2 * height, 2 * width)
    half = (1, -(-height // 2), -(-width // 2))
    # ExtraNet is published at 720p: here 4/3 of the size.
    native = {"height": height * 4 // 3, "width": width * 4 // 3}
    names = {"low": f"{width}x{height}", "high": f"{2 * width}x{2 * height}"}
    conditions = _shape(1, CONDITIONS)
    extrass = _shape(*low, 31), _shape(*low, 37), conditions
    fasset = (*(_shape(*low, n) for n in (3, 1, 7, PAST, 24)), _shape(*high, LOCAL), _shape(1, 2))
    features = _shape(*low, 4), _shape(*high, FEATURES), _shape(PREVIOUS, *high, FEATURES)
    frnet = _shape(2, *half, 3), _shape(*half, 1), _shape(2, 1)
    ifrnet = _shape(2, *low, 3), _shape(2, 1, 2)
    extranet = input_shapes(1, height=native["height"], width=native["width"])
    extrassnet = networks.extrassnet()

    def forward(name, network, shapes, pixels, *, method=None, given=None, output=None):
        return Forward(name, network, shapes, shapes if given is None else given, method, pixels, output)

    sizes = width * height, 4 * width * height
    to_high = f"{names['low']} to {names['high']}"
    return [
        forward(f"ExtraSSNet SS, {to_high}", extrassnet, extrass, sizes[1], method="render", given=extrass[::2]),
        forward(f"ExtraSSNet ESS, {to_high}", extrassnet, extrass, sizes[1], method="extrapolate", given=extrass[1:]),
        forward(f"FRNet, {half[2]}x{half[1]}", networks.frnet(), frnet, sizes[0], output="flow"),
        forward(
            f"ExtraNet, {native['width']}x{native['height']}", networks.extranet(), extranet, extranet[1].size
        ),
        forward(f"DLCTUS, {names['high']}", networks.dlctus_network(), (_shape(*high, 8),), sizes[1]),
        forward(f"FASSET, {to_high}", networks.fasset(), fasset, sizes[1], method="render"),
        forward(f"IFRNet, {names['low']}", networks.ifrnet(), ifrnet, sizes[0], output="image"),
        forward(
            f"NSRR, {names['high']}", networks.nsrr(), features, sizes[1], method="reconstruct", given=features[1:]
        ),
    ]  # fmt: skip


def case(forward: Forward, dtype: str) -> Case:
    """Make a case of the forward pass on noise, products in ``dtype``; its first output is compared with others."""
    variables = jax.jit(lambda key: forward.network.init(key, *forward.init))(jax.random.key(0))
    noise = np.random.default_rng(0)  # heads start at zero, statistics at 0 and 1: a wrong peer would not be found out
    variables = jax.tree.map(lambda x: x + 0.02 * noise.standard_normal(x.shape, np.float32), variables)

    def apply(variables, *arguments):
        with compute_dtype(dtype):
            made = forward.network.apply(variables, *arguments, method=forward.method)[0]
        return made if forward.output is None else (made[forward.output], made)

    arguments = (variables, *inputs.random_like(forward.inputs))
    return Case(forward.name, apply, arguments, work={"pixels": forward.pixels})


def rows(options: Options) -> Iterator[Row]:
    """Each network in each compute type, then its peers."""
    for forward in forwards(options.width, options.height):
        if not options.wanted(forward.name):
            continue
        for dtype in options.dtypes:
            made = case(forward, dtype)
            parameters = count_parameters(made.arguments[0])
            yield {**measure(made, options.repetitions), "dtype": dtype, "parameters": parameters}
            if options.peers:
                for row in peers.rows(made, options.repetitions, dtype):
                    yield {**row, "dtype": dtype}
