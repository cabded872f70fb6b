"""From a scene to the library's vocabulary: frames with all buffers, references and masks."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from essjax.buffers import RANGES
from essjax.cameras import Camera
from essjax.frames import Frame, SampleRanges, Sequence, gbuffers_of
from essjax.scenes.builder import Scene
from essjax.scenes.jitter import jitter_sequence
from essjax.scenes.render import pixel_angle, render_buffers, render_reference, render_statistics
from essjax.scenes.world import World
from essjax.sizes import Scale, output_size
from essjax.typing import Callable


class Rendering(NamedTuple):
    """How frames of a scene are rendered.

    Attributes:
      scale: reference size over frame size, any number >= 1, or the reference's (width, height).
      spp: samples per reference pixel.
      native: also render 1-sample frames at the reference's size; their jitter advances every frame.
      ranges: also the ranges over the reference's samples (what a classifier's labels are made of: Guo et al. 2022,
        section 2); the background's normal counts as 0.
      mip_bias: texture filter of LR and native frames, log2 of its width over an output pixel's: 0 is what
        upscalers ask engines for (textures as sharp as the output's), ``log2(scale)`` what LR alone would need.
        Eq 47 of thesis 002, -log2(f) - log2(spp) / 2 over an *input* pixel, is ``-log2(spp) / 2`` here: 0 for its
        dataset 1 (1 sample per pixel), -1 for its dataset 2 (4 samples per pixel).
      jitter: pattern of the LR frames, see ``jitter_sequence``; native frames always have the default.
    """

    scale: Scale = 2
    spp: int = 64
    native: bool = False
    ranges: bool = False
    mip_bias: float = 0.0
    jitter: str = "kronecker"


USUAL = Rendering()


def _camera(world: World, width: int, height: int, tall: float) -> Camera:
    return Camera(
        camera_to_world=np.asarray(world.camera_to_world, np.float32),
        focal=np.asarray([world.focal * width, world.focal * width / tall], np.float32),
        center=np.array([0.5 * width, 0.5 * height], np.float32),
    )


def _check_size(width: int, height: int, spp: int) -> None:
    for name, value in (("width", width), ("height", height), ("spp", spp)):
        if not (isinstance(value, (int, np.integer)) and value >= 1):
            raise ValueError(f"{name}: expected a whole number >= 1, got {value!r}.")


def _frame(scene: Scene, index: int, width: int, height: int, jitter: np.ndarray, angle: np.float32, tall: float = 1.0):
    world, previous = scene.at(index), scene.before(index)
    images = render_buffers(world, previous, width, height, jitter, angle, tall=tall)
    if scene.cut[index]:  # nothing of the frame before can be used
        images["valid"] = np.zeros_like(images["valid"])
    frame = Frame(
        color=images["color"] * np.float32(scene.unit),
        gbuffers=gbuffers_of(images),
        motion=images["motion"],
        jitter=jitter,
        cut=np.asarray(scene.cut[index]),
        exposure=np.asarray(1.0 / scene.unit, np.float32),
        camera=_camera(world, width, height, tall),
    )
    return frame, images["valid"], images["steady"]


def render_frame(scene: Scene, index: int, width: int, height: int, *, rendering: Rendering = USUAL) -> Sequence:
    """One frame of ``scene`` as a ``Sequence`` without time axis (leaves ``[H, W, C]``), NumPy arrays.

    Radiance is in the scene's ``unit``, and exposure its inverse. At a cut motion is that of a static scene seen by a
    static camera (zero) and ``valid`` is 0 everywhere.

    Args:
      scene: from ``make_scene``.
      index: frame number; only it and the frame before matter, so rendering can start anywhere.
      width: LR width, pixels.
      height: LR height, pixels.
      rendering: what is rendered of it.

    Raises:
      ValueError: a size is not a positive whole number, no such scale, no frame ``index``, or no such jitter pattern.
    """
    scale, spp, native, ranges, mip_bias, jitter = rendering
    _check_size(width, height, spp)
    high, wide = output_size(scale, (height, width))
    tall = height * wide / (width * high)  # both show the same, to the border
    offset = jitter_sequence(index + 1, pattern=jitter, scale=scale)[index]
    world = scene.at(index)
    angle = pixel_angle(world, wide, mip_bias)
    native_frame = None

    def from_samples() -> tuple[np.ndarray, SampleRanges | None]:
        if not ranges:
            return render_reference(world, wide, high, spp=spp, tall=tall) * np.float32(scene.unit), None
        images = render_statistics(world, scene.before(index), wide, high, spp=spp, tall=tall)
        return images["reference"] * np.float32(scene.unit), _ranges(images, scene.unit)

    # Beside the buffers, so that the two compilations of the first frame run at the same time.
    with ThreadPoolExecutor(1) as beside:
        sampled = beside.submit(from_samples)
        frame, valid, steady = _frame(scene, index, width, height, offset, angle)
        if native:
            offset = jitter_sequence(index + 1)[index]
            native_frame, _, _ = _frame(scene, index, wide, high, offset, angle, tall)
    reference, found = sampled.result()
    return Sequence(frames=frame, reference=reference, valid=valid, steady=steady, native=native_frame, ranges=found)


def _ranges(images: dict[str, np.ndarray], unit: float) -> SampleRanges:
    scales = {name: np.float32(unit) for name in ("color_min", "color_max")}
    return SampleRanges(**{name: images[name] * scales.get(name, np.float32(1)) for name in RANGES})


def iterate_frames(
    scene: Scene, width: int, height: int, *, start: int = 0, stop: int | None = None, rendering: Rendering = USUAL
) -> Iterator[tuple[int, Sequence]]:
    """Yield ``(n, render_frame(scene, n, width, height, rendering=rendering))`` for n from ``start`` up to ``stop``.

    For writers that store frame by frame and resume at frame ``start``.
    """
    for index in range(start, scene.frames if stop is None else stop):
        yield index, render_frame(scene, index, width, height, rendering=rendering)


def render_sequence(
    scene: Scene,
    width: int,
    height: int,
    *,
    rendering: Rendering = USUAL,
    on_frame: Callable[[int], None] = lambda index: None,
) -> Sequence:
    """All frames of ``scene``: a ``Sequence`` whose leaves are ``[T, H, W, C]`` float32 NumPy arrays.

    Args:
      scene: from ``make_scene``.
      width: LR width, pixels.
      height: LR height, pixels.
      rendering: what is rendered of it.
      on_frame: called with the index of each finished frame (progress bars).
    """
    parts = []
    for index, part in iterate_frames(scene, width, height, rendering=rendering):
        parts.append(part)
        on_frame(index)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
