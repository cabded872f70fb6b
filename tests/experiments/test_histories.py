"""Every variant's empty history can be donated: a streaming step takes its arrays over."""

import jax

from essjax.frames import select_time
from experiments.members import settings_of
from experiments.variants import VARIANTS
from tests.helpers import make_frames


def test_no_history_holds_an_array_twice_or_one_of_the_frame():
    """Of ``start`` outside jit, as a library user calls it: the same array in two places cannot be donated twice."""
    example = select_time(make_frames(0, T=1, B=1, H=8, W=8), 0)
    for name, variant in VARIANTS.items():
        program = jax.make_jaxpr(variant.method(settings_of(name, "smoke")).start)(example).jaxpr
        results = [id(result) for result in program.outvars]
        assert len(set(results)) == len(results), name
        assert not set(results) & {id(given) for given in program.invars}, name
