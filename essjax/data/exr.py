"""OpenEXR files as flat dicts of channels: read everything or raise, write atomically.

The OpenEXR package writes non-contiguous arrays scrambled and drops damaged parts with no more than a printed
warning; both are caught here. Every failure is a ValueError that begins with the file's name. What is read is the
image (display window): pixels around it (overscan) are left out, a file that has less is refused. The library's own
lines about damaged files still go to stdout and stderr.
"""

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from difflib import SequenceMatcher
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR

from essjax.buffers import DEPTHS, FULL_PRECISION
from essjax.data.exr_text import is_whole, readable
from essjax.files import atomic

HALF_MAX = 65504.0
SMALL_IMAGE = 512 << 20
"""A file may always declare this many bytes of pixels ..."""
MAX_COMPRESSION = 2000
"""... and this many more for each byte it has; beyond, its header is damaged. A constant image reaches 1259 (PXR24)."""
SHOWN = 12
"""Channel names in a message."""
_MAGIC = b"\x76\x2f\x31\x01"
_LFS = b"version https://git-lfs"


def layer(channel: str) -> str:
    """Name the layer of a channel, ``"normal"`` of ``"normal.X"``; one without a dot is its own layer."""
    return channel.rpartition(".")[0] or channel


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise ValueError(f"{path}: expected an EXR file, found {'a folder' if path.is_dir() else 'nothing'}.")
    with path.open("rb") as file:
        head = file.read(len(_LFS))
    if head.startswith(_LFS):
        raise ValueError(f"{path}: this is a Git LFS pointer, not the image. Fetch the images with: git lfs pull")
    if not head.startswith(_MAGIC):
        what = "an empty file" if not head else f"a file that begins with {head[:4]!r}"
        raise ValueError(f"{path}: expected an EXR file, found {what}. Download or render it again.")


def _open(path: Path, *, header_only: bool) -> list[OpenEXR.Part]:
    """Open the parts of a file. Their attributes are read here, while a copy of the file may be needed for them."""
    try:
        return _parts(path, header_only)
    except UnicodeDecodeError:
        with readable(path) as copy:
            return _parts(copy, header_only)
    except (RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise ValueError(f"{path}: the file is damaged ({error}). Download or render it again.") from error


def _parts(path: Path, header_only: bool) -> list[OpenEXR.Part]:
    parts = OpenEXR.File(str(path), separate_channels=True, header_only=header_only, num_threads=0).parts
    for part in parts:
        part.header  # noqa: B018 (it is decoded when it is asked for)
    return parts


def _list(names: Iterable[str], limit: int = SHOWN) -> str:
    names = sorted(names)
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def _closest(names: Iterable[str], wanted: Iterable[str]) -> str:
    """All names, or of many those most like a wanted one."""
    names, wanted = sorted(names), [name.lower() for name in wanted]
    if len(names) <= SHOWN:
        return _list(names)
    like = lambda name: max(SequenceMatcher(None, name.lower(), other).ratio() for other in wanted)
    return f"{len(names)}, the closest are " + ", ".join(sorted(names, key=like, reverse=True)[:SHOWN])


class _Part(NamedTuple):
    """A part as the header describes it."""

    name: str
    channels: tuple[str, ...]
    data: tuple[int, int, int, int]
    """First and last column and row of the stored pixels: x0, y0, x1, y1, both ends included."""
    display: tuple[int, int, int, int]
    """The same of the image."""
    tile: tuple[int, int]
    """Height and width; OpenEXR allocates a whole one even for a smaller image."""
    deep: bool
    subsampled: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        x0, y0, x1, y1 = self.data
        return y1 - y0 + 1, x1 - x0 + 1

    @property
    def inside(self) -> tuple[slice, slice]:
        """Where the image lies in the stored pixels."""
        x, y, (x0, y0, x1, y1) = self.data[0], self.data[1], self.display
        return slice(y0 - y, y1 - y + 1), slice(x0 - x, x1 - x + 1)


def _window(window: tuple[np.ndarray, np.ndarray]) -> tuple[int, int, int, int]:
    (x0, y0), (x1, y1) = np.asarray(window).tolist()
    return x0, y0, x1, y1


def _part(part: OpenEXR.Part) -> _Part:
    header = part.header
    tiles = header.get("tiles")
    return _Part(
        str(header.get("name", "")),
        tuple(channel.name for channel in header["channels"]),
        _window(header["dataWindow"]),
        _window(header["displayWindow"]),
        (tiles.ySize, tiles.xSize) if tiles else (1, 1),
        header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile),
        tuple(channel.name for channel in header["channels"] if (channel.xSampling, channel.ySampling) != (1, 1)),
    )


def _check_part(path: Path, part: _Part) -> None:
    """Refuse what is not one value per pixel of the image, and sizes that only a damaged header declares."""
    if part.deep:
        raise ValueError(f"{path}, part {part.name}: deep data has many values per pixel. Export it flattened.")
    if part.subsampled:
        raise ValueError(
            f"{path}: the channels {_list(part.subsampled)} are subsampled (luminance-chroma). Export as RGB."
        )
    (x0, y0, x1, y1), (left, top, right, bottom) = part.data, part.display
    allowed = (SMALL_IMAGE + MAX_COMPRESSION * path.stat().st_size) / (4 * max(1, len(part.channels)))
    for what, (height, width) in (("an image", part.shape), ("tiles", part.tile)):
        if height < 1 or width < 1 or height * width > allowed:
            raise ValueError(f"{path}: the file is damaged ({what} of {width}x{height}). Download or render it again.")
    if right < left or bottom < top:
        raise ValueError(f"{path}: the file is damaged (an empty display window). Download or render it again.")
    if left < x0 or top < y0 or right > x1 or bottom > y1:
        raise ValueError(
            f"{path}: the file holds the pixels {x0}..{x1} x {y0}..{y1} (data window) of an image {left}..{right} x "
            f"{top}..{bottom} (display window). Render the whole image, without a crop or render region."
        )


def _headers(path: Path) -> tuple[list[_Part], dict]:
    """All parts, and the header of the first."""
    raw = _open(path, header_only=True)
    try:
        parts = [_part(part) for part in raw]
        header = dict(raw[0].header)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: the attribute 'channels' in the header is not UTF-8. Write it in ASCII.") from error
    except (KeyError, ValueError, TypeError, IndexError) as error:  # missing attributes
        raise ValueError(f"{path}: the file is damaged ({error}). Download or render it again.") from error
    for part in parts:
        _check_part(path, part)
    return parts, header


def _full_names(parts: list[_Part]) -> list[dict[str, str]]:
    """Per part, name in the file -> name in the result: with the part's name before it if several parts use it."""
    count = Counter(name for part in parts for name in part.channels)
    return [{n: n if count[n] == 1 else f"{part.name}.{n}" for n in part.channels} for part in parts]


def _planes(names: Mapping[str, str], described: _Part, part: OpenEXR.Part) -> dict[str, np.ndarray]:
    """Gather the channels of a part that could be read, cropped to the image."""
    planes = {names[name]: channel.pixels for name, channel in part.channels.items() if name in names}
    return {
        name: np.ascontiguousarray(plane[described.inside])
        for name, plane in planes.items()
        if isinstance(plane, np.ndarray) and plane.shape == described.shape
    }


def read_all(path: str | os.PathLike, expect: Iterable[str] = ()) -> tuple[dict[str, np.ndarray], dict]:
    """``read``, and the header of the first part."""
    path = Path(path)
    _check_file(path)
    described, header = _headers(path)
    names = _full_names(described)
    declared = {full for part in names for full in part.values()}
    missing = set(expect) - declared
    if missing:
        raise ValueError(f"{path}: expected the channels {_list(missing)}; the file has {_closest(declared, missing)}.")
    channels: dict[str, np.ndarray] = {}
    for part in _open(path, header_only=False):  # without the damaged ones
        channels |= _planes(names[part.part_index], described[part.part_index], part)
    lost = declared - set(channels)
    if lost:
        raise ValueError(
            f"{path}: the file is truncated or damaged: the channels {_list(lost)} cannot be read. "
            "Download or render it again."
        )
    return channels, header


def read(path: str | os.PathLike, expect: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """Read all channels of all parts.

    Args:
      path: an EXR file.
      expect: full channel names that must be there, such as ``"ViewLayer.Depth.Z"``.

    Returns:
      Channel name -> ``[H, W]`` float16, float32 or uint32, contiguous, row 0 on top, of the display window. A name
      that several parts use, such as ``R``, becomes ``<part>.R``.

    Raises:
      ValueError: missing, empty, LFS pointer, not EXR, damaged or truncated, a channel is missing, deep or subsampled
        data, or a data window that does not cover the image.
    """
    return read_all(path, expect)[0]


def _encode(path: Path, name: str, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Encode the array as it is stored, and count the values that had to be clamped to half's range."""
    if values.ndim != 2 or not values.size:
        raise ValueError(f"{path}, channel {name}: expected one [H, W] plane, got shape {values.shape}.")
    if values.dtype == bool or np.issubdtype(values.dtype, np.integer):
        if values.dtype != bool and (values.min() < 0 or values.max() > np.iinfo(np.uint32).max):
            raise ValueError(f"{path}, channel {name}: expected ids in [0, 2^32), got {values.min()}..{values.max()}.")
        return np.ascontiguousarray(values, np.uint32), 0
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"{path}, channel {name}: expected float or integer values, got {values.dtype}.")
    low, high = values.min(), values.max()  # NaN if there is one
    if np.isfinite(low) and np.isfinite(high) and max(-low, high) <= HALF_MAX:  # nearly always: nothing to look for
        return np.ascontiguousarray(values, np.float32 if layer(name) in FULL_PRECISION else np.float16), 0
    allowed = np.isfinite(values) | ((values == np.inf) & (layer(name) in DEPTHS))
    if not allowed.all():
        raise ValueError(
            f"{path}, channel {name}: expected finite values, got {values[~allowed][0]} in {int((~allowed).sum())} "
            f"of {values.size} pixels. Clean this frame before writing it (only depth may be +inf: background)."
        )
    if layer(name) in FULL_PRECISION:
        return np.ascontiguousarray(values, np.float32), 0
    clamped = int((np.abs(values) > HALF_MAX).sum())
    return np.ascontiguousarray(np.clip(values, -HALF_MAX, HALF_MAX), np.float16), clamped


def write(path: str | os.PathLike, channels: Mapping[str, np.ndarray], *, attributes: Mapping | None = None) -> int:
    """Write planes as one ZIP-compressed part, atomically.

    Floats become half, except the layers of ``FULL_PRECISION`` (float32); integers and bools become uint32. Values
    beyond half's +-65504 are clamped and counted; NaN and infinities are refused, +inf in ``depth.*`` aside.

    Args:
      path: the folder must exist.
      channels: full channel name -> ``[H, W]`` array, all of one size, any memory layout.
      attributes: more header attributes (str, float, ...).

    Returns:
      How many values were clamped.

    Raises:
      ValueError: nothing to write, different sizes, a wrong shape, type or value, or the file cannot be written.
    """
    path = Path(path)
    encoded = {name: _encode(path, name, np.asarray(values)) for name, values in channels.items()}
    sizes = {name: array.shape for name, (array, _) in encoded.items()}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"{path}: expected channels of one size, got {sizes or 'no channels'}.")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    with atomic(path) as temporary:
        try:
            OpenEXR.File(header, {name: array for name, (array, _) in encoded.items()}, 0).write(str(temporary))
        except (RuntimeError, ValueError, TypeError) as error:
            raise ValueError(f"{path}: cannot write the file ({error}). Is the folder there, the disk full?") from error
        if not temporary.is_file() or not is_whole(temporary):
            raise ValueError(f"{path}: cannot write the file. Is the folder there, the disk full?")
    return sum(clamped for _, clamped in encoded.values())
