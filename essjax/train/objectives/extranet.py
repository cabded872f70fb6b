"""Objective of ExtraNet (section 4.5).

Our reading, that of the published code: the losses compare the network's output with the demodulated frame, both
log(1 + x), before base colour comes back. The frame is the jittered, aliased one.
"""

from essjax.color import demodulate, expose, log1p
from essjax.frames import Sequence, rendered_color, select_time
from essjax.interfaces import Method
from essjax.losses import hardest, l1, masked_mean, occlusion
from essjax.methods._extranet import WINDOW
from essjax.methods.fasset_baselines import enlarge
from essjax.methods.rendered import albedo
from essjax.train.objectives.common import Objective, predict_last, since_cut
from essjax.typing import Array, Callable, Color, PyTree


def frame_shading(clip: Sequence) -> Color:
    """ExtraNet's target: the frame as it would have been rendered, demodulated. ``clip`` has no time axis."""
    return demodulate(rendered_color(clip.frames, "extranet"), albedo(clip.frames.gbuffers))


def reference_shading(clip: Sequence) -> Color:
    """ExtraNet+'s: the anti-aliased reference, demodulated by upsampled base colour. ``clip`` has no time axis."""
    return demodulate(clip.reference, albedo(enlarge(clip.frames, clip.scale, None).gbuffers))


def extranet_objective(
    method: Method,
    *,
    hole_weight: float = 1.0,
    shade_weight: float = 1.0,
    share: float = 0.1,
    target_shading: Callable[[Sequence], Color] = frame_shading,
) -> Objective:
    """L of ExtraNet eq 7, on the last frame of each clip: L1 (eq 4), holes (eq 5), the worst pixels (eq 6).

    A clip of ``WINDOW`` frames shows the network three rendered ones; of a longer one only the last frames are used.
    Where the last one is a cut, there is nothing to learn.

    Args:
      method: ``extranet``.
      hole_weight: lambda_hole of eq 7; eq 5's mask is the network's.
      shade_weight: lambda_shade of eq 7; 0 leaves the term out (Table 7, "w/o L_shade").
      share: k of eq 6 over the number of pixels.
      target_shading: what is predicted of a clip's last frame, linear: ``frame_shading`` or ``reference_shading``.
    """

    def objective(variables: PyTree, clip: Sequence) -> tuple[dict[str, Array], PyTree]:
        length = clip.frames.motion.shape[0]
        frames = select_time(clip.frames, slice(max(length - WINDOW, 0), length))
        prediction = predict_last(method, variables, frames)
        image = prediction.aux["log_shading"]
        target = log1p(expose(target_shading(select_time(clip, -1)), prediction.aux["exposure"]))
        counts = (since_cut(clip.frames.cut)[-1] > 0)[..., None, None, None]
        errors, hole = l1(image, target), (1.0 - prediction.aux["inputs"].mask) * counts
        terms = {
            "l1": masked_mean(errors, counts),
            "hole": hole_weight * masked_mean(occlusion(image, target, hole), hole),
        }
        if shade_weight:
            terms["shade"] = shade_weight * masked_mean(errors, hardest(errors, share=share) * counts)
        return terms, prediction.state

    return objective
