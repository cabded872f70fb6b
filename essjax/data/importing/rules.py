"""The tables of a recipe, one dataclass each; docs/guides/importing.md shows them in use."""

import dataclasses
from typing import Any


def _choice(*values: str, default: str | None = None) -> Any:
    given: Any = {} if default is None else {"default": default}
    return dataclasses.field(metadata={"choices": values}, **given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionRule:
    """``[motion]``: ``channels.motion`` names x first.

    Attributes:
      sign: which difference of positions is stored.
      y: where a positive y points.
      unit: "uv" is of the image's size, "ndc" of half of it.
      x: where a positive x points.
      zero: what is stored where nothing moves; taken off first.
      scale: what the stored values are multiplied with then.
      resolution: (width, height) of the image whose pixels the unit "pixels" means; None: its own.
      encoding: "plain": none. "unreal4", "unreal5": the velocity texture of that engine, the second with a square root;
        pixels it left out move with the cameras. "unreal-mrq": Movie Render Queue's MotionVectors pass.
      packing: how a component is made of bytes, see ``convert.unpack``; ``channels.motion`` then names the bytes of x,
        high one first, and those of y.
      unwritten: where the producer wrote no motion and only the camera moves: "zero" (where 0 is stored), "background"
        (of depth); ``channels.written`` is a mask of where it wrote. "unstated": on the background, if all of it
        holds 0 although surfaces move, and cameras are known.
      jittered: the difference of the two frames' jitter is in it, and is taken out.
      dilated: each pixel holds its nearest neighbour's motion. It cannot be undone; it is recorded.
    """

    sign: str = _choice("previous-current", "current-previous")
    y: str = _choice("down", "up")
    unit: str = _choice("pixels", "uv", "ndc")
    x: str = _choice("right", "left", default="right")
    zero: float = 0.0
    scale: float = 1.0
    resolution: tuple[int, int] | None = None
    encoding: str = _choice("plain", "unreal4", "unreal5", "unreal-mrq", default="plain")
    packing: tuple[int, int] | None = None
    unwritten: str = _choice("unstated", "zero", "background", default="unstated")
    jittered: bool = False
    dilated: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthRule:
    """``[depth]``.

    Attributes:
      kind: "linear": view-space z; "distance": along the pixel's ray; "reversed": near plane 1, far plane 0; "forward":
        near plane 0, far plane 1; "metadata": one of the last two, as the metadata says.
      near: near plane of the last two, in the dump's unit; the metadata's, if it has one, goes first.
      far: far plane; infinite by default.
      scale: metres per unit of the dump; negative where z is negative in front of the camera.
      background: metres from which on it is background (sky); it becomes +inf. So does 65504, where half ends, of the
        first two kinds.
      zero_is_background: of the first two kinds, 0 is background too.
      packing: as of motion; ``channels.depth`` then names the bytes, high one first.
    """

    kind: str = _choice("linear", "distance", "reversed", "forward", "metadata")
    near: float | None = None
    far: float = float("inf")
    scale: float = 1.0
    background: float = float("inf")
    zero_is_background: bool = False
    packing: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class JitterRule:
    """``[jitter]``.

    Attributes:
      source: "none"; "metadata": per frame; "halton": Halton (2, 3), ``first`` the element of the frame numbered 0,
        starting again after ``length`` frames.
      sign: "sample": the samples lie at pixel centre + jitter; "image": the image was shifted by it.
      y: where a positive y points.
      unit: as of motion.
      first: see source.
      length: see source.
    """

    source: str = _choice("none", "metadata", "halton", default="none")
    sign: str = _choice("sample", "image", default="sample")
    y: str = _choice("down", "up", default="down")
    unit: str = _choice("pixels", "uv", "ndc", default="pixels")
    first: int = 1
    length: int = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColorRule:
    """``[color]``, for colour and reference.

    Attributes:
      encoding: the transfer curve.
      pre_exposed: colour was multiplied with the metadata's exposure, and is divided by it.
    """

    encoding: str = _choice("linear", "srgb", default="linear")
    pre_exposed: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class NormalRule:
    """``[normal]``: ``encoding`` "signed", in [-1, 1], or "unsigned", in [0, 1]."""

    encoding: str = _choice("signed", "unsigned", default="signed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseColorRule:
    """``[base_color]``: ``encoding``, the transfer curve."""

    encoding: str = _choice("linear", "srgb", default="linear")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScaleRule:
    """``[scale]``: what stored values are multiplied with first, by image; ``color`` is also that of the reference."""

    color: float = 1.0
    base_color: float = 1.0
    roughness: float = 1.0
    metallic: float = 1.0
    specular: float = 1.0
    n_dot_v: float = 1.0
    reactive: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorldRule:
    """``[world]``, for normals and positions.

    Attributes:
      scale: metres per unit of the dump.
      handedness: of the dump's world; y is negated where it is "left". Cameras are given right-handed.
    """

    scale: float = 1.0
    handedness: str = _choice("right", "left", default="right")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReactiveRule:
    """``[reactive]``: what the channels of ``reactive`` hold.

    Attributes:
      kind: "mask": 1 where history is not to be trusted; "transmittance": how much of the background a separate
        translucent layer lets through; "radiance": what that layer adds (three channels).
    """

    kind: str = _choice("mask", "transmittance", "radiance", default="mask")
