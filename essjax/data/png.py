"""PNG files as flat dicts of channels: 8 bits stay 8 and 16 stay 16 (Pillow cuts 16-bit RGB to 8 without a word).

Every failure is a ValueError that begins with the file's name.
"""

import os
import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

_MAGIC = b"\x89PNG\r\n\x1a\n"
_NAMES = {0: "Y", 2: "RGB", 3: "RGB", 4: "YA", 6: "RGBA"}
"""Colour type -> channels; a palette (3) is looked up."""


def _check(path: Path, content: bytes) -> int:
    """Return the colour type; a ValueError unless all chunks are there and undamaged, which libpng does not promise."""
    if not content.startswith(_MAGIC):
        what = "an empty file" if not content else f"a file that begins with {content[:4]!r}"
        raise ValueError(f"{path}: expected a PNG file, found {what}. Download or render it again.")
    at, kind = len(_MAGIC), b""
    while kind != b"IEND":
        size, kind = int.from_bytes(content[at : at + 4]), content[at + 4 : at + 8]
        end = at + 8 + size
        if len(content) < end + 4 or zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4]):
            raise ValueError(f"{path}: the file is truncated or damaged. Download or render it again.")
        at = end + 4
    return content[25]


def read(path: str | os.PathLike, expect: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """Read all channels.

    Args:
      path: a PNG file.
      expect: channels that must be there.

    Returns:
      ``R``, ``G``, ``B``, ``A`` or, of grey files, ``Y`` and ``A`` -> ``[H, W]`` uint8 or uint16 as they are stored,
      contiguous, row 0 on top.

    Raises:
      ValueError: missing, not a PNG, damaged, or a channel is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: expected a PNG file, found {'a folder' if path.is_dir() else 'nothing'}.")
    content = path.read_bytes()
    names = _NAMES.get(_check(path, content), "")
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or not names:
        raise ValueError(f"{path}: the file is damaged (it cannot be decoded). Download or render it again.")
    planes = image[..., None] if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[-1]]]  # OpenCV has BGR
    if names == "YA":  # OpenCV spreads grey over three
        planes = planes[..., [0, 3]]
    missing = set(expect) - set(names)
    if missing:
        raise ValueError(
            f"{path}: expected the channels {', '.join(sorted(missing))}; the file has {', '.join(names)}."
        )
    return {name: np.ascontiguousarray(planes[..., index]) for index, name in enumerate(names)}
