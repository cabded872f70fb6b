"""Objective of ExtraNet (section 4.5).

Our reading, that of the published code: the losses compare the network's output with the demodulated frame, both
log(1 + x), before base colour comes back. The frame is the jittered, aliased one.
"""

import jax

from essjax.color import demodulate, expose, log1p
from essjax.frames import Sequence, rendered_color, select_time
from essjax.interfaces import Method
from essjax.losses import hardest, l1, masked_mean, occlusion
from essjax.methods.fasset_baselines import enlarge
from essjax.methods.rendered import albedo
from essjax.networks._extranet import FRAMES
from essjax.rollout import alternate
from essjax.train.objectives.common import Objective, mean_of, predict_last, since_cut
from essjax.typing import Array, Callable, Color, PyTree


def frame_shading(clip: Sequence) -> Color:
    """ExtraNet's target: the frame as it would have been rendered, demodulated. ``clip`` has no time axis."""
    return demodulate(rendered_color(clip.frames, "extranet"), albedo(clip.frames.gbuffers))


def reference_shading(clip: Sequence) -> Color:
    """ExtraNet+'s: the anti-aliased reference, demodulated by upsampled base colour. ``clip`` has no time axis."""
    return demodulate(clip.reference, albedo(enlarge(clip.frames, clip.size, None).gbuffers))


def extranet_objective(
    method: Method,
    *,
    hole_weight: float = 1.0,
    shade_weight: float = 1.0,
    share: float = 0.1,
    target_shading: Callable[[Sequence], Color] = frame_shading,
    period: int = 2,
) -> Objective:
    """L of ExtraNet eq 7, on the last frame of each clip: L1 (eq 4), holes (eq 5), the worst pixels (eq 6).

    It is extrapolated from each distance, 1 to ``period - 1``; the terms are means over these. A clip of
    ``3 * period`` frames shows the network three rendered ones; of a longer one only the last frames are used. Where
    nothing was rendered since a cut, there is nothing to learn.

    Args:
      method: ``extranet``.
      hole_weight: lambda_hole of eq 7; eq 5's mask is the network's.
      shade_weight: lambda_shade of eq 7; 0 leaves the term out (Table 7, "w/o L_shade").
      share: k of eq 6 over the number of pixels.
      target_shading: what is predicted of a clip's last frame, linear: ``frame_shading`` or ``reference_shading``.
      period: one frame in so many is rendered.
    """

    def at(variables: PyTree, clip: Sequence, distance: int) -> tuple[dict[str, Array], PyTree]:
        window = min(distance + (FRAMES - 1) * period + 1, clip.frames.motion.shape[0])
        frames = select_time(clip.frames, slice(-window, None))
        schedule = alternate((window - 1 - distance) % period, period=period)
        prediction = predict_last(method, variables, frames, schedule)
        image = prediction.aux["log_shading"]
        target = log1p(expose(target_shading(select_time(clip, -1)), prediction.aux["exposure"]))
        counts = (since_cut(clip.frames.cut)[-1] >= distance)[..., None, None, None]
        errors, hole = l1(image, target), (1.0 - prediction.aux["inputs"].mask) * counts
        terms = {
            "l1": masked_mean(errors, counts),
            "hole": hole_weight * masked_mean(occlusion(image, target, hole), hole),
        }
        if shade_weight:
            terms["shade"] = shade_weight * masked_mean(errors, hardest(errors, share=share) * counts)
        return terms, prediction.state

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        found = [at(variables, clip, distance) for distance in range(1, period)]
        terms = {name: mean_of(terms[name] for terms, _ in found) for name in found[0][0]}
        return terms, jax.tree.map(lambda *leaves: mean_of(leaves), *(state for _, state in found))

    return objective
