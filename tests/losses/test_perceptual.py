import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.losses import perceptual, sum_of_means, vgg16_features
from essjax.losses.vgg import LAYERS
from tests.helpers import random_image

# Written out from torchvision's vgg16 (configuration D), not read from the code under test.
SHAPES = {
    "features.0": (64, 3), "features.2": (64, 64), "features.5": (128, 64), "features.7": (128, 128),
    "features.10": (256, 128), "features.12": (256, 256), "features.14": (256, 256),
}  # fmt: skip


@functools.cache
def weights():
    """Random weights of blocks 1 to 3 at VGG-16's real widths."""
    rng, tensors = np.random.default_rng(0), {}
    for name, (outputs, inputs) in SHAPES.items():
        tensors[f"{name}.weight"] = rng.normal(0, np.sqrt(2 / (9 * inputs)), (outputs, inputs, 3, 3)).astype(np.float32)
        tensors[f"{name}.bias"] = rng.normal(0, 0.1, outputs).astype(np.float32)
    return tensors


def save_safetensors(path, tensors):
    header, offset = {"__metadata__": {"format": "pt"}}, 0
    names = {np.float32: "F32", np.float16: "F16"}
    for name, tensor in tensors.items():
        span = [offset, offset + tensor.nbytes]
        header[name] = {"dtype": names[tensor.dtype.type], "shape": list(tensor.shape), "data_offsets": span}
        offset = span[1]
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(t.tobytes() for t in tensors.values()))
    return path


@pytest.fixture(scope="module")
def npz(tmp_path_factory):
    path = tmp_path_factory.mktemp("vgg") / "vgg16.npz"
    np.savez(path, **weights())
    return path


def convolve(image, weight, bias):
    """3x3, zero padding, one output pixel at a time: the oracle."""
    height, width, _ = image.shape
    padded = np.pad(image, [(1, 1), (1, 1), (0, 0)])
    result = np.zeros((height, width, len(bias)))
    for y in range(height):
        for x in range(width):
            result[y, x] = np.einsum("ijc,ocij->o", padded[y : y + 3, x : x + 3], weight) + bias
    return np.maximum(result, 0.0)


def normalised(image):
    linear = image / (1.0 + image)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (shown - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]


def test_first_blocks_match_numpy(npz):
    image = random_image(0, 6, 7, 3, high=3.0)  # odd width: the pool drops the last column, as torch's does
    first, second, third = jax.jit(vgg16_features(npz, layers=("relu1_1", "relu1_2", "relu2_1")))(image)
    tensors = {name: tensor.astype(np.float64) for name, tensor in weights().items()}
    expected = convolve(
        normalised(np.asarray(image, np.float64)), tensors["features.0.weight"], tensors["features.0.bias"]
    )
    np.testing.assert_allclose(first, expected, atol=2e-4)
    expected = convolve(expected, tensors["features.2.weight"], tensors["features.2.bias"])
    np.testing.assert_allclose(second, expected, atol=5e-4)
    pooled = expected[:, :6].reshape(3, 2, 3, 2, 64).max(axis=(1, 3))
    np.testing.assert_allclose(
        third, convolve(pooled, tensors["features.5.weight"], tensors["features.5.bias"]), atol=1e-3
    )


def test_shapes_and_leading_axes(npz):
    features = jax.jit(vgg16_features(npz, layers=("relu3_3", "relu1_2")))  # in the order asked for
    image = random_image(1, 2, 1, 16, 12, 3)
    deep, shallow = features(image)
    assert deep.shape == (2, 1, 4, 3, 256) and shallow.shape == (2, 1, 16, 12, 64)
    np.testing.assert_allclose(deep[1, 0], features(image[1, 0])[0], rtol=1e-4, atol=1e-4)


def test_weights_may_be_an_argument_of_a_jitted_function(npz):
    image = random_image(2, 8, 8, 3)
    features = vgg16_features(npz, layers=("relu2_2",))
    np.testing.assert_allclose(jax.jit(lambda f, x: f(x))(features, image)[0], features(image)[0], rtol=1e-4, atol=1e-4)


def test_safetensors_equal_npz_and_half_is_read(npz, tmp_path):
    image = random_image(3, 8, 8, 3)
    expected = vgg16_features(npz)(image)[0]
    full = save_safetensors(tmp_path / "full.safetensors", weights())
    np.testing.assert_array_equal(vgg16_features(full)(image)[0], expected)
    half = save_safetensors(tmp_path / "half.safetensors", {k: v.astype(np.float16) for k, v in weights().items()})
    np.testing.assert_allclose(vgg16_features(half)(image)[0], expected, atol=0.05)


def test_perceptual_is_the_squared_feature_difference():
    def features(image):
        return [image, 2.0 * image[..., ::2, ::2, :]]

    a, b = random_image(4, 1, 6, 8, 3), random_image(5, 1, 6, 8, 3)
    levels = perceptual(a, b, features)
    assert [level.shape for level in levels] == [(1, 6, 8, 3), (1, 3, 4, 3)]
    squared = (np.asarray(a) - np.asarray(b)) ** 2
    np.testing.assert_allclose(levels[0], squared, rtol=1e-5)
    np.testing.assert_allclose(levels[1], 4.0 * squared[:, ::2, ::2], rtol=1e-5)
    with pytest.raises(ValueError, match="expected the same shape"):
        perceptual(a, b[..., :1], features)


def test_gradient_is_finite_in_black_and_in_the_sun(npz):
    features = vgg16_features(npz)
    image = jnp.zeros((8, 8, 3)).at[:, :4].set(1e4)
    target = random_image(6, 8, 8, 3)
    gradient = jax.jit(jax.grad(lambda x: sum_of_means(perceptual(x, target, features))))(image)
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0


def test_messages(npz, tmp_path):
    with pytest.raises(ValueError, match=r"got .*nowhere.npz, which does not exist"):
        vgg16_features(tmp_path / "nowhere.npz")
    with pytest.raises(ValueError, match=r"expected names from relu1_1, .*; got conv9"):
        vgg16_features(npz, layers=("conv9",))
    with pytest.raises(ValueError, match=r"expected an entry features.17.weight of shape \(512, 256, 3, 3\)"):
        vgg16_features(npz, layers=("relu4_1",))
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, **{**weights(), "features.5.weight": np.zeros((128, 64, 5, 5), np.float32)})
    with pytest.raises(
        ValueError, match=r"features.5.weight in .*: expected shape \(128, 64, 3, 3\), got \(128, 64, 5, 5\)"
    ):
        vgg16_features(wrong)
    other = tmp_path / "vgg16.onnx"
    other.write_bytes(b"0")
    with pytest.raises(ValueError, match="VGG-16 weights: expected a file that ends in .safetensors, .npz.*vgg16.onnx"):
        vgg16_features(other)
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(save_safetensors(tmp_path / "x.safetensors", weights()).read_bytes()[:5000])
    with pytest.raises(ValueError, match="is damaged or not a .safetensors file"):
        vgg16_features(damaged)
    for name in ("text.npz", "text.safetensors"):
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1")
        with pytest.raises(ValueError, match="is damaged or not a"):
            vgg16_features(tmp_path / name)


def test_layers_are_vgg16s_thirteen_in_order():
    expected = [f"relu{b}_{c}" for b, n in ((1, 2), (2, 2), (3, 3), (4, 3), (5, 3)) for c in range(1, n + 1)]
    assert list(LAYERS) == expected
    assert list(LAYERS) == sorted(LAYERS)  # parameters are walked in the order jax keeps dictionaries in
