"""Costs against hand calculation and against parameters counted from real variables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.deploy import method_cost, multiply_adds
from essjax.deploy.cost import count_parameters
from essjax.frames import select_time
from essjax.methods import extrass, extrass_e, taau, warp
from tests.helpers import make_frames


def struct(*shape):
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def test_convolutions_by_hand():
    def strided(x, kernel, grouped):
        layout = ("NHWC", "HWIO", "NHWC")
        y = jax.lax.conv_general_dilated(x, kernel, (2, 2), "SAME", dimension_numbers=layout)
        return jax.lax.conv_general_dilated(y, grouped, (1, 1), "SAME", dimension_numbers=layout, feature_group_count=4)

    count = multiply_adds(strided, struct(2, 6, 10, 3), struct(3, 5, 3, 4), struct(3, 3, 1, 8))
    assert count == 2 * 3 * 5 * 4 * (3 * 5 * 3) + 2 * 3 * 5 * 8 * (3 * 3 * 1)


def test_products_in_loops_branches_and_custom_gradients():
    def function(a, b):
        y, _ = jax.lax.scan(lambda carry, _: (carry @ b, None), a, None, length=3)
        return jax.jit(lambda y: jax.lax.cond(True, lambda z: z @ b, lambda z: (z @ b) @ b, y))(y)

    assert multiply_adds(function, struct(2, 5), struct(5, 5)) == (3 + 2) * 2 * 5 * 5
    batched = multiply_adds(lambda a, b: jnp.einsum("bij,bjk->bik", a, b), struct(7, 2, 3), struct(7, 3, 4))
    assert batched == 7 * 2 * 3 * 4


def test_a_method_scales_with_pixels_and_counts_its_own_variables():
    method = extrass(width=4, frnet_width=4)
    small, large = method_cost(method, 32, 24), method_cost(method, 64, 48)
    for kind, count in small.multiply_adds.items():  # but for the few of the network's conditions
        assert large.multiply_adds[kind] == pytest.approx(4 * count, rel=1e-4)
    variables = method.init(jax.random.key(0), select_time(make_frames(H=24, W=32), 0))
    assert small.parameters == sum(leaf.size for leaf in jax.tree.leaves(variables))
    assert small.latency == 0 and small.multiply_adds["ess"] > small.multiply_adds["ss"] > 0
    alone = method_cost(extrass_e(width=4), 32, 24)
    assert alone.multiply_adds["ss"] == 0 < alone.multiply_adds["ess"] < small.multiply_adds["ess"]


def test_heuristics_cost_no_multiply_adds():
    assert method_cost(warp(), 16, 12) == (0, {"ss": 0, "ess": 0}, 0)
    assert method_cost(taau(), 16, 12).parameters == 0 and set(method_cost(taau(), 16, 12).multiply_adds) == {"ss"}


@pytest.mark.parametrize("reads", [True, False])
def test_latency_is_found_in_the_program(reads):
    """A method that declares to be late is late only if its image reads the newest frame."""
    base = warp()

    def render_step(variables, history, frame, *, train=False):
        new, prediction = base.render_step(variables, history, frame)
        image = history.inner["color"] + (prediction.image if reads else 0.0)
        return new, prediction.__class__(image=image)

    late = base._replace(
        render_step=render_step, extrapolate_step=lambda v, h, f, *, train=False: (h, render(h)),
        info=base.info._replace(latency=1),
    )  # fmt: skip

    def render(history):
        from essjax.frames import Prediction

        return Prediction(image=history.inner["color"])

    assert method_cost(late, 16, 12).latency == int(reads)


def test_statistics_are_not_parameters():
    variables = {"net": {"params": {"kernel": np.zeros((3, 3, 2, 5))}, "batch_stats": {"mean": np.zeros(5)}}}
    assert count_parameters({**variables, "alpha": np.float32(1.0)}) == 90
