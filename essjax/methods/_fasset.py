"""FASSET (Qin et al.): one network supersamples rendered frames and extrapolates the others, at any output size.

Sections 3.2, 3.3. Both tasks get the same kind of input: a frame with holes, cut by the mask of a warp.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from essjax import networks
from essjax.cameras import pixel_positions
from essjax.color import demodulate, expm1, log1p, modulate, rgb_to_ycocg, ycocg_to_rgb
from essjax.exposure import exposed
from essjax.frames import (
    Frame,
    GBuffers,
    Prediction,
    depth_scale,
    frame_size,
    network_depth,
    rendered_color,
    require,
    select_time,
    surface_guides,
)
from essjax.interfaces import Method, MethodInfo, reset_at_cut
from essjax.methods.registry import registered
from essjax.methods.rendered import (
    Memory,
    Rendered,
    advance,
    albedo,
    hole_buffers,
    map_content,
    push,
    reset_memory,
    start_memory,
)
from essjax.methods.shots import within_shots
from essjax.networks._fasset import LOCAL, PAST
from essjax.sizes import Scale, Size, check_scale, output_size, ratios
from essjax.typing import Array, Callable, Color, Image, Jitter, Mask, Scalar, pytree
from essjax.warp import (
    backward_warp,
    dilate_motion,
    fill_holes,
    hole_mask,
    inside_mask,
    jitter_aligned_upsample,
    jittered_motion,
    sample,
    upsample_motion,
)

REQUIRES = frozenset({"base_color", "normal"})
SAMPLE_SIGMA = 0.65
"""Sigma of the Gaussian that tells RenderINR how near a sample is, output pixels."""


@pytree
class Kept:
    """All that is kept of a rendered frame.

    Attributes:
      shading: demodulated colour, linear, ``[..., H, W, 3]``.
      hidden: the recurrent state after it, at pixel centres, ``[..., H, W, width]``.
      image: the output, linear, ``[..., H', W', 3]``.
      surfaces: the G-buffers that tell surfaces apart.
    """

    shading: Color
    hidden: Image
    image: Color
    surfaces: GBuffers


@pytree
class History:
    """The last rendered frame and the last frame of either kind.

    Attributes:
      rendered: memory of one frame, its content a ``Kept``.
      surfaces: G-buffers of the last frame.
      depth_scale: unit of depth, ``[...]``.
    """

    rendered: Memory
    surfaces: GBuffers
    depth_scale: Scalar


class Arrival(NamedTuple):
    """The history as seen at a frame's samples, and at its output pixels.

    Attributes:
      shading: of the last rendered frame, at the samples, log1p.
      hidden: its recurrent state, at pixel centres, 0 in holes.
      valid: 1 where the last rendered frame showed this surface, 0 in holes, ``[..., H, W, 1]``.
      recent: 1 where the last frame, rendered or not, did; 1 everywhere if there was none, and where the
        frame is reactive.
      sampled: its output at the samples, log1p, 0 where there is none, ``[..., H, W, 3]``.
      image: its output at this frame's, log1p, ``[..., H', W', 3]``.
      known: 1 where there is one: not off screen, not reactive.
    """

    shading: Color
    hidden: Image
    valid: Mask
    recent: Mask
    sampled: Color
    image: Color
    known: Mask


def _surfaces(gbuffers: GBuffers) -> GBuffers:
    return jax.tree.map(jnp.copy, hole_buffers(gbuffers))  # streaming donates the history, not the frame


def _start(example: Frame, size: Size, width: int) -> History:
    def zeros(size: Size, channels: int) -> Array:
        return jnp.zeros((*example.motion.shape[:-3], *size, channels), jnp.float32)

    surfaces = _surfaces(example.gbuffers)
    low = frame_size(example)
    kept = Kept(shading=zeros(low, 3), hidden=zeros(low, width), image=zeros(size, 3), surfaces=surfaces)
    return History(
        rendered=start_memory(example, kept, 1),
        surfaces=_surfaces(example.gbuffers),
        depth_scale=depth_scale(example.gbuffers),
    )


def _arrive(history: History, frame: Frame, size: Size, width: int) -> tuple[History, Arrival]:
    """Extend the history's path to ``frame``; returns it and what it shows there."""
    fresh, before = _start(frame, size, width), history.rendered
    before = reset_memory(frame.cut, fresh.rendered, before)
    surfaces = reset_at_cut(frame.cut, fresh.surfaces, history.surfaces)
    unit = reset_at_cut(frame.cut, fresh.depth_scale, history.depth_scale)
    empty = before.count[..., None, None, None] == 0
    recent = hole_mask(frame.gbuffers, surfaces, frame.motion, jitter=frame.jitter, jitter_previous=before.jitter)
    memory = advance(before, frame)
    last = select_time(memory.frames, 0)
    same = hole_mask(
        frame.gbuffers, last.content.surfaces, last.motion, jitter=frame.jitter, jitter_previous=last.jitter
    )
    valid = jnp.where(empty, 0.0, same * last.valid)
    recent, trust = jnp.where(empty, 1.0, recent), jnp.where(empty, 0.0, jnp.ones_like(valid))
    if frame.reactive is not None:
        valid, trust = valid * last.trust, trust * last.trust
        # What a reactive pixel shows is its own sample: nothing is cut out of it.
        recent = jnp.maximum(recent, frame.reactive)
    history = History(rendered=memory, surfaces=_surfaces(frame.gbuffers), depth_scale=unit)
    return history, Arrival(valid=valid, recent=recent, **_read(last, frame, size, valid, trust))


def _read(last: Rendered, frame: Frame, size: Size, valid: Mask, trust: Mask) -> dict[str, Array]:
    """Read what was kept on its own grid: shading at samples, hidden state at pixel centres, image at output size.

    Held on unjittered grids, what is written in one frame is read in another as it was; from samples to samples it
    would be blurred by each new jitter.
    """
    height, low_width = frame_size(frame)
    kept, motion = last.content, jax.lax.stop_gradient(last.motion)
    shading, image = log1p(jax.lax.stop_gradient(kept.shading)), log1p(kept.image)
    shading = backward_warp(shading, jittered_motion(motion, frame.jitter, last.jitter))
    hidden = backward_warp(kept.hidden, upsample_motion(motion, (height, low_width), jitter=frame.jitter))
    samples = pixel_positions(height, low_width, frame.jitter) + motion
    # Dilated, so that the history of a silhouette moves with the surface in front.
    at_output = upsample_motion(dilate_motion(motion, frame.gbuffers.depth), size, jitter=frame.jitter)
    known = inside_mask(at_output) * jitter_aligned_upsample(trust, size, frame.jitter, mode="nearest")
    return {
        "shading": shading,
        "hidden": _as_far_as(valid, hidden),
        "sampled": _as_far_as(
            inside_mask(motion) * trust,
            sample(image, jnp.asarray(ratios((height, low_width), size), jnp.float32) * samples),
        ),
        # Bicubic: bilinear would blur the history a little more with every frame.
        "image": backward_warp(image, at_output, mode="bicubic"),
        "known": known,
    }


def _as_far_as(mask: Mask, image: Image) -> Image:
    """``mask * image``; where it is 0 nothing is left, not even NaN."""
    return jnp.where(mask > 0, mask * image, 0.0)


def _into_box(image: Color, samples: Color, jitter: Jitter) -> Color:
    """``image`` clamped to the YCoCg box of the 3x3 samples around each output pixel, as TAA does.

    Reflections and shadows move without motion vectors; a network that saw few of them trusts their history.
    """
    box = rgb_to_ycocg(samples)
    low, high = (
        jitter_aligned_upsample(_around(box, choose), image.shape[-3:-1], jitter, mode="nearest")
        for choose in (jnp.minimum, jnp.maximum)
    )
    return ycocg_to_rgb(jnp.clip(rgb_to_ycocg(image), low, high))


def _around(image: Image, choose: Callable[[Array, Array], Array]) -> Image:
    """Take the smallest or largest value of each 3x3 neighbourhood, the border repeated."""
    for axis in (-3, -2):
        size = image.shape[axis]
        before, after = (jnp.clip(jnp.arange(size) + step, 0, size - 1) for step in (-1, 1))
        image = choose(choose(jnp.take(image, before, axis), image), jnp.take(image, after, axis))
    return image


def sample_nearness(low: Size, size: Size, jitter: Jitter) -> Mask:
    """How near each output pixel is to the nearest sample, a Gaussian of ``SAMPLE_SIGMA`` output pixels: (0, 1].

    Args:
      low: (height, width) of the input.
      size: of the output.
      jitter: ``[..., 2]`` LR pixels.

    Returns:
      ``[..., *size, 1]``.
    """

    def along(axis: int, jitter: Array) -> Array:
        """Squared distance in output pixels, ``[..., size[axis]]``."""
        ratio = size[axis] / low[axis]
        position = (jnp.arange(size[axis], dtype=jnp.float32) + 0.5) / ratio - jitter[..., None]
        nearest = jnp.clip(jnp.floor(position), 0, low[axis] - 1) + 0.5
        return (ratio * (position - nearest)) ** 2

    distance = along(0, jitter[..., 1])[..., :, None] + along(1, jitter[..., 0])[..., None, :]
    return jnp.exp(-0.5 * distance / SAMPLE_SIGMA**2)[..., None]


@registered
def fasset(
    *,
    scale: Scale = 2,
    width: int = 24,
    hidden: int | None = None,
    gencoder: bool = True,
    mask_rendered: bool = True,
    shared: bool = True,
) -> Method:
    """FASSET: ``variables = {"fasset": ...}``, ``aux`` holds ``log_image``, ``mask`` and ``valid``.

    A rendered frame is not warped, but the holes of the warped previous frame are cut out of it, so that both tasks
    look alike and in-painting is learned from both. The output is RenderINR's colour plus a base, moved towards the
    last rendered frame's output by a share that RenderINR says (0 before training). The base is the input upsampled:
    warped and filled smoothly without its texture, given that of the current frame; output pixel P reads at
    (P + 0.5) / ratio - jitter. The hidden state is updated by rendered frames, follows the motion and is 0 in holes.

    Args:
      scale: output size over input size, any number >= 1, or the output's (width, height).
      width: of the encoders; each of the two feature maps has 3 channels fewer.
      hidden: neurons of RenderINR's layers; None: 16/3 of the width, 128 at 24.
      gencoder: False feeds RenderINR the G-buffers themselves (Table 4, "- GEncoder").
      mask_rendered: False leaves rendered frames whole (Table 4, "- Additional mask").
      shared: False gives each task a FrameEncoder of its own (Table 4, "- Shared weights").

    Raises:
      ValueError: no such scale, or the width is below 4.
    """
    scale = check_scale(scale)
    hidden = width * 16 // 3 if hidden is None else hidden
    network = networks.fasset(width=width, hidden=hidden, gencoder=gencoder, shared=shared)
    removed = {"no-gencoder": not gencoder, "no-mask": not mask_rendered, "no-sharing": not shared}
    name = "-".join(["fasset", *(part for part, absent in removed.items() if absent)])

    def size_of(frame: Frame) -> Size:
        return output_size(scale, frame_size(frame))

    def start(example):
        return _start(example, size_of(example), width)

    def init(key, example):
        require(example, sorted(REQUIRES), name)
        *lead, height, low_width, _ = example.motion.shape
        large = (*lead, *size_of(example), LOCAL)
        low = [(*lead, height, low_width, channels) for channels in (3, 1, 7, PAST, width)]
        shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in (*low, large, example.jitter.shape)]
        return {"fasset": network.init(key, *shapes)}

    def predict(variables, history, frame, shading, mask, arrival, near, train, task):
        """Predict the output as log1p, the new hidden state, statistics; ``shading`` (log1p) is not read in holes."""
        texture = albedo(frame.gbuffers)
        filled = log1p(modulate(expm1(fill_holes(shading, mask)), texture))
        base = jax.lax.stop_gradient(jitter_aligned_upsample(filled, size_of(frame), frame.jitter))
        past = _into_box(arrival.image, jax.lax.stop_gradient(filled), frame.jitter)
        difference = _as_far_as(arrival.known, past - base)
        trusted = jitter_aligned_upsample(arrival.valid, size_of(frame), frame.jitter, mode="nearest")
        inputs = (
            mask * filled,
            mask,
            _guides(history, frame),
            jnp.concatenate([arrival.sampled, arrival.valid], axis=-1),
            arrival.hidden,
            jnp.concatenate([difference, trusted, near], axis=-1),
            frame.jitter,
        )
        (color, share, hidden), state = network.apply(variables["fasset"], *inputs, train=train, method=task)
        return base + share * difference + color, hidden, {"fasset": state} if state else {}

    def render_step(variables, history, frame, *, train=False):
        linear = demodulate(rendered_color(frame, name), albedo(frame.gbuffers))
        shading = log1p(linear)
        history, arrival = _arrive(history, frame, size_of(frame), width)
        mask = arrival.recent if mask_rendered else jnp.ones_like(arrival.recent)
        near = sample_nearness(frame_size(frame), size_of(frame), frame.jitter)
        log_image, hidden, state = predict(variables, history, frame, shading, mask, arrival, near, train, "render")
        image = expm1(log_image)
        kept = Kept(shading=linear, hidden=hidden, image=image, surfaces=_surfaces(frame.gbuffers))
        history = dataclasses.replace(history, rendered=push(history.rendered, frame, kept))
        aux = {"log_image": log_image, "mask": mask, "valid": arrival.recent}
        return history, Prediction(image=image, aux=aux, state=state)

    def extrapolate_step(variables, history, frame, *, train=False):
        history, arrival = _arrive(history, frame, size_of(frame), width)
        mask, nowhere = arrival.valid, jnp.zeros_like(arrival.known)
        given = arrival.shading, mask, arrival, nowhere
        log_image, _, state = predict(variables, history, frame, *given, train, "extrapolate")
        aux = {"log_image": log_image, "mask": mask, "valid": mask}
        return history, Prediction(image=expm1(log_image), aux=aux, state=state)

    def map_radiance(function, history):
        names = "shading", "image"
        scaled = lambda kept: dataclasses.replace(kept, **{name: function(getattr(kept, name)) for name in names})  # noqa: E731
        return dataclasses.replace(history, rendered=map_content(scaled, history.rendered))

    info = MethodInfo(name, scale=scale, requires=REQUIRES)
    return within_shots(exposed(Method(init, start, render_step, extrapolate_step, info), map_radiance))


def _guides(history: History, frame: Frame) -> Image:
    """Albedo, depth and normal as the network sees them, ``[..., H, W, 7]``."""
    base_color, normal = surface_guides(frame.gbuffers)
    return jnp.concatenate([base_color, network_depth(frame.gbuffers, history.depth_scale), normal], axis=-1)
