"""PyTorch mirrors of ExtraSSNet, ExtraNet and DLCTUS, with our weights, in channels-last memory."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from experiments.benchmark.peers import Peer
from experiments.benchmark.peers.warps import nchw

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


def pad_to(x, multiple: int):
    """Repeat the last row and column."""
    return F.pad(x, (0, -x.shape[-1] % multiple, 0, -x.shape[-2] % multiple), mode="replicate")


def extrassnet(p: Weights, encoder: str) -> Callable:
    """Head of ``ExtraSSNet.render`` or ``extrapolate``."""

    def forward(x):
        height, width = x.shape[-2:]
        x, features = pad_to(x, 8), []
        for level in range(4):
            x = conv_block(F.avg_pool2d(x, 2) if level else x, p[encoder][f"ConvBlock_{level}"])
            features.append(x)
        decoder = p["decoder"]
        for n, level in enumerate((2, 1, 0)):
            wide = F.interpolate(conv(x, decoder[f"Conv_{n}"]), scale_factor=2, mode="nearest")
            x = conv_block(torch.cat([wide, features[level]], dim=1), decoder[f"ConvBlock_{n}"])
        return conv(x, decoder["Conv_3"])[..., :height, :width]

    return forward


def extranet(p: Weights) -> Callable:
    """``ExtraNet.__call__``; history ``[3, C, H, W]``, newest first."""

    def down(x, p):
        for n, stride in enumerate((2, 1, 1)):
            x = gated(x, p[f"GatedConv_{n}"], stride)
        return x

    def up(x, skip, p):
        x = torch.cat([skip, F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)], dim=1)
        return conv_norm(conv_norm(x, p["ConvNorm_0"]), p["ConvNorm_1"])

    def forward(warped, mask, features, history):
        height, width = warped.shape[-2:]
        warped, mask, features, history = (pad_to(x, 8) for x in (warped, mask, features, history))
        first = gated(torch.cat([warped, warped * mask, features], dim=1), p["conv1"])
        first = gated(first, p["conv2"])
        second = down(first, p["down1"])
        third = down(second, p["down2"])
        bottom = down(third, p["down3"])
        encoded = history
        for n in range(9):
            encoded = conv_norm(encoded, p["history_encoder"][f"ConvNorm_{n}"], 1 if n % 3 else 2)
        frames = encoded.flip(0).reshape(1, -1, *encoded.shape[-2:])  # oldest first
        bottom = torch.cat([bottom, gated(frames, p["history_gate"])], dim=1)
        x = up(bottom, third, p["up1"])
        x = up(up(x, second, p["up2"]), first, p["up3"])
        return (conv(x, p["head"]) + warped[:, :3])[..., :height, :width]

    return forward


def dlctus(p: Weights) -> Callable:
    """``DLCTUSNet.__call__``."""
    block = p["Conv_0"]["kernel"].shape[-1]

    def forward(x):
        height, width = x.shape[-2:]
        x = conv(pad_to(x, block), p["Conv_0"], block, 0)
        for n in range(1, len(p), 2):
            x = x + replicated(F.relu(replicated(x, p[f"Conv_{n}"])), p[f"Conv_{n + 1}"])
        batch, channels, rows, columns = x.shape
        # Our channels are (row, column, output); pixel_shuffle's would be (output, row, column).
        x = x.reshape(batch, block, block, -1, rows, columns).permute(0, 3, 4, 1, 5, 2)
        return x.reshape(batch, -1, rows * block, columns * block)[..., :height, :width]

    return forward


def _peer(build: Callable[[Weights], Callable]) -> Peer:
    def make(arguments):
        variables, *inputs = arguments
        weights = weights_of(variables)
        images = [nchw(np.asarray(x).reshape(-1, *x.shape[-3:])) for x in inputs]
        flat, rebuild = _flatten(weights)

        def forward(*tensors):
            return build(rebuild(tensors[len(images) :]))(*tensors[: len(images)])

        return forward, (*images, *flat)

    return Peer(make, lambda output: output.permute(0, 2, 3, 1).float().cpu().numpy())


def _flatten(tree: Weights) -> tuple[list[torch.Tensor], Callable[[tuple], Weights]]:
    """Leaves, and what puts others in their places: weights are moved to a device and a type like inputs."""
    leaves: list[torch.Tensor] = []

    def number(node):
        if isinstance(node, dict):
            return {name: number(value) for name, value in node.items()}
        leaves.append(node)
        return len(leaves) - 1

    numbers = number(tree)

    def rebuild(tensors):
        def fill(node):
            return {k: fill(v) for k, v in node.items()} if isinstance(node, dict) else tensors[node]

        return fill(numbers)

    return leaves, rebuild


PEERS = {
    "ExtraSSNet SS": _peer(lambda p: extrassnet(p, "encoder_ss")),
    "ExtraSSNet ESS": _peer(lambda p: extrassnet(p, "encoder_ess")),
    "ExtraNet": _peer(extranet),
    "DLCTUS": _peer(dlctus),
}
