"""Layers of the PyTorch mirrors, and our weights for them: NCHW in channels-last memory, named as ours."""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

Weights = dict[str, Any]


def weights_of(variables: dict) -> Weights:
    """Our variables as nested dicts of tensors: kernels OIHW, BatchNorm's statistics beside its scale and bias."""
    tree = _tensors(variables["params"])
    _merge(tree, _tensors(variables.get("batch_stats", {})))
    return tree


def _tensors(tree: dict) -> Weights:
    made: Weights = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            made[name] = _tensors(value)
        else:
            array = np.array(value)
            array = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array
            tensor = torch.from_numpy(np.ascontiguousarray(array))
            made[name] = tensor.contiguous(memory_format=torch.channels_last) if array.ndim == 4 else tensor
    return made


def _merge(tree: Weights, other: Weights) -> None:
    for name, value in other.items():
        if isinstance(value, dict):
            _merge(tree.setdefault(name, {}), value)
        else:
            tree[name] = value


def conv(x, p: Weights, stride: int = 1, padding: Any = None):
    """NCHW; as ``networks.blocks.conv``."""
    padding = (p["kernel"].shape[-1] - 1) // 2 if padding is None else padding
    return F.conv2d(x, p["kernel"], p["bias"], stride=stride, padding=padding)


def replicated(x, p: Weights):
    """3x3 with replicated borders."""
    return conv(F.pad(x, (1, 1, 1, 1), mode="replicate"), p, padding=0)


def batch_norm(x, p: Weights):
    """By running statistics."""
    return F.batch_norm(x, p["mean"], p["var"], p["scale"], p["bias"])


def conv_norm(x, p: Weights, stride: int = 1):
    """Convolution, BatchNorm, ReLU."""
    return F.relu(batch_norm(conv(x, p["Conv_0"], stride), p["BatchNorm_0"]))


def gated(x, p: Weights, stride: int = 1):
    """Lightweight gated convolution; BatchNorm and ReLU where it has them."""
    both = conv(x, p["Conv_0"], stride)
    x = torch.sigmoid(both[:, -1:]) * both[:, :-1]
    return F.relu(batch_norm(x, p["BatchNorm_0"])) if "BatchNorm_0" in p else x


def conv_block(x, p: Weights):
    """3x3 convolutions with leaky ReLUs."""
    for name in sorted(p):
        x = F.leaky_relu(conv(x, p[name]), 0.1)
    return x


def chain(x, p: Weights):
    """3x3 convolutions with ReLUs."""
    for name in sorted(p):
        x = F.relu(conv(x, p[name]))
    return x


def bilinear_twice(x):
    """Twice the size, pixel centres at +0.5."""
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def depth_to_space(x, block: int):
    """As ``warp.depth_to_space``: channels are (row, column, output); ``pixel_shuffle``'s are (output, row, column)."""
    batch, _, rows, columns = x.shape
    x = x.reshape(batch, block, block, -1, rows, columns).permute(0, 3, 4, 1, 5, 2)
    return x.reshape(batch, -1, rows * block, columns * block)


def pad_to(x, multiple: int):
    """Repeat the last row and column."""
    return F.pad(x, (0, -x.shape[-1] % multiple, 0, -x.shape[-2] % multiple), mode="replicate")
