"""PyTorch's warps with our conventions: motion in pixels, previous = current + motion, pixel centres at +0.5."""

import numpy as np
import torch
import torch.nn.functional as F

from essjax.warp import candidate_offsets
from essjax.warp.gbuffer_guided import SIGMA_DISTANCE, SIGMA_GUIDE, WINNERS
from experiments.benchmark.peers import Peer


def nchw(image: np.ndarray) -> torch.Tensor:
    """``[H, W, C]`` or ``[B, H, W, C]`` as ``[B, C, H, W]`` in channels-last memory."""
    tensor = torch.from_numpy(np.array(image))
    tensor = tensor[None] if tensor.ndim == 3 else tensor
    return tensor.permute(0, 3, 1, 2).contiguous(memory_format=torch.channels_last)


def _image(output: torch.Tensor) -> np.ndarray:
    return output[0].permute(1, 2, 0).float().cpu().numpy()


def _plain(output: torch.Tensor) -> np.ndarray:
    return output.float().cpu().numpy()


def _centers(height: int, width: int, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """X and y of pixel centres, ``[H, W]``."""
    y, x = (torch.arange(n, dtype=torch.float32, device=like.device) + 0.5 for n in (height, width))
    return x.expand(height, width), y[:, None].expand(height, width)


def backward_warp(image: torch.Tensor, motion: torch.Tensor, mode: str) -> torch.Tensor:
    """``grid_sample``: image ``[1, C, H, W]``, motion ``[1, 2, H, W]``."""
    height, width = image.shape[2:]
    x, y = _centers(height, width, image)
    grid = torch.stack([2 * (x + motion[:, 0]) / width - 1, 2 * (y + motion[:, 1]) / height - 1], dim=-1)
    return F.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=False)


def splat(image: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """Bilinear splat by ``index_add``, all ``[H, W, C]``."""
    height, width, channels = image.shape
    x, y = _centers(height, width, image)
    x, y = x + motion[..., 0] - 0.5, y + motion[..., 1] - 0.5
    left, top = torch.floor(x), torch.floor(y)
    total = torch.zeros(height * width, channels, device=image.device)
    for dy in (0, 1):
        for dx in (0, 1):
            column, row = left + dx, top + dy
            weight = (1 - (x - column).abs()) * (1 - (y - row).abs())
            weight = weight * ((column >= 0) & (column < width) & (row >= 0) & (row < height))
            index = row.clamp(0, height - 1).long() * width + column.clamp(0, width - 1).long()
            total = total.index_add(0, index.reshape(-1), weight.reshape(-1, 1) * image.reshape(-1, channels))
    return total.reshape(height, width, channels)


def guided_warp(radiance, guide_previous, guide, motion, offsets, sigma):
    """Warp in the stacked form: 33 candidates gathered, the four cheapest by ``topk``; all ``[H, W, C]``."""
    height, width, channels = guide.shape
    x, y = _centers(height, width, guide)
    x, y = x + motion[..., 0], y + motion[..., 1]
    column = torch.floor(x).long() + offsets[:, 0, None, None]
    row = torch.floor(y).long() + offsets[:, 1, None, None]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    pixel = row * width + column
    candidates = guide_previous.reshape(-1, channels)[pixel.reshape(-1)].reshape(*pixel.shape, channels)
    apart = ((guide - candidates) / sigma[:channels]).square().sum(-1)
    away = ((x - column - 0.5).square() + (y - row - 0.5).square()) / sigma[channels] ** 2
    cost = torch.where(inside, 0.5 * (apart + away), torch.inf)
    best, which = torch.topk(cost, WINNERS, dim=0, largest=False)
    weight = torch.softmax(-best, dim=0)
    winners = torch.gather(pixel, 0, which)
    values = radiance.reshape(-1, radiance.shape[-1])[winners.reshape(-1)].reshape(*winners.shape, -1)
    return (weight[..., None] * values).sum(0)


def _make_backward(mode: str):
    def make(arguments):
        image, motion = (nchw(a) for a in arguments)
        return lambda image, motion: backward_warp(image, motion, mode), (image, motion)

    return make


def _make_splat(arguments):
    return splat, tuple(torch.from_numpy(np.array(a)) for a in arguments)


def _make_guided(arguments):
    offsets = torch.from_numpy(candidate_offsets().astype(np.int64))
    sigma = torch.tensor([*SIGMA_GUIDE, SIGMA_DISTANCE])
    return guided_warp, (*(torch.from_numpy(np.array(a)) for a in arguments), offsets, sigma)


PEERS = {
    "bilinear": Peer(_make_backward("bilinear"), _image),
    "bicubic (a = -0.75)": Peer(_make_backward("bicubic"), _image),
    "splat": Peer(_make_splat, _plain),
    "guided": Peer(_make_guided, _plain, ties=0.001),
}
