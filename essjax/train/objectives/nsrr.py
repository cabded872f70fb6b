"""Objective of NSRR (Xiao et al. 2020): structural dissimilarity and a perceptual distance."""

import jax.numpy as jnp

from essjax.color import display, expose
from essjax.frames import Sequence, select_time
from essjax.interfaces import Method
from essjax.losses import perceptual, ssim_map, sum_of_means
from essjax.networks._nsrr import PREVIOUS
from essjax.rollout import alternate, every
from essjax.train.objectives.common import Objective, predict_last
from essjax.typing import Array, Callable, PyTree

VGG_LAYERS = ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3")
"""Five layers, as in the paper; which ones is our reading."""


def nsrr_objective(
    method: Method, *, vgg_weight: float = 0.1, vgg_features: Callable | None = None, half: bool = False
) -> Objective:
    """1 - SSIM, and the perceptual distance, of the last frame of a clip, display-referred.

    The output is not recurrent: one loss on a frame with four before it says all. Longer clips lose their beginning.

    Args:
      method: ``nsrr``.
      vgg_weight: w of the paper's loss; unused without ``vgg_features``.
      vgg_features: ``losses.vgg16_features(path, layers=VGG_LAYERS)``, or None to leave that term out.
      half: for ``nsrr(half=True)``: every other frame is rendered, the last one among them.
    """
    length = 2 * PREVIOUS + 1 if half else PREVIOUS + 1

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        clip = select_time(clip, slice(-length, None))
        schedule = alternate((clip.reference.shape[0] - 1) % 2) if half else every()
        prediction = predict_last(method, variables, clip.frames, schedule)
        exposure = prediction.aux["exposure"]
        reference = expose(clip.reference[-1], exposure)
        # Not clipped to [0, 1]: where it is, no gradient would lead back.
        similarity = ssim_map(prediction.aux["display_image"], display(reference))
        terms: dict[str, Array] = {"dissimilarity": jnp.mean(1.0 - similarity)}
        if vgg_features is not None:
            terms["vgg"] = vgg_weight * sum_of_means(
                perceptual(expose(prediction.image, exposure), reference, vgg_features)
            )
        return terms, prediction.state

    return objective
