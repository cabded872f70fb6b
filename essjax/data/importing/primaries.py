"""RGB of other primaries (XYZ, ACES, Rec. 2020) to linear Rec. 709, from the ``chromaticities`` in an EXR's header."""

from collections.abc import Mapping
from typing import Any

import numpy as np

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""x and y of red, green, blue and white: what EXR means where the header says nothing."""
CLOSE = 2e-3
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Cone responses of the chromatic adaptation that ICC profiles use."""


def _xyz(x: float, y: float) -> np.ndarray:
    """XYZ of a chromaticity at luminance 1."""
    return np.array([x, y, 1 - x - y]) / y


def _to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    """``[3, 3]``: RGB to XYZ such that RGB = 1 is white at luminance 1 (SMPTE RP 177)."""
    *primaries, white = chromaticities.reshape(4, 2)
    columns = np.array([[x, y, 1 - x - y] for x, y in primaries]).T
    return columns * np.linalg.solve(columns, _xyz(*white))


def to_rec709(header: Mapping[str, Any], where: str) -> np.ndarray | None:
    """``[3, 3]``: linear RGB of a file to linear Rec. 709, its white to D65; None: they are those already.

    Args:
      header: of an EXR file.
      where: file, for the message.

    Raises:
      ValueError: the chromaticities are of no colour space.
    """
    if "chromaticities" not in header:
        return None
    stated = np.asarray(header["chromaticities"], np.float64).reshape(-1)
    if stated.shape == (8,) and np.allclose(stated, REC709, atol=CLOSE):
        return None
    try:
        matrix = _to_xyz(stated)
        whites = [_BRADFORD @ _xyz(*white) for white in (stated[6:], REC709[6:])]
        adapted = np.linalg.inv(_BRADFORD) @ np.diag(whites[1] / whites[0]) @ _BRADFORD @ matrix
        matrix = np.linalg.inv(_to_xyz(np.array(REC709))) @ adapted
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise ValueError(
            f"{where}: the chromaticities {np.round(stated, 4).tolist()} are those of no colour space. Export Rec. "
            "709, or take the attribute out."
        )
    return matrix.astype(np.float32)
