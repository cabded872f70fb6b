"""What the OpenEXR package does not look at in a file's bytes: text that is not UTF-8, and whether all was written."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_HEADER_BYTES = 1 << 20
_MULTI_PART = 0x10  # of the second byte of the version field


def _attributes(data: bytes) -> Iterator[tuple[str, str, int, int]]:
    """Name, type, first and last byte of the value of every attribute of every part."""
    at, parts = 8, data[5] & _MULTI_PART
    while at < len(data):
        if data[at] == 0:  # the end of a header; one more of them ends those of several parts
            at += 1
            if not parts or data[at : at + 1] in (b"\0", b""):
                return
            continue
        name_end = data.index(b"\0", at)
        type_end = data.index(b"\0", name_end + 1)
        size = int.from_bytes(data[type_end + 1 : type_end + 5], "little")
        start = type_end + 5
        yield data[at:name_end].decode("latin-1"), data[name_end + 1 : type_end].decode("latin-1"), start, start + size
        at = start + size


def is_whole(path: Path) -> bool:
    """Whether a file of one part, just written, holds all its chunks.

    OpenEXR's stream writes its last kilobytes when it is closed, and nobody hears of a disk that is full by then.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
            table = list(_attributes(head))[-1][3] + 1
            first = int.from_bytes(
                head[table : table + 8], "little"
            )  # the chunks begin behind the table of their places
            file.seek(table)
            places = np.frombuffer(file.read(first - table), "<u8")
            file.seek(int(places.max()) + 4)
            size = int.from_bytes(file.read(4), "little")
            return bool(places.all()) and file.tell() + size <= path.stat().st_size
    except (ValueError, IndexError):
        return False


def _is_utf8(text: bytes) -> bool:
    try:
        text.decode()
    except UnicodeDecodeError:
        return False
    return True


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """Copy a file with question marks for letters that are no UTF-8, in values of text alone.

    Raises:
      ValueError: another attribute is no UTF-8; names it.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    patched = bytearray(head)
    try:
        found = [(name, kind, a, b) for name, kind, a, b in _attributes(head)]
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: the file is damaged (its header breaks off). Render it again.") from error
    foreign = [(name, kind) for name, kind, a, b in found if not (name.isascii() and head[a:b].isascii())]
    blamed = [name for name, kind in foreign if not name.isascii() or kind == "stringvector"]
    texts = [(a, b) for _, kind, a, b in found if kind == "string" and not _is_utf8(head[a:b])]
    if blamed or not texts:
        raise ValueError(
            f"{path}: the attribute {(blamed or ['?'])[0]!r} in the header is not UTF-8. Write it in ASCII."
        )
    for a, b in texts:
        patched[a:b] = bytes(byte if byte < 0x80 else ord("?") for byte in head[a:b])
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        with copy.open("r+b") as file:
            file.write(patched)
        yield copy
