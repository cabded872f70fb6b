"""A known truth, and raw EXR files to write it into in a foreign convention."""

import jax
import numpy as np
import OpenEXR

from essjax.data import read_sequence
from tests.helpers import make_sequence

W, H = 24, 14
OUR_RULES = """
[motion]
sign = "previous-current"
y = "down"
unit = "pixels"
[depth]
kind = "linear"
"""
"""Of a recipe for a dump that keeps to our conventions."""


def truth(T=4, seed=0, scale=2, W=W, H=H):
    """A random sequence, leaves ``[T, H, W, C]``."""
    return jax.tree.map(lambda leaf: np.asarray(leaf[:, 0]), make_sequence(seed, T, 1, H, W, scale=scale))


def write(path, channels, header=None):
    """Planes as float32, just as a renderer would leave them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
    OpenEXR.File(dict(header or {}), planes).write(str(path))


def rgb(image, prefix=""):
    """Channels R, G, B of ``[H, W, 1..3]``, behind a layer's name."""
    return {f"{prefix}{name}": image[..., i] for i, name in enumerate("RGB"[: image.shape[-1]])}


def imported(report, name):
    """The imported sequence."""
    return read_sequence(report.dataset, name)


def assert_like(got, expected, name, atol=1e-5, rtol=2**-10):
    """Equal up to half precision."""
    np.testing.assert_allclose(got, expected, rtol=rtol, atol=atol, err_msg=name)
