"""Methods that FASSET is compared with (section 4.2): ExtraNet and NSRR both ways, and ExtraNet at output size."""

import dataclasses

import jax.numpy as jnp

from essjax.color import demodulate, expm1, modulate
from essjax.exposure import exposed
from essjax.frames import Frame, GBuffers, Prediction, frame_size, rendered_color, require
from essjax.interfaces import Method, MethodInfo
from essjax.methods._composed import composed
from essjax.methods._extranet import REQUIRES, Inputs, Kept, extranet, network_inputs
from essjax.methods._nsrr import nsrr
from essjax.methods.baselines import jau_image
from essjax.methods.registry import registered
from essjax.methods.rendered import Memory, advance, albedo, hole_buffers, map_shading, push, reset_memory, start_memory
from essjax.methods.shots import within_shots
from essjax.networks._extranet import FRAMES, input_shapes
from essjax.networks._extranet import extranet as extranet_network
from essjax.sizes import Scale, Size, check_scale, output_size
from essjax.typing import Color, Image
from essjax.warp import jitter_aligned_upsample, upsample_motion, zero_upsample


def enlarge(frame: Frame, size: Size, color: Color | None) -> Frame:
    """``frame`` at output size with ``color`` ``[..., *size, 3]`` (or None), unjittered, its buffers upsampled.

    Buffers are read where their samples lie: materials bilinearly, what tells surfaces apart from the nearest sample.
    World position is left out: between two samples it would be wrong by more than what hole marking allows.

    Args:
      frame: at low resolution.
      size: (height, width) of the output.
      color: its colour at output size.
    """

    def up(image: Image | None, mode: str) -> Image | None:
        return None if image is None else jitter_aligned_upsample(image, size, frame.jitter, mode=mode)

    buffers = frame.gbuffers
    materials = {name: up(getattr(buffers, name), "bilinear") for name in ("base_color", "roughness", "metallic")}
    surfaces = {name: up(getattr(buffers, name), "nearest") for name in ("normal", "stencil", "n_dot_v")}
    return dataclasses.replace(
        frame,
        color=color,
        gbuffers=GBuffers(
            depth=jitter_aligned_upsample(buffers.depth, size, frame.jitter, mode="nearest"),
            specular=up(buffers.specular, "bilinear"),
            **materials,
            **surfaces,
        ),
        motion=upsample_motion(frame.motion, size, jitter=frame.jitter),
        jitter=jnp.zeros_like(frame.jitter),
        reactive=up(frame.reactive, "nearest"),
        camera=None,
    )


@registered
def extranet_nsrr(*, scale: Scale = 2, width: int = 32) -> Method:
    """ExtraNet, then NSRR on every frame. ``variables = {"extranet", "nsrr"}``, trained separately.

    NSRR looks back at rendered frames only, so that supersampled frames are those of ``nsrr_extranet``, as in Table 2.

    Args:
      scale: see ``sizes.check_scale``.
      width: of NSRR.
    """
    return composed("extranet+nsrr", extranet(), nsrr(scale=scale, width=width, half=True), extrapolates=True)


@registered
def nsrr_extranet(*, scale: Scale = 2, width: int = 32) -> Method:
    """NSRR on rendered frames, then ExtraNet at output size on upsampled G-buffers. The variables of ``extranet_nsrr``.

    Args:
      scale: see ``sizes.check_scale``.
      width: of NSRR.
    """

    def between(frame: Frame, image: Color) -> Frame:
        return enlarge(frame, output_size(scale, frame_size(frame)), None if frame.color is None else image)

    first = nsrr(scale=scale, width=width, half=True)
    return composed("nsrr+extranet", first, extranet(), extrapolates=True, between=between)


def _without_gaps(seen: Inputs) -> Inputs:
    """Give the inputs' shading a fourth channel, 1 where a sample was read: no sample is a hole."""

    def found(warped: Image) -> Image:
        return (warped[..., 3:4] > 0).astype(jnp.float32)

    plain, around = jnp.split(seen.warped, 2, axis=-1)
    history = jnp.concatenate([seen.history[..., :3], seen.history[..., 4:] * found(seen.history)], axis=-1)
    return Inputs(
        warped=jnp.concatenate([plain[..., :3], around[..., :3]], axis=-1),
        mask=seen.mask * found(plain),
        features=seen.features,
        history=history,
    )


@registered
def extranet_plus(*, scale: Scale = 2) -> Method:
    """ExtraNet+: ExtraNet at output size on zero-upsampled frames; it fills what was disoccluded and what lies between.

    ``variables = {"extranet_plus": {"params", "batch_stats"}}``; ``aux`` of an extrapolated step as of ``extranet``, at
    output size. Rendered frames are shown jitter-aligned upsampled and not scored.

    Our reading: every sample of a rendered frame stands in one pixel at output size; warps read the nearest pixel, a
    sample or nothing, and nothing is a hole. Frames are demodulated before, and modulated with upsampled base colour.

    Args:
      scale: see ``sizes.check_scale``.
    """
    network, scale = extranet_network(), check_scale(scale)

    def size_of(frame: Frame) -> Size:
        return output_size(scale, frame_size(frame))

    def samples(shading: Color, frame: Frame) -> Image:
        """Shading and a channel > 0 where there is a sample (it is scaled like colour), ``[..., H', W', 4]``."""
        known = jnp.concatenate([shading, jnp.ones_like(shading[..., :1])], axis=-1)
        return zero_upsample(known, size_of(frame), frame.jitter)

    def start(example: Frame) -> Memory:
        large = enlarge(example, size_of(example), None)
        black = jnp.zeros((*large.motion.shape[:-1], 4), jnp.float32)
        return start_memory(large, Kept(shading=black, gbuffers=hole_buffers(large.gbuffers)), FRAMES)

    def init(key, example):
        require(example, sorted(REQUIRES), info.name)
        return {"extranet_plus": network.init(key, *input_shapes(1))}

    def arrive(memory: Memory, frame: Frame) -> tuple[Memory, Frame]:
        large = enlarge(frame, size_of(frame), None)
        return advance(reset_memory(frame.cut, start(frame), memory), large), large

    def render_step(variables, history, frame, *, train=False):
        memory, large = arrive(history, frame)
        shading = demodulate(rendered_color(frame, info.name), albedo(frame.gbuffers))
        kept = Kept(shading=samples(shading, frame), gbuffers=hole_buffers(large.gbuffers))
        return push(memory, large, kept), Prediction(image=jau_image(frame, size_of(frame)))

    def extrapolate_step(variables, history, frame, *, train=False):
        memory, large = arrive(history, frame)
        seen = _without_gaps(network_inputs(memory, large, mode="nearest"))
        inputs = seen.warped, seen.mask, seen.features, seen.history
        log_shading, state = network.apply(variables["extranet_plus"], *inputs, train=train)
        image = modulate(expm1(log_shading), albedo(large.gbuffers))
        aux = {"log_shading": log_shading, "inputs": seen}
        return memory, Prediction(image=image, aux=aux, state={"extranet_plus": state} if state else {})

    info = MethodInfo("extranet-plus", scale=scale, requires=REQUIRES, predicts=frozenset({"ess"}))
    return within_shots(exposed(Method(init, start, render_step, extrapolate_step, info), map_shading))
