"""Methods by name: ``make("extrass", width=32)`` calls the factory, and a method says how it was made."""

import functools
import inspect
from typing import Any, ParamSpec

import numpy as np

from essjax.interfaces import Method, Recipe
from essjax.typing import Callable

FACTORIES: dict[str, Callable[..., Method]] = {}
"""Each factory of ``essjax.methods`` by name."""
_P = ParamSpec("_P")


def registered(factory: Callable[_P, Method]) -> Callable[_P, Method]:
    """Add a factory to ``FACTORIES``; its methods carry their ``Recipe``."""
    signature = inspect.signature(factory)

    @functools.wraps(factory)
    def make(*args: _P.args, **kwargs: _P.kwargs) -> Method:
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        arguments = tuple((name, _plain(value)) for name, value in given.arguments.items())
        return factory(*args, **kwargs)._replace(recipe=Recipe(factory.__name__, arguments))

    FACTORIES[factory.__name__] = make
    return make


def _plain(value: Any) -> Any:
    """``value`` with tuples for lists and Python's numbers for NumPy's: a method can be the key of a dictionary."""
    if isinstance(value, list | tuple) and not isinstance(value, Method):
        return tuple(_plain(item) for item in value)
    return value.item() if isinstance(value, np.generic) else value


def make(name: str, /, **arguments: Any) -> Method:
    """Make a method by name.

    Args:
      name: of a factory in ``essjax.methods``; ``extrass-e`` is ``extrass_e``.
      arguments: its arguments; what is left out has its default.

    Raises:
      ValueError: there is no such factory or no such argument.
    """
    factory = FACTORIES.get(name.replace("-", "_"))
    if factory is None:
        raise ValueError(f"method: expected one of {', '.join(sorted(FACTORIES))}; got {name!r}.")
    known = list(inspect.signature(factory).parameters)
    unknown = [argument for argument in arguments if argument not in known]
    if unknown:
        raise ValueError(f"{name}: expected arguments among {', '.join(known) or 'none'}; got {', '.join(unknown)}.")
    return factory(**arguments)
