"""The one table of images that a frame may hold: what every other part needs to know about each of them."""

from typing import NamedTuple


class Buffer(NamedTuple):
    """Facts about one image.

    Attributes:
      suffixes: of its channels in files, one letter each.
      optional: a G-buffer that frames may lack.
      purpose: why a method wants it: the reason that ``frames.require`` gives.
      unit_range: its values lie in [0, 1].
      precise: stored as float32: half resolves 64 px of motion to 1/16 px and 1 km of depth to 0.5 m.
      varies: every channel is expected to change; one roughness for a whole scene is nothing odd.
      directed: components along the axes of space or image: a flip changes their signs.
    """

    suffixes: str
    optional: bool = False
    purpose: str = ""
    unit_range: bool = False
    precise: bool = False
    varies: bool = False
    directed: bool = False

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.suffixes)


BUFFERS = {
    "color": Buffer("RGB", varies=True),
    "base_color": Buffer(
        "RGB", True, "divides the texture out of the shading and guides the warp", unit_range=True, varies=True
    ),
    "normal": Buffer("XYZ", True, "tells surfaces apart: guides the warp", varies=True, directed=True),
    "depth": Buffer("Z", precise=True, varies=True),
    "roughness": Buffer("Y", True, "tells mirrors from matt surfaces", unit_range=True),
    "metallic": Buffer("Y", True, "belongs to the divisor of the shading", unit_range=True),
    "specular": Buffer("Y", True, "belongs to the divisor of the shading", unit_range=True),
    "world_position": Buffer("XYZ", True, "finds holes on static surfaces", precise=True, varies=True, directed=True),
    "stencil": Buffer("Y", True, "tells moving objects apart"),
    "n_dot_v": Buffer("Y", True, "finds holes at grazing angles", unit_range=True),
    "motion": Buffer("XY", precise=True, varies=True, directed=True),
    "reactive": Buffer("Y", unit_range=True),
}
"""Images of a frame, in the order in which files and messages list them."""
MASKS = ("valid", "steady")
"""Masks of a sequence, beside its frames; one channel each, ``Y``."""
RANGES = {
    "depth_min": "Z", "depth_max": "Z", "color_min": "RGB", "color_max": "RGB", "normal_spread": "Y",
    "normal_spread_smooth": "Y", "motion": "XY",
}  # fmt: skip
"""Images of ``frames.SampleRanges`` and the suffixes of their channels."""
OPTIONAL_GBUFFERS = tuple(name for name, buffer in BUFFERS.items() if buffer.optional)
UNIT_RANGE = tuple(name for name, buffer in BUFFERS.items() if buffer.unit_range)
DEPTHS = frozenset({"depth", "depth_min", "depth_max"})
"""Images that may be +inf: background."""
FULL_PRECISION = frozenset({*DEPTHS, *(name for name, buffer in BUFFERS.items() if buffer.precise)})
