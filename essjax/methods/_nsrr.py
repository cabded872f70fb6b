"""NSRR (Xiao et al. 2020; thesis 002 sections 3.2, 4.5): supersampling from the current and four previous frames.

Every frame is rendered. Previous frames are zero-upsampled and warped to the current one along their composed motion,
each by a single bilinear read; there is no recurrence of the output. Colour is display-referred inside.
"""

import dataclasses

import jax
import jax.numpy as jnp

from essjax.cameras import pixel_positions
from essjax.color import display, display_inverse
from essjax.exposure import exposed
from essjax.frames import Frame, Prediction, depth_scale, frame_size, network_depth, rendered_color
from essjax.interfaces import Method, MethodInfo, refuse_extrapolation, reset_at_cut
from essjax.methods.baselines import jau_image
from essjax.methods.registry import registered
from essjax.methods.rendered import Memory, advance, push, reset_memory, start_memory
from essjax.methods.shots import within_shots
from essjax.networks._nsrr import FEATURES, PREVIOUS, RGBD
from essjax.networks._nsrr import nsrr as nsrr_network
from essjax.sizes import Scale, Size, check_scale, output_size
from essjax.typing import Array, Image, pytree
from essjax.warp import jitter_aligned_upsample, sample_zero_upsampled, upsample_motion, zero_upsample


@pytree
class History:
    """The frames to look back at.

    Attributes:
      rendered: the four latest frames; their content are features ``[4, ..., H, W, FEATURES]``, low resolution, of
        each frame at its own exposure.
      depth_scale: unit of depth, ``[...]``: that of the first frame since the cut.
    """

    rendered: Memory
    depth_scale: Array


def warp_previous(rendered: Memory, frame: Frame, size: Size) -> Image:
    """Warp the previous frames' features to the output pixels of ``frame``, ``[4, ..., *size, FEATURES]``.

    What zero-upsampling each and warping it by its motion (composed at low resolution, upsampled bilinearly) gives; 0
    where a path leads outside or was reactive, and where no sample of that frame fell next to its end.
    """
    frames = rendered.frames
    motion = jax.lax.stop_gradient(upsample_motion(frames.motion, size, jitter=frame.jitter))
    positions = pixel_positions(motion.shape[-3], motion.shape[-2]) + motion
    warped = sample_zero_upsampled(frames.content, positions, size, frames.jitter)
    if frames.trust is None:
        return warped
    return warped * jitter_aligned_upsample(frames.trust, size, frame.jitter, mode="nearest")


@registered
def nsrr(*, scale: Scale = 2, width: int = 32, residual: bool = True, half: bool = False) -> Method:
    """Neural supersampling of a sequence that is rendered in every frame.

    ``variables = {"nsrr": ...}``. ``aux``: ``display_image``, the output before it is clipped to [0, 1] (x / (1 + x),
    then sRGB), and ``weights`` of the previous frames ``[..., H', W', 4]``.

    Args:
      scale: how much larger the output is, see ``sizes.check_scale``; one network serves all.
      width: of the network, 32 as published.
      residual: add the jitter-aligned upsampled current frame to the network's output, which starts at zero: untrained
        it is the baseline ``jau``. The paper's network returns the image itself.
      half: for sequences of which some frames are not rendered. ``extrapolate_step`` then follows the motion only and
        shows black; a colour that another method made for the frame is supersampled, but never looked back at.
    """
    network, scale = nsrr_network(width=width), check_scale(scale)

    def size_of(frame: Frame) -> Size:
        return output_size(scale, frame_size(frame))

    def start(example: Frame) -> History:
        content = jnp.zeros((*example.motion.shape[:-1], FEATURES), jnp.float32)
        return History(rendered=start_memory(example, content, PREVIOUS), depth_scale=depth_scale(example.gbuffers))

    def init(key, example):
        high = (*example.motion.shape[:-3], *size_of(example), FEATURES)
        shapes = (*example.motion.shape[:-1], RGBD), high, (PREVIOUS, *high)
        return {"nsrr": network.init(key, *(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes))}

    def arrive(history, frame):
        fresh = start(frame)
        rendered = reset_memory(frame.cut, fresh.rendered, history.rendered)
        unit = reset_at_cut(frame.cut, fresh.depth_scale, history.depth_scale)
        return History(rendered=advance(rendered, frame), depth_scale=unit)

    def supersample(variables, history, frame, train):
        rgbd = jnp.concatenate([display(frame.color), network_depth(frame.gbuffers, history.depth_scale)], axis=-1)
        own, _ = network.apply(variables["nsrr"], rgbd, train=train, method="current")
        own = zero_upsample(own, size_of(frame), frame.jitter)
        warped = warp_previous(history.rendered, frame, size_of(frame))
        (output, weights), _ = network.apply(variables["nsrr"], own, warped, train=train, method="reconstruct")
        shown = output + display(jau_image(frame, size_of(frame))) if residual else output
        return Prediction(image=display_inverse(shown), aux={"display_image": shown, "weights": weights}), rgbd

    def render_step(variables, history, frame, *, train=False):
        rendered_color(frame, info.name)
        history = arrive(history, frame)
        prediction, rgbd = supersample(variables, history, frame, train)
        remembered, _ = network.apply(variables["nsrr"], rgbd, train=train, method="previous")
        return dataclasses.replace(history, rendered=push(history.rendered, frame, remembered)), prediction

    def pass_step(variables, history, frame, *, train=False):
        history = arrive(history, frame)
        if frame.color is not None:
            return history, supersample(variables, history, frame, train)[0]
        return history, Prediction(image=jnp.zeros((*frame.motion.shape[:-3], *size_of(frame), 3), jnp.float32))

    info = MethodInfo("nsrr", scale=scale, predicts=frozenset({"ss"}), renders_all=not half)
    if not half:
        return exposed(Method(init, start, render_step, refuse_extrapolation("nsrr"), info))
    return within_shots(exposed(Method(init, start, render_step, pass_step, info)))
