"""essjax: neural supersampling and frame extrapolation for real-time rendering, in JAX.

Conventions (docs/conventions.md): images ``[..., H, W, C]`` linear HDR, row 0 on top, pixel centres at +0.5; motion in
pixels of its own resolution, current to previous (``previous = current + motion``, x right, y down); sequences
time-major ``[T, B, H, W, C]``.
"""

__version__ = "0.1.0"
