"""IFRNet as a method; which frame it shows when is tested with ``interpolator`` (test_interpolation.py)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import expm1, log1p
from essjax.frames import select_time, without_color
from essjax.methods import ifrnet
from essjax.networks import ifrnet as ifrnet_network
from tests.helpers import make_frames, random_image

B, H, W = 2, 18, 21
METHOD = ifrnet(width=8)


@jax.jit
def middle(variables, frames):
    """The image of the second of three frames."""
    first, second, third = (select_time(frames, n) for n in range(3))
    history, _ = METHOD.render_step(variables, METHOD.start(first), first)
    history, shown = METHOD.extrapolate_step(variables, history, without_color(second))
    return shown.image, METHOD.render_step(variables, history, third)[1].image


def test_it_gives_the_network_both_frames_and_the_differences_of_jitter():
    frames, others = make_frames(0, T=3, B=B, H=H, W=W), make_frames(1, T=3, B=B, H=H, W=W)
    frames = dataclasses.replace(frames, jitter=random_image(2, 3, B, 2, low=-0.5, high=0.5))
    rng = np.random.default_rng(0)
    variables = METHOD.init(jax.random.key(0), select_time(frames, 0))
    variables = jax.tree.map(lambda v: v + jnp.asarray(0.05 * rng.normal(size=v.shape), jnp.float32), variables)
    first, image = middle(variables, frames)
    np.testing.assert_array_equal(first, frames.color[0])
    images = log1p(frames.color[jnp.array([0, 2])])
    prior = jnp.stack([frames.jitter[1] - frames.jitter[0], frames.jitter[1] - frames.jitter[2]])
    run = jax.jit(lambda *inputs: ifrnet_network(8).apply(*inputs)[0]["image"])
    np.testing.assert_allclose(log1p(image), log1p(expm1(run(variables["ifrnet"], images, prior))), atol=1e-4)
    apart = jnp.abs(log1p(image) - log1p(expm1(run(variables["ifrnet"], images[::-1], prior))))
    assert float(apart.max()) > 0.01
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    np.testing.assert_allclose(middle(variables, mixed)[1][0], image[0], rtol=1e-4, atol=1e-4)
