"""PyTorch mirrors of the networks, with our weights, in channels-last memory."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from essjax.networks._fasset import MAX_WEIGHT, OUTPUT_GAIN
from essjax.networks._frnet import COST_OF_ROUGHNESS, COST_PER_PIXEL, OFFSETS, PATCH, SMOOTH, TEMPERATURE
from essjax.networks._nsrr import PREVIOUS, RGBD
from experiments.benchmark.peers import Peer
from experiments.benchmark.peers.layers import (
    Weights,
    bilinear_twice,
    chain,
    conv,
    conv_block,
    conv_norm,
    depth_to_space,
    gated,
    pad_to,
    replicated,
    weights_of,
)
from experiments.benchmark.peers.warps import backward_warp, nchw


def decode(features: list, p: Weights):
    """``networks._extrassnet.Decoder``: features finest first."""
    x = features[-1]
    for n, skip in enumerate(features[-2::-1]):
        wide = F.interpolate(conv(x, p[f"Conv_{n}"]), scale_factor=2, mode="nearest")
        x = conv_block(torch.cat([wide, skip], dim=1), p[f"ConvBlock_{n}"])
    return conv(x, p[f"Conv_{len(features) - 1}"])


def extrassnet(p: Weights, encoder: str) -> Callable:
    """Head of ``ExtraSSNet.render`` or ``extrapolate``."""

    def forward(x, conditions):
        height, width = x.shape[-2:]
        x, features = pad_to(x, 8), []
        for level in range(4):
            x = conv_block(F.avg_pool2d(x, 2) if level else x, p[encoder][f"ConvBlock_{level}"])
            x = x + (conditions.reshape(1, -1) @ p[encoder][f"conditions_{level}"]["kernel"])[..., None, None]
            features.append(x)
        return decode(features, p["decoder"])[..., :height, :width]

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
        return depth_to_space(x, block)[..., :height, :width]

    return forward


_OFFSETS = OFFSETS.tolist()  # torch.compile stumbles over NumPy


def _shifted(x, right: float, down: float):
    """``x`` read at a constant offset in half pixels, at most 3: slices of the padded image and their means."""
    for axis, offset in ((-2, down), (-1, right)):
        reach, whole = 4, math.floor(offset)
        padded = F.pad(x, (reach, reach, 0, 0) if axis == -1 else (0, 0, reach, reach), mode="replicate")
        near, far = (padded.narrow(axis, reach + whole + k, x.shape[axis]) for k in (0, 1))
        x = 0.5 * (near + far) if offset != whole else near
    return x


def _matched_flow(warped, roughness):
    """``networks._frnet.matched_flow`` of frames that are 1 and 3 frames old."""
    price = COST_PER_PIXEL * (1.0 + COST_OF_ROUGHNESS * (roughness - SMOOTH).clamp(min=0.0))
    costs = []
    for x, y in _OFFSETS:
        difference = _shifted(warped[:1], x, y) - _shifted(warped[1:], 3 * x, 3 * y)
        mean = difference.abs().mean(dim=1, keepdim=True)
        box = F.avg_pool2d(F.pad(mean, (PATCH // 2,) * 4, mode="replicate"), PATCH, stride=1)
        costs.append(box + price * math.hypot(x, y))
    weights = torch.softmax(-torch.cat(costs, dim=1) / TEMPERATURE, dim=1)
    offsets = torch.tensor(_OFFSETS, dtype=weights.dtype, device=weights.device)
    return F.conv2d(weights, offsets.T[:, :, None, None])


def frnet(p: Weights) -> Callable:
    """``FRNet.__call__``: the flow, then the features."""

    def forward(warped, roughness, ages):
        height, width = warped.shape[-2:]
        warped, roughness = pad_to(warped, 4), pad_to(roughness, 4)
        encoded, hints, matched, x = [], [roughness], [_matched_flow(warped, roughness)], warped
        for level in range(3):
            x = conv_block(F.avg_pool2d(x, 2) if level else x, p[f"levels_{level}"])
            encoded.append(x)
        for _ in range(2):
            hints.append(F.avg_pool2d(hints[-1], 2))
            matched.append(0.5 * F.avg_pool2d(matched[-1], 2))
        flows, coarser, features = torch.zeros_like(encoded[2][:, :2]), [], []
        for level in (2, 1, 0):
            if level < 2:
                flows, coarser = 2 * bilinear_twice(flows), [bilinear_twice(features[-1])]
            total = flows + torch.cat([matched[level], 3 * matched[level]])
            newest, older = backward_warp(encoded[level], total, "bilinear").split(1)
            x = torch.cat([newest, older, *coarser, total[:1], total[1:], hints[level]], dim=1)
            x = conv_block(x, p[f"decoders_{level}"])
            flows = flows + torch.cat(conv(x, p[f"to_flow_{level}"]).split(2, dim=1))
            features.append(conv(x, p[f"to_features_{level}"]))
        return (matched[0] + flows[:1])[..., :height, :width], *features

    return forward


def ifrnet(p: Weights) -> Callable:
    """``IFRNet.__call__``: the image, flows, mask, then the features."""

    def prelu(x, p):
        return F.prelu(x, p["slope"])

    def interlaced(x, p, side):
        y = x
        for n in (0, 2):
            y = prelu(conv(y, p[f"Conv_{n}"]), p[f"PReLU_{n}"])
            last = prelu(conv(y[:, -side:], p[f"Conv_{n + 1}"]), p[f"PReLU_{n + 1}"])
            y = torch.cat([y[:, :-side], last], dim=1)
        return prelu(x + conv(y, p["Conv_4"]), p["PReLU_4"])

    def decoder(x, p, side) -> tuple[torch.Tensor, Any]:
        x = interlaced(prelu(conv(x, p["Conv_0"]), p["PReLU_0"]), p["Interlaced_0"], side)
        refined = depth_to_space(conv(x, p["Conv_1"]), 2)
        return refined, depth_to_space(conv(x, p["Conv_2"]), 2) if "Conv_2" in p else None

    def both(refined):
        return torch.cat([refined[:, :2], refined[:, 2:4]])

    def forward(images, prior):
        height, width = images.shape[-2:]
        prior = prior.permute(2, 1, 0, 3)  # came as an image of one column: [2 images, 2, 1, 1]
        mean = images.mean()
        images = pad_to(images - mean, 16)
        x, encoded, side = images, [], p["keeping_0"]["bias"].shape[0]
        for level in range(4):
            x = prelu(conv(x, p[f"halving_{level}"], 2), p[f"slopes_{level}_0"])
            x = prelu(conv(x, p[f"keeping_{level}"]), p[f"slopes_{level}_1"])
            encoded.append(x)
        refined, guess = decoder(torch.cat(encoded[3].split(1), dim=1), p["decoders_3"], side)
        flow, features = both(refined), []
        for level in (2, 1, 0):
            features.append(guess)
            total = flow + prior / 2 ** (level + 1)
            warped = backward_warp(encoded[level], total, "bilinear").split(1)
            refined, following = decoder(
                torch.cat([guess, *warped, *total.split(1)], dim=1), p[f"decoders_{level}"], side
            )
            flow, guess = 2 * bilinear_twice(flow) + both(refined), following
        flow, mask = flow + prior, torch.sigmoid(refined[:, 4:5])
        earlier, later = backward_warp(images, flow, "bilinear").split(1)
        image = later + mask * (earlier - later) + refined[:, 5:] + mean
        return *(x[..., :height, :width] for x in (image, flow, mask)), *features

    return forward


def nsrr(p: Weights) -> Callable:
    """``NSRR.reconstruct``."""

    def forward(current, previous):
        height, width = current.shape[-2:]
        previous = previous.split(1)
        x = torch.cat([current[:, :RGBD], *(x[:, :RGBD] for x in previous)], dim=1)
        weights = p["reweighting"]
        weights = 5 * (torch.tanh(conv(chain(x, weights["Chain_0"]), weights["Conv_0"])) + 1)
        x = torch.cat([current, *(weights[:, k : k + 1] * previous[k] for k in range(PREVIOUS))], dim=1)
        unet = p["reconstruction"]
        fine = chain(pad_to(x, 4), unet["Chain_0"])
        middle = chain(F.avg_pool2d(fine, 2), unet["Chain_1"])
        coarse = chain(F.avg_pool2d(middle, 2), unet["Chain_2"])
        middle = chain(torch.cat([bilinear_twice(coarse), middle], dim=1), unet["Chain_3"])
        fine = chain(torch.cat([bilinear_twice(middle), fine], dim=1), unet["Chain_4"])
        return conv(fine, unet["Conv_0"])[..., :height, :width]

    return forward


def fasset(p: Weights, scale: float = 2) -> Callable:
    """``FASSET.render``."""

    def recurrent(hidden, x, p):
        update, reset = torch.sigmoid(conv(torch.cat([hidden, x], dim=1), p["Conv_0"])).chunk(2, dim=1)
        candidate = torch.tanh(conv(torch.cat([reset * hidden, x], dim=1), p["Conv_1"]))
        return hidden + update * (candidate - hidden)

    def encode(x, hidden, p):
        features = []
        for level, numbers in enumerate((range(3), range(3, 5), range(5, 7))):
            x = F.avg_pool2d(x, 2) if level else x
            for n in numbers:
                x = gated(x, p[f"GatedConv_{n}"])
            x = x if level else recurrent(hidden, x, p["ConvGRU_0"])
            features.append(x)
        return decode(features, p["Decoder_0"])

    def dense(x, p):
        return x @ p["kernel"] + p["bias"] if "bias" in p else x @ p["kernel"]

    def queried(x, jitter):
        height, width = x.shape[-2:]
        rows, columns = (torch.arange(round(n * scale), device=x.device, dtype=x.dtype) + 0.5 for n in (height, width))
        rows = 2 * (rows / scale - jitter[0, 1, 0, 0]) / height - 1
        columns = 2 * (columns / scale - jitter[0, 0, 0, 0]) / width - 1
        grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)[None]
        return F.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=False)

    def forward(frame, mask, gbuffers, past, hidden, local, jitter):
        height, width = mask.shape[-2:]
        where = jitter[:, :2, :1, :1].expand(-1, -1, height, width)
        inputs = torch.cat([frame, mask, gbuffers[:, 3:], past, where], dim=1)
        features = encode(pad_to(inputs, 4), pad_to(hidden, 4), p["frame_encoder"])[..., :height, :width]
        surface = conv(chain(gbuffers, p["gbuffer_encoder"]["Chain_0"]), p["gbuffer_encoder"]["Conv_0"])
        weights = p["reweighting"]
        weights = conv(chain(torch.cat([frame, gbuffers], dim=1), weights["Chain_0"]), weights["Conv_0"])
        weights = MAX_WEIGHT / 2 * (1 + torch.tanh(weights))
        latents = queried(torch.cat([weights[:, :1] * features, weights[:, 1:] * surface], dim=1), jitter)
        x, inr = torch.cat([latents, local], dim=1).permute(0, 2, 3, 1), p["inr"]
        x = dense(x, inr["Dense_0"]) + inr["pixel_size"]["kernel"][0] / scale
        x = dense(F.relu(dense(F.relu(x), inr["Dense_1"])), inr["Dense_2"])
        output = dense(F.relu(x), inr["Dense_3"]).permute(0, 3, 1, 2)
        return OUTPUT_GAIN * output[:, 1:], torch.tanh(output[:, :1])

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

    def back(output):
        first = output[0] if isinstance(output, tuple) else output
        return first.permute(0, 2, 3, 1).float().cpu().numpy()

    return Peer(make, back)


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
    "FRNet": _peer(frnet),
    "IFRNet": _peer(ifrnet),
    "NSRR": _peer(nsrr),
    "FASSET": _peer(fasset),
}
