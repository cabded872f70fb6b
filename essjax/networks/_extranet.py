"""ExtraNet: an in-painting U-Net of lightweight gated convolutions and a history encoder (Guo et al. 2021, section 4).

Layers, widths and the order of concatenations are those of the published checkpoints (262,141 parameters), which
``from_torch`` reads.
"""

from collections.abc import Mapping

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from essjax.interfaces import Network
from essjax.networks.blocks import (
    ConvNorm,
    GatedConv,
    bilinear_upsample_corners,
    crop,
    pad_to_multiple,
    zero_conv,
)
from essjax.networks.linen import from_linen
from essjax.typing import Array, Image, Mask, PyTree

FRAMES = 3
"""Rendered frames that the history encoder sees (section 4.4)."""
FEATURES = 6
"""Normal 3, depth, roughness, metallic."""
_LEVELS = 3


class Down(nn.Module):
    """Half the size: a gated convolution with stride 2, then two with BatchNorm and ReLU."""

    width: int

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """Return ``[B, H / 2, W / 2, width]``."""
        x = GatedConv(x.shape[-1], stride=2, norm=False)(x, train)
        for _ in range(2):
            x = GatedConv(self.width)(x, train)
        return x


class Up(nn.Module):
    """Twice the size, the skip in front, two plain convolutions: holes are filled on the way down."""

    width: int

    @nn.compact
    def __call__(self, x: Image, skip: Image, train: bool = False) -> Image:
        """Return ``[B, 2 H, 2 W, width]``."""
        x = jnp.concatenate([skip, bilinear_upsample_corners(x)], axis=-1)
        for width in (x.shape[-1] // 2, self.width):
            x = ConvNorm(width)(x, train)
        return x


class HistoryEncoder(nn.Module):
    """Nine convolutions, the first of every three with stride 2; shared by all frames (Fig. 8)."""

    @nn.compact
    def __call__(self, x: Image, train: bool = False) -> Image:
        """``[..., H, W, 4]`` (RGB, mask) to ``[..., H / 8, W / 8, 32]``."""
        for width in (24, 32, 32):
            for stride in (2, 1, 1):
                x = ConvNorm(width, stride=stride)(x, train)
        return x


class ExtraNet(nn.Module):
    """Both parts.

    Attributes:
      history: with the history encoder; False: Table 7's "w/o HE".
    """

    history: bool = True

    def setup(self):
        """Make the layers under the names that ``_LAYERS`` maps."""
        self.conv1, self.conv2 = GatedConv(24), GatedConv(24)
        self.down1, self.down2, self.down3 = Down(24), Down(32), Down(32)
        if self.history:
            self.history_encoder, self.history_gate = HistoryEncoder(), GatedConv(32, norm=False)
        self.up1, self.up2, self.up3 = Up(32), Up(24), Up(24)
        # Zero: before training the frame is the plainly warped one.
        self.head = zero_conv(3, 1)

    def __call__(self, warped: Image, mask: Mask, features: Image, history: Image, train: bool = False) -> Image:
        """Predict the demodulated frame, log1p.

        Args:
          warped: the newest rendered frame by plain motion and by occlusion motion, demodulated, log1p,
            ``[B, H, W, 6]`` (or 3: Table 7's "w/o OMV"); any size.
          mask: of the plain warp, 1 = valid, ``[B, H, W, 1]``.
          features: of the new frame, ``[B, H, W, 6]``: normal, depth, roughness, metallic.
          history: the three latest rendered frames by plain motion (demodulated, log1p) with their masks, newest first,
            ``[3, B, H, W, 4]``.
          train: BatchNorm by the batch's statistics.

        Returns:
          ``[B, H, W, 3]``.
        """
        height, width = warped.shape[-3:-1]
        warped, mask, features, history = (pad_to_multiple(x, 2**_LEVELS) for x in (warped, mask, features, history))
        first = self.conv1(jnp.concatenate([warped, warped * mask, features], axis=-1), train)
        first = self.conv2(first, train)
        second = self.down1(first, train)
        third = self.down2(second, train)
        bottom = self.down3(third, train)
        if self.history:
            encoded = self.history_encoder(history, train)
            frames = jnp.concatenate(list(encoded[::-1]), axis=-1)  # oldest first
            bottom = jnp.concatenate([bottom, self.history_gate(frames, train)], axis=-1)
        x = self.up1(bottom, third, train)
        x = self.up2(x, second, train)
        x = self.up3(x, first, train)
        return crop(self.head(x) + warped[..., :3], height, width)


def extranet(*, history: bool = True) -> Network:
    """ExtraNet as a ``Network``: ``(warped, mask, features, history) -> frame``, see ``ExtraNet.__call__``."""
    return from_linen(ExtraNet(history))


def input_shapes(*lead: int, height: int = 8, width: int = 8, occlusion: bool = True) -> tuple:
    """``jax.ShapeDtypeStruct`` of the network's inputs, for ``init``."""
    size = (*lead, height, width)
    shapes = (*size, 6 if occlusion else 3), (*size, 1), (*size, FEATURES), (FRAMES, *size, 4)
    return tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)


def _layers() -> dict[str, tuple[tuple[str, ...], str]]:
    """Our layer -> PyTorch's names of its convolution (feature and mask, if gated) and of its BatchNorm ("": none)."""

    def gated(name: str) -> tuple[str, str]:
        return f"{name}.conv_feature", f"{name}.conv_mask.0"

    layers = {
        "conv1": (gated("conv1"), "bn1"),
        "conv2": (gated("conv2"), "bn2"),
        "history_gate": (gated("lowlevelGated"), ""),
        "head": (("outc",), ""),
    }
    for k in range(1, _LEVELS + 1):
        layers[f"down{k}/GatedConv_0"] = (gated(f"down{k}.downsample"), "")
        for n in (1, 2):
            layers[f"down{k}/GatedConv_{n}"] = (gated(f"down{k}.conv{n}"), f"down{k}.bn{n}")
        for n in (0, 1):
            name = f"up{k}.conv.double_conv"
            layers[f"up{k}/ConvNorm_{n}"] = ((f"{name}.{3 * n}",), f"{name}.{3 * n + 1}")
        for n in (0, 1, 2):
            layer = f"history_encoder/ConvNorm_{3 * (k - 1) + n}"
            layers[layer] = ((f"convHis{k}.{3 * n}",), f"convHis{k}.{3 * n + 1}")
    return layers


_CONVOLUTION = {"kernel": "weight", "bias": "bias"}
_BATCH_NORM = {"scale": "weight", "bias": "bias", "mean": "running_mean", "var": "running_var"}


def torch_entries(path: tuple[str, ...]) -> list[str]:
    """Name the state dict's entries that make one of our variables.

    Args:
      path: its keys, for example ``("params", "conv1", "Conv_0", "kernel")``.

    Returns:
      One name, or two for a gated convolution: its feature's and its mask's, side by side in our last axis.
    """
    layer = "/".join(key for key in path[1:-1] if key not in ("Conv_0", "BatchNorm_0"))
    convolutions, norm = _layers()[layer]
    if "BatchNorm_0" in path:
        return [f"{norm}.{_BATCH_NORM[path[-1]]}"]
    return [f"{name}.{_CONVOLUTION[path[-1]]}" for name in convolutions]


def from_torch(tensors: Mapping[str, Array]) -> PyTree:
    """ExtraNet's variables from a published state dict; kernels turn from OIHW to HWIO.

    Args:
      tensors: by the published names; a prefix ``module.`` and ``num_batches_tracked`` are ignored.

    Returns:
      ``{"params", "batch_stats"}`` for ``extranet()``.

    Raises:
      ValueError: an entry is missing, unknown, or has another shape.
    """
    tensors = {name.removeprefix("module."): np.asarray(tensor) for name, tensor in tensors.items()}
    shapes = jax.eval_shape(extranet().init, jax.random.key(0), *input_shapes(1))
    leaves, tree = jax.tree_util.tree_flatten_with_path(shapes)
    unknown = {name for name in tensors if not name.endswith(".num_batches_tracked")}
    found = []
    for path, leaf in leaves:
        names = torch_entries(tuple(entry.key for entry in path))
        missing = [name for name in names if name not in tensors]
        if missing:
            raise ValueError(
                f"ExtraNet weights: expected an entry {missing[0]}; it is missing (there are {len(tensors)} others). "
                "Give the state dict of a published checkpoint."
            )
        parts = [tensors[name] for name in names]
        parts = [part.transpose(2, 3, 1, 0) if part.ndim == 4 else part for part in parts]
        value = np.concatenate(parts, axis=-1) if len({part.shape[:-1] for part in parts}) == 1 else parts[0]
        if value.shape != leaf.shape:
            got = ", ".join(str(tensors[name].shape) for name in names)
            raise ValueError(
                f"ExtraNet weights: {' and '.join(names)} (PyTorch's OIHW): expected {leaf.shape} together as HWIO, "
                f"got {got}."
            )
        unknown -= set(names)
        found.append(jnp.asarray(value, leaf.dtype))
    if unknown:
        raise ValueError(f"ExtraNet weights: unknown entries {', '.join(sorted(unknown)[:5])}. Is it another network?")
    return jax.tree.unflatten(tree, found)
