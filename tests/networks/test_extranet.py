"""ExtraNet against a plain NumPy evaluation that walks a published state dict by its own names, layer by layer."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.networks import extranet
from essjax.networks._extranet import ExtraNet, from_torch, input_shapes, torch_entries
from tests.helpers import random_image

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference" / "extranet_state_dict.json"


def published_shapes() -> dict[str, tuple[int, ...]]:
    """Keys and shapes of a published checkpoint, in its order."""
    shapes: dict[str, tuple[int, ...]] = {}

    def convolution(name, inputs, outputs, size=3):
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outputs, inputs, size, size), (outputs,)

    def norm(name, width):
        shapes.update({f"{name}.{entry}": (width,) for entry in ("weight", "bias", "running_mean", "running_var")})
        shapes[f"{name}.num_batches_tracked"] = ()

    def gated(name, inputs, outputs):
        convolution(f"{name}.conv_feature", inputs, outputs)
        convolution(f"{name}.conv_mask.0", inputs, 1)

    for level, inputs, outputs in ((1, 4, 24), (2, 24, 32), (3, 32, 32)):
        for n in range(3):
            convolution(f"convHis{level}.{3 * n}", outputs if n else inputs, outputs)
            norm(f"convHis{level}.{3 * n + 1}", outputs)
    gated("lowlevelGated", 96, 32)
    for n, inputs in ((1, 18), (2, 24)):
        gated(f"conv{n}", inputs, 24)
        norm(f"bn{n}", 24)
    for level, inputs, outputs in ((1, 24, 24), (2, 24, 32), (3, 32, 32)):
        gated(f"down{level}.downsample", inputs, inputs)
        for n in (1, 2):
            gated(f"down{level}.conv{n}", inputs if n == 1 else outputs, outputs)
            norm(f"down{level}.bn{n}", outputs)
    for level, inputs, outputs in ((1, 96, 32), (2, 56, 24), (3, 48, 24)):
        for n, (a, b) in enumerate(((inputs, inputs // 2), (inputs // 2, outputs))):
            convolution(f"up{level}.conv.double_conv.{3 * n}", a, b)
            norm(f"up{level}.conv.double_conv.{3 * n + 1}", b)
    convolution("outc", 24, 3, 1)
    return shapes


def state_dict(seed=0):
    """Random weights whose activations neither die nor explode; BatchNorm far from the identity."""
    rng, tensors = np.random.default_rng(seed), {}
    for name, shape in published_shapes().items():
        entry = name.rsplit(".", 1)[1]
        if len(shape) == 4:
            values = rng.normal(0, np.sqrt(2 / np.prod(shape[1:])), shape)
        elif entry == "running_var" or entry == "weight":
            values = rng.uniform(0.5, 2.0, shape)
        else:
            values = rng.normal(0, 0.3, shape)
        tensors[name] = np.asarray(values, np.int64 if entry == "num_batches_tracked" else np.float32)
    return tensors


class NumpyExtraNet:
    """Channels first, as the names' owner has it; keeps the output of every layer by name."""

    def __init__(self, tensors):
        self.tensors, self.seen = tensors, {}

    def convolve(self, x, name, stride=1):
        weight, bias = (np.asarray(self.tensors[f"{name}.{entry}"], np.float64) for entry in ("weight", "bias"))
        border = weight.shape[-1] // 2
        padded = np.pad(x, [(0, 0), (0, 0), (border, border), (border, border)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, weight.shape[2:], axis=(2, 3))
        return np.einsum("bchwij,ocij->bohw", windows[:, :, ::stride, ::stride], weight) + bias[:, None, None]

    def norm(self, x, name):
        scale, shift, mean, variance = (
            np.asarray(self.tensors[f"{name}.{entry}"], np.float64)[:, None, None]
            for entry in ("weight", "bias", "running_mean", "running_var")
        )
        return np.maximum((x - mean) / np.sqrt(variance + 1e-5) * scale + shift, 0.0)

    def gated(self, x, name, norm=None, stride=1):
        gate = 1.0 / (1.0 + np.exp(-self.convolve(x, f"{name}.conv_mask.0", stride)))
        x = self.convolve(x, f"{name}.conv_feature", stride) * gate
        self.seen[name] = x if norm is None else self.norm(x, norm)
        return self.seen[name]

    def plain(self, x, sequence, n, stride=1):
        x = self.norm(self.convolve(x, f"{sequence}.{3 * n}", stride), f"{sequence}.{3 * n + 1}")
        self.seen[f"{sequence}.{3 * n}"] = x
        return x

    def upsample(self, x):
        for axis in (2, 3):
            n = x.shape[axis]
            at = np.arange(2 * n) * (n - 1) / (2 * n - 1)
            low = np.minimum(np.floor(at).astype(int), n - 2)
            share = np.expand_dims(at - low, tuple(k for k in range(4) if k != axis))
            x = (1 - share) * np.take(x, low, axis) + share * np.take(x, low + 1, axis)
        return x

    def __call__(self, x, feature, mask, frames):
        """x 6, feature 6, mask 6 channels; ``frames``: oldest first, 4 channels each."""
        encoded = []
        for frame in frames:
            for level in (1, 2, 3):
                for n in range(3):
                    frame = self.plain(frame, f"convHis{level}", n, stride=1 if n else 2)
            encoded.append(frame)
        motion = self.gated(np.concatenate(encoded, axis=1), "lowlevelGated")
        skips = [self.gated(np.concatenate([x, x * mask, feature], axis=1), "conv1", "bn1")]
        skips[0] = self.gated(skips[0], "conv2", "bn2")
        for level in (1, 2, 3):
            down = self.gated(skips[-1], f"down{level}.downsample", stride=2)
            for n in (1, 2):
                down = self.gated(down, f"down{level}.conv{n}", f"down{level}.bn{n}")
            skips.append(down)
        result = np.concatenate([skips.pop(), motion], axis=1)
        for level in (1, 2, 3):
            result = np.concatenate([skips.pop(), self.upsample(result)], axis=1)
            for n in (0, 1):
                result = self.plain(result, f"up{level}.conv.double_conv", n)
        return self.convolve(result, "outc") + x[:, :3]


def layer_outputs(tree, path=()):
    """Our layer ("down1/GatedConv_0") -> its output, from linen's captured intermediates."""
    found = {}
    for key, value in tree.items():
        if key == "__call__":
            found["/".join(path)] = value[-1]
        else:
            found.update(layer_outputs(value, (*path, key)))
    return found


def first(image):
    return np.moveaxis(np.asarray(image, np.float64), -1, -3)


def test_every_layer_equals_numpy_on_an_odd_size():
    """11x21 is padded to 16x24 by repeating the border, and the output is cropped."""
    lead = (2, 11, 21)
    warped, mask = random_image(0, *lead, 6), jnp.round(random_image(1, *lead, 1, high=1.0))
    features, history = random_image(2, *lead, 6, low=-1.0, high=1.0), random_image(3, 3, *lead, 4)
    variables = from_torch(state_dict())

    @jax.jit
    def run(variables, *inputs):
        return ExtraNet().apply(variables, *inputs, capture_intermediates=True, mutable=["intermediates"])

    output, captured = run(variables, warped, mask, features, history)
    ours = layer_outputs(captured["intermediates"])

    oracle = NumpyExtraNet(state_dict())
    padded = [np.pad(first(x), [(0, 0)] * (x.ndim - 2) + [(0, 5), (0, 3)], mode="edge")
              for x in (warped, features, jnp.tile(mask, 6), history)]  # fmt: skip
    expected = oracle(*padded[:3], padded[3][::-1])
    np.testing.assert_allclose(first(output), expected[..., :11, :21], rtol=1e-3, atol=1e-3)
    compared = 0
    for name, value in ours.items():
        if name.split("/")[-1].startswith(("GatedConv", "ConvNorm")) or name in ("conv1", "conv2", "history_gate"):
            published = torch_entries(("params", *name.split("/"), "Conv_0", "kernel"))[0]
            theirs = oracle.seen[published.removesuffix(".weight").removesuffix(".conv_feature")]
            if name.startswith("history_encoder"):
                value = value[0]  # the newest frame is the oracle's last
            scale = np.abs(theirs).max()
            assert theirs.std() > 1e-3, name  # a dead layer would compare nothing
            np.testing.assert_allclose(first(value) / scale, theirs / scale, atol=2e-5, err_msg=name)
            compared += 1
    assert compared == 2 + 9 + 1 + 9 + 6
    fresh = run(extranet().init(jax.random.key(0), *input_shapes(1)), warped, mask, features, history)[0]
    np.testing.assert_allclose(fresh, warped[..., :3], rtol=1e-6)  # before training: the plain warp


def test_number_of_parameters_and_keys_of_the_published_network():
    shapes = jax.eval_shape(extranet().init, jax.random.key(0), *input_shapes(1))
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes["params"])) == 262_141
    used = {e for path, _ in jax.tree_util.tree_leaves_with_path(shapes) for e in torch_entries([k.key for k in path])}
    assert used | {k for k in published_shapes() if k.endswith("num_batches_tracked")} == set(published_shapes())
    if REFERENCE.is_file():
        published = json.loads(REFERENCE.read_text())["state_dict"]
        assert {name: list(shape) for name, shape in published_shapes().items()} == published
    small = jax.eval_shape(extranet(history=False).init, jax.random.key(0), *input_shapes(1, occlusion=False))
    assert small["params"]["conv1"]["Conv_0"]["kernel"].shape == (3, 3, 12, 25)
    assert "history_encoder" not in small["params"]


def test_messages():
    tensors = state_dict()
    prefixed = from_torch({f"module.{name}": tensor for name, tensor in tensors.items()})
    np.testing.assert_array_equal(prefixed["params"]["head"]["bias"], tensors["outc.bias"])
    with pytest.raises(ValueError, match="expected an entry bn2.running_mean; it is missing"):
        from_torch({name: tensor for name, tensor in tensors.items() if name != "bn2.running_mean"})
    with pytest.raises(ValueError, match="unknown entries up4.bias"):
        from_torch({**tensors, "up4.bias": np.zeros(3)})
    with pytest.raises(
        ValueError, match=r"outc.weight \(PyTorch's OIHW\): expected \(1, 1, 24, 3\) together as HWIO, got \(4"
    ):
        from_torch({**tensors, "outc.weight": np.zeros((4, 24, 1, 1))})
