"""IFRNet as a method: what it gives its network; test_interpolation.py has which frame it shows when."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

from essjax.frames import select_time, without_color
from essjax.interfaces import Network
from essjax.methods import ifrnet
from tests.helpers import make_frames, random_image

B, H, W = 2, 5, 7


def _apply(variables, images, prior, train=False):
    """Which image is which and which jitter difference belongs to it, in one number per pixel."""
    weights = jnp.array([0.25, 0.75]).reshape(2, 1, 1, 1, 1)
    return {
        "image": jnp.sum(weights * (images + prior[..., :1, None, None] - 2.0 * prior[..., 1:, None, None]), axis=0)
    }, {}


def test_it_gives_the_network_both_frames_and_the_differences_of_jitter(monkeypatch):
    monkeypatch.setattr(sys.modules["essjax.methods._ifrnet"], "ifrnet_network", lambda width: Network(None, _apply))
    frames = make_frames(0, T=3, B=B, H=H, W=W)
    frames = dataclasses.replace(
        frames, color=frames.color + 20.0, jitter=random_image(2, 3, B, 2, low=-0.5, high=0.5)
    )  # bright, so that nothing is clamped at 0
    method, variables = ifrnet(), {"ifrnet": {}}

    @jax.jit
    def steps(frames):
        first, second, third = (select_time(frames, n) for n in range(3))
        history, _ = method.render_step(variables, method.start(first), first)
        history, shown = method.extrapolate_step(variables, history, without_color(second))
        return shown.image, method.render_step(variables, history, third)[1].image

    shown, image = steps(frames)
    first, second, third = (select_time(jax.tree.map(np.asarray, frames), n) for n in range(3))
    np.testing.assert_array_equal(shown, first.color)
    assert method.info.latency == 1 and method.info.predicts == {"ess"} and not method.info.requires
    expected = 0.0
    for weight, frame in ((0.25, first), (0.75, third)):
        difference = second.jitter - frame.jitter
        known = difference[:, 0] - 2.0 * difference[:, 1]
        expected += weight * (np.log1p(frame.color) + known[:, None, None, None])
    np.testing.assert_allclose(np.log1p(image), expected, rtol=1e-4)


def test_its_steps_fit_the_network():
    frames = make_frames(0, T=1, B=B, H=18, W=21)
    frame, method = select_time(frames, 0), ifrnet(width=8)
    variables = jax.eval_shape(method.init, jax.random.key(0), frame)
    history, prediction = jax.eval_shape(method.render_step, variables, method.start(frame), frame)
    assert prediction.image.shape == frame.color.shape and prediction.aux["flow"].shape == (2, B, 18, 21, 2)
    before = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), method.start(frame))
    assert before == jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), history)
