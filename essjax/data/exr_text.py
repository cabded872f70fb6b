"""Text in EXR headers that is not UTF-8, such as an owner in Latin-1, which the OpenEXR package refuses."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
