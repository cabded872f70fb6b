"""The classifier and the composition network against NumPy forward passes written from the figures."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from essjax.networks import classifier_network, composition_network
from tests.helpers import random_image

PRIOR = (-1.0, 0.5, 0.25, 1.0, 2.0, 3.0)
WIDTH, CHANNELS = 8, 5


def busy(variables, seed=0):
    """Noise everywhere; variances stay positive."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        noise = rng.normal(size=leaf.shape)
        return jnp.asarray(np.exp(0.3 * noise) if path[-1].key in ("var", "scale") else 0.3 * noise, jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, variables)


@pytest.fixture(scope="module")
def network():
    made = classifier_network(width=WIDTH, prior=PRIOR)
    return made, made.init(jax.random.key(0), jax.ShapeDtypeStruct((1, 16, 16, CHANNELS), jnp.float32))


def norm(x, params, stats):
    x = (x - np.asarray(stats["mean"])) / np.sqrt(np.asarray(stats["var"]) + 1e-5)
    return x * np.asarray(params["scale"]) + np.asarray(params["bias"])


def pixelwise(x, params):
    return x @ np.asarray(params["kernel"])[0, 0] + np.asarray(params["bias"])


def conv_norm(x, params, stats):
    return np.maximum(norm(pixelwise(x, params["Conv_0"]), params["BatchNorm_0"], stats["BatchNorm_0"]), 0)


def depthwise(x, params):
    kernel = np.asarray(params["kernel"])
    planes = [
        ndimage.correlate(x[..., c], kernel[:, :, 0, c], mode="constant") + float(params["bias"][c])
        for c in range(x.shape[-1])
    ]
    return np.stack(planes, axis=-1)


def to_space(x, block):
    """Channel (dy * block + dx) * C + c of (i, j) goes to (i * block + dy, j * block + dx)."""
    height, width, channels = x.shape
    result = np.zeros((height * block, width * block, channels // block**2), x.dtype)
    for dy in range(block):
        for dx in range(block):
            first = (dy * block + dx) * result.shape[-1]
            result[dy::block, dx::block] = x[..., first : first + result.shape[-1]]
    return result


def forward(image, variables):
    """Figure 1 in NumPy, evaluation mode, one image ``[H, W, C]`` with sizes that need padding."""
    params, stats = variables["params"], variables["batch_stats"]
    height, width = image.shape[:2]
    x = np.pad(image, [(0, -height % 16), (0, -width % 16), (0, 0)], mode="edge")
    x = np.concatenate([x[dy::2, dx::2] for dy in (0, 1) for dx in (0, 1)], axis=-1)
    merged = []
    for scale in range(4):
        if scale:
            x = np.max([x[dy::2, dx::2] for dy in (0, 1) for dx in (0, 1)], axis=0)
        block, block_stats = params[f"Bottleneck_{scale}"], stats[f"Bottleneck_{scale}"]
        x = conv_norm(x, block["ConvNorm_0"], block_stats["ConvNorm_0"])
        x = depthwise(x, block["Conv_0"])
        x = conv_norm(x, block["ConvNorm_1"], block_stats["ConvNorm_1"])
        assert x.shape[-1] == WIDTH * 2**scale
        half = x.shape[-1] // 2
        part, x = (x, x) if scale == 3 else (x[..., :half], x[..., half:])
        merged.append(to_space(part, 2**scale))
    assert [part.shape[-1] for part in merged] == [WIDTH // 2, WIDTH // 4, WIDTH // 8, WIDTH // 8]
    x = np.concatenate(merged, axis=-1)
    for k in range(3):
        x = conv_norm(x, params[f"ConvNorm_{k}"], stats[f"ConvNorm_{k}"])
    x = norm(pixelwise(x, params["Conv_0"]), params["BatchNorm_0"], stats["BatchNorm_0"])
    grid = np.meshgrid(*((np.arange(2 * n) + 0.5) / 2 - 0.5 for n in x.shape[:2]), indexing="ij")
    large = np.stack([ndimage.map_coordinates(x[..., c], grid, order=1, mode="nearest") for c in range(6)], axis=-1)
    return large[:height, :width]


def test_the_classifier_equals_numpy(network):
    made, variables = network
    variables = busy(variables)
    image = random_image(1, 2, 27, 38, CHANNELS, low=-1.0, high=1.0)
    got, state = jax.jit(made.apply)(variables, image)
    assert state == {} and got.shape == (2, 27, 38, 6)
    for b in range(2):
        np.testing.assert_allclose(got[b], forward(np.asarray(image[b]), variables), rtol=1e-3, atol=1e-3)


def test_before_training_the_logits_are_near_the_prior(network):
    made, variables = network
    image = random_image(2, 1, 16, 16, CHANNELS)
    logits, state = jax.jit(partial(made.apply, train=True))(variables, image)
    np.testing.assert_allclose(logits.mean(axis=(0, 1, 2)), PRIOR, atol=0.1)
    assert 0.05 < float(logits.std(axis=(0, 1, 2)).max()) < 0.4
    assert set(state) == {"batch_stats"}


def test_size_at_the_papers_width():
    """By hand: per scale 1x1 in -> n, 9 n, n -> n; then 3 x 32 x 32, 32 x 6; biases, and two numbers per BatchNorm."""
    variables = jax.eval_shape(
        classifier_network().init, jax.random.key(0), jax.ShapeDtypeStruct((1, 16, 16, 20), jnp.float32)
    )
    expected = 0
    for inputs, n in ((80, 32), (16, 64), (32, 128), (64, 256)):
        expected += (inputs + 1) * n + 10 * n + (n + 1) * n + 2 * 2 * n
    expected += 3 * (33 * 32 + 2 * 32) + 33 * 6 + 2 * 6
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(variables["params"])) == expected == 122_354


def test_the_composition_network_equals_numpy_and_starts_at_zero():
    made = composition_network(width=16)
    image = random_image(3, 2, 5, 7, 4)
    variables = made.init(jax.random.key(1), image)
    np.testing.assert_array_equal(made.apply(variables, image)[0], 0.0)
    variables = busy(variables, 2)
    params = variables["params"]
    hidden = np.maximum(pixelwise(np.asarray(image), params["Conv_0"]), 0)
    assert hidden.shape[-1] == 16
    np.testing.assert_allclose(made.apply(variables, image)[0], pixelwise(hidden, params["Conv_1"]), rtol=1e-4)


def test_errors():
    with pytest.raises(ValueError, match="classifier width: expected a multiple of 8 .*, got 12"):
        classifier_network(width=12)
    with pytest.raises(ValueError, match="prior: expected 6 logits, got 3"):
        classifier_network(width=8, prior=(0.0, 1.0, 2.0))
