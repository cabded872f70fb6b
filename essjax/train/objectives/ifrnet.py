"""Objective of IFRNet (Kong et al. 2022): reconstruction and feature space geometry, on log(1 + x)."""

import jax

from essjax.color import expose, log1p
from essjax.frames import Sequence, rendered_color, select_time
from essjax.interfaces import Method
from essjax.losses import census, charbonnier, feature_census
from essjax.rollout import alternate
from essjax.train.objectives.common import Objective, frame_mean, predict_last, since_cut
from essjax.typing import Array, PyTree


def ifrnet_objective(method: Method, *, feature_weight: float = 0.01) -> Objective:
    """Charbonnier, census and feature geometry of the middle one of a clip's last three frames, if no cut is between.

    Args:
      method: ``ifrnet``; its network's encoder makes the target's features.
      feature_weight: of the feature space geometry loss.
    """
    network = method.network("ifrnet")

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        length = clip.frames.motion.shape[0]
        if length < 3:
            raise ValueError(f"clip: expected at least 3 frames (two rendered ones around a third), got {length}.")
        frames = select_time(clip.frames, slice(-3, None))
        counts = since_cut(clip.frames.cut)[-1] >= 2
        prediction = predict_last(method, variables, frames, alternate(0))
        predicted = prediction.aux
        target = log1p(expose(rendered_color(frames, "ifrnet")[1], predicted["exposure"]))
        # The target's features are given, as in ``frnet_objective``.
        given = jax.lax.stop_gradient(variables["ifrnet"])
        features, _ = network.apply(given, target - predicted["mean"], method="encode")
        distances = [feature_census(a, b) for a, b in zip(predicted["features"], features, strict=False)]
        terms = {
            "charbonnier": frame_mean(charbonnier(predicted["image"], target), counts),
            "census": frame_mean(census(predicted["image"], target), counts),
            "feature_census": feature_weight * sum(frame_mean(distance, counts) for distance in distances),
        }
        return terms, prediction.state

    return objective
