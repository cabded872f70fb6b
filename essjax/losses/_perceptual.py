"""Perceptual loss: a distance between features of a network that knows natural images."""

from collections.abc import Sequence

from essjax.losses.pixel import check_same_shape
from essjax.typing import Callable, Color, Level


def perceptual(prediction: Color, target: Color, features: Callable[[Color], Sequence[Level]]) -> list[Level]:
    """Squared feature differences, one unreduced map ``[..., h, w, C]`` per level: L_vgg of ExtraSS eq 12.

    Johnson et al. 2016, eq 2, before its mean; ``sum_of_means`` reduces it.

    Args:
      prediction: ``[..., H, W, 3]`` linear HDR.
      target: the same shape.
      features: maps an image to its feature maps, for example ``vgg16_features(path)``.

    Raises:
      ValueError: the shapes differ.
    """
    check_same_shape(prediction, target)
    return [(a - b) ** 2 for a, b in zip(features(prediction), features(target), strict=True)]
