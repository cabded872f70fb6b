"""IFRNet's network: the published layers, flows that start at the prior, odd sizes."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from essjax.networks import ifrnet

ENCODER = [(3, 24), (24, 24), (24, 36), (36, 36), (36, 54), (54, 54), (54, 72), (72, 72)]
DECODERS = [  # inputs, hidden channels, outputs; coarsest first
    (2 * 72, 144, 4 + 54),
    (3 * 54 + 4, 162, 4 + 36),
    (3 * 36 + 4, 108, 4 + 24),
    (3 * 24 + 4, 72, 4 + 1 + 3),
]


def published(upsampling):
    """Numbers of the small model: convolutions with bias and slopes; ``upsampling(inputs, outputs)`` of a decoder."""
    conv = lambda inputs, outputs: 9 * inputs * outputs + 2 * outputs
    count = sum(conv(*layer) for layer in ENCODER)
    for inputs, hidden, outputs in DECODERS:
        count += conv(inputs, hidden) + 3 * conv(hidden, hidden) + 2 * conv(24, 24) + upsampling(hidden, outputs)
    return count


def shapes(*lead, height, wide):
    return jax.ShapeDtypeStruct((2, *lead, height, wide, 3), jnp.float32), jax.ShapeDtypeStruct(
        (2, *lead, 2), "float32"
    )


def test_layers_are_the_published_ones():
    variables = jax.eval_shape(ifrnet().init, jax.random.key(0), *shapes(1, height=16, wide=16))
    count = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(variables))
    assert count == published(lambda inputs, outputs: 9 * inputs * 4 * outputs + 4 * outputs)
    # The paper says 2.8 million, with transposed convolutions of 4 x 4.
    assert round(published(lambda inputs, outputs: 16 * inputs * outputs + outputs) / 1e6, 1) == 2.8


def test_untrained_it_reads_both_images_at_the_wanted_samples():
    """A ramp sampled with three jitters, at an odd size: bilinear reads are exact, so their mean is the third image."""
    height, width, network = 19, 26, ifrnet(width=8)
    variables = network.init(jax.random.key(0), *shapes(2, height=height, wide=width))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    jitter = np.array([[[0.3, -0.4], [0.1, 0.2]], [[-0.2, 0.25], [0.45, -0.1]], [[0.05, 0.4], [-0.3, 0.3]]])
    ramp = lambda j: 0.1 * (x + j[..., 0, None, None]) + 0.2 * (y + j[..., 1, None, None])
    images = jnp.asarray(np.repeat(ramp(jitter)[..., None], 3, axis=-1), jnp.float32)
    prior = jnp.asarray(jitter[1] - jitter[[0, 2]], jnp.float32)
    output = jax.jit(lambda *inputs: network.apply(*inputs)[0])(variables, images[jnp.array([0, 2])], prior)
    np.testing.assert_allclose(output["image"][:, 1:-1, 1:-1], images[1, :, 1:-1, 1:-1], atol=1e-4)
    np.testing.assert_allclose(
        output["flow"], np.broadcast_to(prior[:, :, None, None], output["flow"].shape), atol=1e-6
    )
    np.testing.assert_allclose(output["mask"], 0.5)
    np.testing.assert_allclose(output["mean"][:, 0, 0, 0], np.mean(images[::2], axis=(0, 2, 3, 4)), rtol=1e-5)
    assert [f.shape for f in output["features"]] == [(2, 16, 16, 8), (2, 8, 8, 12), (2, 4, 4, 18)]
    encoded = jax.eval_shape(lambda v, i: network.apply(v, i, method="encode")[0], variables, images[1])
    assert [f.shape for f in encoded] == [*(f.shape for f in output["features"]), (2, 2, 2, 24)]
