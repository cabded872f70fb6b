"""VGG-16 features from torchvision-layout weights, in plain ``lax`` convolutions.

The weights are the user's: a file with the entries ``features.N.weight`` (OIHW) and ``features.N.bias`` of
torchvision's ``vgg16``, in a format of ``tensors.read_tensors``. Entries of layers above the last one asked for may be
absent.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from essjax.color import display
from essjax.tensors import read_tensors
from essjax.typing import Array, Callable, Color, Level

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

# torchvision's vgg16().features: (block, convolution) -> (index of its weight, input channels, output channels).
_CONVOLUTIONS = {
    (1, 1): (0, 3, 64), (1, 2): (2, 64, 64),
    (2, 1): (5, 64, 128), (2, 2): (7, 128, 128),
    (3, 1): (10, 128, 256), (3, 2): (12, 256, 256), (3, 3): (14, 256, 256),
    (4, 1): (17, 256, 512), (4, 2): (19, 512, 512), (4, 3): (21, 512, 512),
    (5, 1): (24, 512, 512), (5, 2): (26, 512, 512), (5, 3): (28, 512, 512),
}  # fmt: skip
LAYERS = tuple(f"relu{block}_{conv}" for block, conv in _CONVOLUTIONS)
"""Names of the layers that may be asked for, from the image up."""


def vgg16_features(
    weights_path: str | Path, *, layers: tuple[str, ...] = ("relu2_2",)
) -> Callable[[Color], list[Level]]:
    """Make a feature function of linear HDR for ``perceptual``: VGG-16 activations (Simonyan and Zisserman 2015).

    The image is made display-referred (``color.display``), clipped to [0, 1] and normalised as ImageNet was. The
    default layer is the one of Johnson et al. 2016's feature reconstruction loss, whom ExtraSS eq 12 cites.

    Args:
      weights_path: torchvision-layout weights, see ``tensors.read_tensors``.
      layers: names from ``LAYERS``; only what lies below the highest of them is loaded and computed.

    Returns:
      ``[..., H, W, 3] -> [[..., h, w, C], ...]``, one map per name in ``layers``. It is a ``jax.tree_util.Partial``,
      a pytree: hand it to a jitted function as an argument and its weights are not compiled in as constants.

    Raises:
      ValueError: the file is missing or not readable as such, an entry is missing or has the wrong shape, or a layer
        is unknown.
    """
    unknown = [name for name in layers if name not in LAYERS]
    if unknown or not layers:
        raise ValueError(f"layers: expected names from {', '.join(LAYERS)}; got {', '.join(unknown) or 'none'}.")
    tensors = read_tensors(weights_path, "VGG-16 weights", prefix="features.")
    needed = list(_CONVOLUTIONS.items())[: 1 + max(LAYERS.index(name) for name in layers)]
    parameters = {
        f"relu{block}_{conv}": _convolution(tensors, index, inputs, outputs, weights_path)
        for (block, conv), (index, inputs, outputs) in needed
    }

    def apply(parameters, image):
        return _activations(parameters, image, layers)

    return jax.tree_util.Partial(apply, parameters)


def _convolution(
    tensors: Mapping[str, np.ndarray], index: int, inputs: int, outputs: int, path: str | Path
) -> dict[str, Array]:
    expected = {f"features.{index}.weight": (outputs, inputs, 3, 3), f"features.{index}.bias": (outputs,)}
    for name, shape in expected.items():
        if name not in tensors:
            raise ValueError(
                f"VGG-16 weights: expected an entry {name} of shape {shape} in {path}; it is missing. "
                "The file must be the state dict of torchvision's vgg16."
            )
        if tensors[name].shape != shape:
            raise ValueError(f"VGG-16 weights: {name} in {path}: expected shape {shape}, got {tensors[name].shape}.")
    weight, bias = (jnp.asarray(tensors[name], jnp.float32) for name in expected)
    return {"weight": weight.transpose(2, 3, 1, 0), "bias": bias}


def _activations(parameters: dict, image: Color, layers: tuple[str, ...]) -> list[Level]:
    shown = jnp.clip(display(image), 0.0, 1.0)
    leading = shown.shape[:-3]
    mean, deviation = (jnp.array(values, shown.dtype).reshape(1, 1, 1, 3) for values in (IMAGENET_MEAN, IMAGENET_STD))
    value = (shown.reshape(-1, *shown.shape[-3:]) - mean) / deviation
    found, block = {}, "1"
    for name, convolution in parameters.items():  # sorted names are the order of LAYERS, and jax sorts a dict's keys
        if name[4] != block:
            block = name[4]
            value = jax.lax.reduce_window(value, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
        value = jax.lax.conv_general_dilated(
            value, convolution["weight"], (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        value = jax.nn.relu(value + convolution["bias"].reshape(1, 1, 1, -1))
        found[name] = value.reshape(*leading, *value.shape[1:])
    return [found[name] for name in layers]
