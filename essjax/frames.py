"""The vocabulary: GBuffers, Frame, Sequence, Prediction, and the checks that stand where user data enters.

Shapes are those of one image; any leading axes may stand in front: ``[H, W, C]``, ``[B, H, W, C]``,
``[T, B, H, W, C]``.
All are frozen pytrees: change a field with ``dataclasses.replace``. ``None`` means the channel does not exist.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from essjax.buffers import BUFFERS, OPTIONAL_GBUFFERS, RANGES
from essjax.cameras import Camera
from essjax.sizes import Scale, Size, scale_of
from essjax.typing import Color, Flag, Ids, Jitter, Mask, Motion, Plane, PyTree, Scalar, Vectors, pytree


@pytree
class GBuffers:
    """Everything that the rasteriser knows without shading, at the jittered sample positions.

    Only depth is always there: a method names what else it needs in ``MethodInfo.requires``.

    Attributes:
      base_color: ``[..., H, W, 3]`` in [0, 1]; 0 on the sky.
      normal: ``[..., H, W, 3]`` world space, unit length; zero vector where nothing was hit.
      depth: ``[..., H, W, 1]`` positive view-space z, linear, metres; background +inf.
      roughness: ``[..., H, W, 1]`` in [0, 1].
      metallic: ``[..., H, W, 1]`` in [0, 1].
      specular: ``[..., H, W, 1]`` in [0, 1].
      world_position: ``[..., H, W, 3]`` metres; 0 on the background.
      stencil: ``[..., H, W, 1]`` integer object id >= 0; 0 static or none.
      n_dot_v: ``[..., H, W, 1]`` in [0, 1]: cosine between normal and direction to the camera.
    """

    base_color: Color | None = None
    normal: Vectors | None = None
    depth: Plane
    roughness: Plane | None = None
    metallic: Plane | None = None
    specular: Plane | None = None
    world_position: Vectors | None = None
    stencil: Ids | None = None
    n_dot_v: Plane | None = None


@pytree
class Frame:
    """One frame as a method sees it.

    Attributes:
      color: ``[..., H, W, 3]`` linear HDR radiance, one jittered sample per pixel; None on extrapolated frames.
      gbuffers: at the same sample positions.
      motion: ``[..., H, W, 2]`` (x right, y down) pixels of this resolution, to the previous frame; unjittered,
        stored at the jittered sample positions.
      jitter: ``[..., 2]`` (x, y) pixels of this resolution in [-0.5, 0.5): the sample lies at pixel centre + jitter.
      cut: bool ``[...]``: true where history is not valid (first frame of a shot).
      exposure: ``[...]`` positive, what colour is multiplied with before it is shown; colour is scene radiance whatever
        its value. None: not recorded, methods meter it (``essjax.exposure``).
      camera: in pixels of this resolution, or None.
      reactive: ``[..., H, W, 1]`` in [0, 1], 1 = do not trust history here; or None.
    """

    color: Color | None
    gbuffers: GBuffers
    motion: Motion
    jitter: Jitter
    cut: Flag
    exposure: Scalar | None = None
    camera: Camera | None = None
    reactive: Plane | None = None


@pytree
class SampleRanges:
    """Ranges over the sub-samples of each reference pixel, unjittered, for classifier labels (Guo et al. 2022).

    Attributes:
      depth_min: ``[..., sH, sW, 1]`` metres, background +inf.
      depth_max: the same, largest.
      color_min: ``[..., sH, sW, 3]`` linear radiance, smallest per channel.
      color_max: the same, largest.
      normal_spread: ``[..., sH, sW, 1]`` largest L1 distance of a sample's normal to the first sample's.
      normal_spread_smooth: the same without bump detail.
      motion: ``[..., sH, sW, 2]`` of the nearest sample, current to previous, pixels of the reference.
    """

    depth_min: Plane
    depth_max: Plane
    color_min: Color
    color_max: Color
    normal_spread: Plane
    normal_spread_smooth: Plane
    motion: Motion


@pytree
class Sequence:
    """Frames stacked in time, with what they are scored against. Leading axes ``[T, ...]``.

    Attributes:
      frames: a ``Frame`` whose leaves carry the time axis; colour of *every* frame: on frames that a schedule
        extrapolates it is a target, and ``rollout.unroll`` takes it away before the method sees the frame.
      reference: ``[T, ..., H', W', 3]`` anti-aliased, unjittered, of the frames' size or any larger one.
      valid: ``[T, ..., H, W, 1]`` LR, 1 where the previous position is on screen and showed the same surface; exact,
        from the renderer. None: ``warp.hole_mask`` estimates it.
      steady: ``[T, ..., H, W, 1]`` LR, 1 where the shading is known not to move against the surface (no mirror image,
        no changing shadow); from the renderer only.
      native: frames at the reference's resolution with a jitter of their own (the input of native TAA); or None.
      ranges: over all samples of each reference pixel, from the renderer only; or None.
    """

    frames: Frame
    reference: Color
    valid: Mask | None = None
    steady: Mask | None = None
    native: Frame | None = None
    ranges: SampleRanges | None = None

    @property
    def size(self) -> Size:
        """The reference's (height, width)."""
        return self.reference.shape[-3:-1]

    @property
    def scale(self) -> Scale:
        """The reference's size over the frames', see ``sizes.scale_of``."""
        return scale_of(frame_size(self.frames), self.size)


@pytree
class Prediction:
    """The result of a step.

    Attributes:
      image: ``[..., H', W', 3]`` linear HDR, of the size that the method's scale gives (``sizes.output_size``).
      aux: named intermediates (flow, masks, features) for losses and pictures.
      state: new BatchNorm statistics when ``train``, else {}; keyed as the variables are:
        ``{entry: {"batch_stats": ...}}``.
    """

    image: Color
    aux: dict[str, PyTree] = dataclasses.field(default_factory=dict)
    state: dict[str, PyTree] = dataclasses.field(default_factory=dict)


def frame_size(frame: Frame) -> Size:
    """(height, width) of a frame."""
    return frame.motion.shape[-3:-1]


def frame_images(frame: Frame) -> dict[str, jax.Array | np.ndarray]:
    """Collect the images that a frame holds, by name; absent ones are left out."""
    images = {"color": frame.color, "motion": frame.motion, "reactive": frame.reactive}
    images |= {field.name: getattr(frame.gbuffers, field.name) for field in dataclasses.fields(frame.gbuffers)}
    return {name: image for name, image in images.items() if image is not None}


def gbuffers_of(images: Mapping[str, Any]) -> GBuffers:
    """G-buffers picked by name from ``images``, which may hold more; optional ones that are absent become None.

    Raises:
      KeyError: depth is missing.
    """
    return GBuffers(depth=images["depth"], **{name: images.get(name) for name in OPTIONAL_GBUFFERS})


def surface_guides(gbuffers: GBuffers) -> tuple[Color, Vectors]:
    """Return base colour and normal; a ValueError says which one is missing."""
    if gbuffers.base_color is None or gbuffers.normal is None:
        missing = [name for name in ("base_color", "normal") if getattr(gbuffers, name) is None]
        raise ValueError(f"expected frames with base colour and normals, got some without {', '.join(missing)}.")
    return gbuffers.base_color, gbuffers.normal


def rendered_color(frame: Frame, name: str) -> Color:
    """Return the colour of a rendered frame; a ValueError names the method ``name`` if it has none."""
    if frame.color is None:
        raise ValueError(f"{name}: a rendered step needs the frame's colour, got None. Call its extrapolate_step.")
    return frame.color


def require(frame: Frame, names: Iterable[str], method: str) -> None:
    """Raise a ValueError that names the buffers which ``method`` needs and ``frame`` lacks, and why it needs them."""
    present = frame_images(frame)
    missing = [name for name in names if name not in present]
    if missing:
        purposes = {name: BUFFERS[name].purpose for name in missing if name in BUFFERS}
        why = "".join(f" {name} {purpose}." for name, purpose in purposes.items() if purpose)
        raise ValueError(
            f"{method} needs the buffers {', '.join(missing)}, which these frames do not have "
            f"(they have {', '.join(present)}).{why} Render or import them, or choose another method."
        )


def check_shapes(frame: Frame, where: str = "frame") -> None:
    """Raise a ValueError unless all images of ``frame`` agree in size and have the right number of channels.

    Leading axes (time, batch) must be those of motion everywhere; nothing broadcasts.
    """
    *leading, height, width = frame.motion.shape[:-1]
    for name, image in frame_images(frame).items():
        expected = (height, width, BUFFERS[name].channels)
        if image.shape[-3:] != expected:
            raise ValueError(
                f"{where}, channel {name}: expected [..., {height}, {width}, {expected[-1]}] (the size of motion), "
                f"got {tuple(image.shape)}. Resample it, or pass the matching channels."
            )
    if frame.jitter.shape[-1:] != (2,):
        raise ValueError(f"{where}, jitter: expected [..., 2] (x, y) in pixels, got {tuple(frame.jitter.shape)}.")
    cores = {f"channel {name}": (image, 3) for name, image in frame_images(frame).items()}
    cores |= {"jitter": (frame.jitter, 1), "cut": (frame.cut, 0)}
    if frame.exposure is not None:
        cores |= {"exposure": (frame.exposure, 0)}
    if frame.camera is not None:
        camera = frame.camera
        cores |= {"camera.camera_to_world": (camera.camera_to_world, 2)}
        cores |= {"camera.focal": (camera.focal, 1), "camera.center": (camera.center, 1)}
    for name, (array, rank) in cores.items():
        shape = np.shape(array)
        if shape[: len(shape) - rank] != tuple(leading):
            raise ValueError(
                f"{where}, {name}: expected the leading axes {tuple(leading)} of motion, got the shape {shape}. "
                "Broadcast it first."
            )


def check_dtypes(frame: Frame, where: str = "frame") -> None:
    """Raise a ValueError unless numbers are float32 for JAX, ids integers and ``cut`` bool.

    Methods keep what they are given in their histories, whose types must not change from frame to frame.
    """
    arrays = frame_images(frame) | {"jitter": frame.jitter}
    if frame.exposure is not None:
        arrays |= {"exposure": frame.exposure}
    if frame.camera is not None:
        arrays |= {f"camera.{field.name}": getattr(frame.camera, field.name) for field in dataclasses.fields(Camera)}
    for name, array in arrays.items():
        dtype = jnp.result_type(array)
        if name == "stencil":
            if not jnp.issubdtype(dtype, jnp.integer):
                raise ValueError(f"{where}, channel stencil: expected integer ids, got {dtype}. Cast it.")
        elif dtype != jnp.float32:
            scale = " and bring it to its range" if jnp.issubdtype(dtype, jnp.integer) else ""
            raise ValueError(f"{where}, {name}: expected float32, got {dtype}. Cast it to float32{scale}.")
    if jnp.result_type(frame.cut) != jnp.bool_:
        raise ValueError(f"{where}, cut: expected bool, got {jnp.result_type(frame.cut)}. Compare it with 0.")


_NORMAL_TOLERANCE = 0.05  # 8 bits a component miss by 0.01


def _reject(bad: np.ndarray, image: np.ndarray, where: str, name: str, expected: str, fix: str) -> None:
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{where}, channel {name}: expected {expected}, got {image[at]} at {at} (and {int(bad.sum()) - 1} more of "
            f"{bad.size} values). {fix}"
        )


def validate_frame(frame: Frame, where: str = "frame", requires: Iterable[str] = ()) -> None:
    """Raise a ValueError that names ``where``, the channel, what was expected, what came and what to do.

    Reads the values, so it belongs where data enters, outside jit. Checks presence, sizes, types, NaN and infinities
    (depth may be +inf: background), signs and ranges, normals longer than 1, the jitter and the exposure.
    """
    require(frame, requires, where)
    check_shapes(frame, where)
    check_dtypes(frame, where)
    for name, image in frame_images(frame).items():
        values = np.asarray(image)
        if name == "depth":
            bad = np.isnan(values) | (values <= 0)
            _reject(bad, values, where, name, "positive view-space z, +inf on the background", "Convert it at import.")
            continue
        _reject(~np.isfinite(values), values, where, name, "finite values", "Clean or re-render this frame.")
        if name == "color":
            _reject(values < 0, values, where, name, "radiance >= 0", "Clamp it at import.")
        elif name == "stencil":
            _reject(values < 0, values, where, name, "ids >= 0", "Renumber the objects.")
        elif name == "normal":
            length = np.sqrt(np.einsum("...c,...c->...", values, values))
            long = length > 1 + _NORMAL_TOLERANCE  # a mean over samples is shorter
            _reject(long, length, where, name, "unit length", "Decode or normalise it at import.")
        elif BUFFERS[name].unit_range:
            outside = (values < 0) | (values > 1 + 1e-3)
            _reject(outside, values, where, name, "values in [0, 1]", "Rescale or clamp it at import.")
    jitter = np.asarray(frame.jitter)
    in_range = np.all((jitter >= -0.5) & (jitter <= 0.5), axis=-1)
    _reject(~in_range, jitter, where, "jitter", "pixels in [-0.5, 0.5)", "Divide it by the image size or subtract 0.5.")
    if frame.exposure is not None:
        exposure, fix = np.asarray(frame.exposure), "Leave it out (None) where it is not known."
        _reject(~((exposure > 0) & np.isfinite(exposure)), exposure, where, "exposure", "a positive number", fix)


def validate_sequence(sequence: Sequence, name: str = "sequence", requires: Iterable[str] = ()) -> None:
    """``validate_frame`` for each frame; reference, masks, native frames and ranges against the frames' size."""
    frames, length = sequence.frames, sequence.frames.motion.shape[0]
    height, width = frame_size(frames)
    if sequence.reference.shape[0] != length:
        raise ValueError(f"{name}, reference: expected {length} frames, got {sequence.reference.shape[0]}.")
    high, wide = sequence.reference.shape[-3:-1]
    if high < height or wide < width:
        raise ValueError(f"{name}, reference: expected at least the frames' {width}x{height}, got {wide}x{high}.")
    for mask_name in ("valid", "steady"):
        mask = getattr(sequence, mask_name)
        if mask is not None and mask.shape[-3:] != (height, width, 1):
            raise ValueError(f"{name}, {mask_name}: expected [..., {height}, {width}, 1], got {tuple(mask.shape)}.")
    if sequence.native is not None and sequence.native.motion.shape[-3:-1] != (high, wide):
        size = sequence.native.motion.shape[-3:-1]
        raise ValueError(f"{name}, native frames: expected {wide}x{high} as the reference, got {size[1]}x{size[0]}.")
    if sequence.ranges is not None:
        validate_ranges(sequence.ranges, high, wide, f"{name}, ranges")
    for index in range(length):
        frame = jax.tree.map(lambda leaf, i=index: np.asarray(leaf[i]), frames)
        validate_frame(frame, f"{name}, frame {index}", requires)
        reference = np.asarray(sequence.reference[index])
        bad = ~np.isfinite(reference) | (reference < 0)
        _reject(bad, reference, f"{name}, frame {index}", "reference", "finite radiance >= 0", "Re-render this frame.")


def validate_ranges(ranges: SampleRanges, height: int, width: int, where: str = "ranges") -> None:
    """Raise a ValueError that names ``where`` and the image unless ``ranges`` are ranges of ``height`` x ``width``.

    Checks sizes, finite values (depth may be +inf: background) and that no minimum is above its maximum.
    """
    images = {name: np.asarray(getattr(ranges, name)) for name in RANGES}
    for name, image in images.items():
        expected = (height, width, len(RANGES[name]))
        if image.shape[-3:] != expected:
            raise ValueError(
                f"{where}, {name}: expected [..., {height}, {width}, {expected[-1]}] (the reference's size), "
                f"got {tuple(image.shape)}."
            )
        bad = np.isnan(image) if name.startswith("depth") else ~np.isfinite(image)
        _reject(bad, image, where, name, "numbers", "Re-render this frame.")
    for name in ("depth", "color"):
        low, high = images[f"{name}_min"], images[f"{name}_max"]
        _reject(low > high, low, where, f"{name}_min", f"at most {name}_max", "Re-render this frame.")


def select_time(tree: PyTree, index: int | slice) -> PyTree:
    """Frame ``index`` (or a range of frames) of a pytree whose leaves are time-major."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def without_color(frame: Frame) -> Frame:
    """Remove the colour: the frame as an extrapolating step sees it."""
    return dataclasses.replace(frame, color=None)


def example_frame(width: int, height: int) -> Frame:
    """Make the shapes of one frame ``[1, H, W, C]`` with every buffer (``jax.ShapeDtypeStruct`` leaves)."""

    def leaf(*shape: int, dtype: Any = jnp.float32) -> Any:
        return jax.ShapeDtypeStruct((1, *shape), dtype)

    def image(name: str) -> Any:
        return leaf(height, width, BUFFERS[name].channels, dtype=jnp.int32 if name == "stencil" else jnp.float32)

    return Frame(
        color=image("color"),
        gbuffers=GBuffers(**{name: image(name) for name in ("depth", *OPTIONAL_GBUFFERS)}),
        motion=image("motion"),
        jitter=leaf(2),
        cut=leaf(dtype=jnp.bool_),
        exposure=leaf(),
    )


def background(gbuffers: GBuffers) -> jax.Array:
    """Bool ``[..., H, W, 1]``: true where nothing was hit (depth +inf)."""
    return ~jnp.isfinite(gbuffers.depth)


_DEPTH_SAMPLES = 32


def depth_scale(gbuffers: GBuffers) -> Scalar:
    """Median finite depth ``[...]`` of each image (1 if there is none), the unit of ``network_depth``.

    Of every k-th row and column such that about 32 x 32 pixels are left: a sort of all would cost as much as a small
    network, and every frame computes it, as any frame may follow a cut.
    """
    height, width = gbuffers.depth.shape[-3:-1]
    rows, columns = max(height // _DEPTH_SAMPLES, 1), max(width // _DEPTH_SAMPLES, 1)
    depth = gbuffers.depth[..., ::rows, ::columns, :]
    flat = depth.reshape(*depth.shape[:-3], -1)
    median = jnp.nanmedian(jnp.where(jnp.isfinite(flat), flat, jnp.nan), axis=-1)
    return jnp.where(jnp.isfinite(median), median, 1.0)


def network_depth(gbuffers: GBuffers, scale: Scalar) -> Plane:
    """Depth as networks see it: z / ``scale``, background 0. ``scale`` is ``depth_scale`` of the first frame."""
    return jnp.where(background(gbuffers), 0.0, gbuffers.depth / scale[..., None, None, None])
