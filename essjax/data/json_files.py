"""JSON files: written atomically, read whole, and what they may hold: errors name file and key."""

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from essjax.files import atomic


class Kind(NamedTuple):
    """What a value may be.

    Attributes:
      expected: said in errors.
      fits: whether a value is one.
    """

    expected: str
    fits: Callable[[Any], bool]


FLAG = Kind("true or false", lambda value: isinstance(value, bool))
TEXT = Kind("a text", lambda value: isinstance(value, str))
OBJECT = Kind("an object", lambda value: isinstance(value, dict))
LIST = Kind("a list", lambda value: isinstance(value, list))


def is_name(value: Any) -> bool:
    """Whether it may be the name of a folder: not hidden, and no path that leads elsewhere."""
    plain = isinstance(value, str) and 0 < len(value) <= 200 and "\\" not in value and "\0" not in value
    return plain and value == Path(value).name and not value.startswith(".")


NAME = Kind("a plain folder name", is_name)


def whole(least: int, most: int) -> Kind:
    """Return the kind of whole numbers, both bounds included."""
    return Kind(
        f"a whole number in {least}..{most}",
        lambda value: isinstance(value, int) and not isinstance(value, bool) and least <= value <= most,
    )


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300 and math.isfinite(value)  # whole numbers have no end in JSON


NUMBER = Kind("a number", _is_number)
POSITIVE = Kind("a number above 0", lambda value: _is_number(value) and value > 0)


SIDE = whole(1, 1 << 16)
SCALE = Kind(
    "a number in 1..64 or [width, height]",
    lambda value: (
        len(value) == 2 and all(map(SIDE.fits, value))
        if isinstance(value, list)
        else POSITIVE.fits(value) and 1 <= value <= 64
    ),
)


def _flat(value: Any) -> Iterable[Any]:
    """Numbers of lists in lists, two deep."""
    for part in value:
        yield from part if isinstance(part, list) else (part,)


def numbers(count: int, most: float = math.inf) -> Kind:
    """Return the kind of lists (also of lists) of so many numbers, each at most ``most`` from 0."""
    return Kind(
        f"{count} numbers" + (f" in -{most:g}..{most:g}" if math.isfinite(most) else ""),
        lambda value: (
            isinstance(value, list)
            and len(found := list(_flat(value))) == count
            and all(_is_number(each) and abs(each) <= most for each in found)
        ),
    )


def or_null(kind: Kind) -> Kind:
    """Return the kind of what may be left open."""
    return Kind(f"{kind.expected} or null", lambda value: value is None or kind.fits(value))


def check(where: str, content: Any, kinds: Mapping[str, Kind], *, optional: Collection[str] = ()) -> None:
    """Raise a ValueError that begins with ``where`` unless ``content`` is an object that holds what ``kinds`` says.

    Other keys are left alone.

    Args:
      where: file, and what in it.
      content: of a JSON file.
      kinds: key -> what it may hold.
      optional: keys that may be absent.
    """
    if not isinstance(content, dict):
        raise ValueError(f"{where}: expected an object, got {shown(content)}.")
    missing = [key for key in kinds if key not in content and key not in optional]
    if missing:
        many = len(missing) > 1
        raise ValueError(f"{where}: the field{'s' * many} {', '.join(missing)} {'are' if many else 'is'} missing.")
    for key, kind in kinds.items():
        if key in content and not kind.fits(content[key]):
            raise ValueError(f"{where}: {key}: expected {kind.expected}, got {shown(content[key])}.")


def shown(value: Any) -> str:
    """Show a value in an error, however large it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # numbers of thousands of digits, lists of thousands of lists
        return f"a {type(value).__name__} that is too large to show"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _format(content: Mapping) -> str:
    """One line per field and per record of a list; ``indent`` would put every number of a matrix on its own."""
    lines = []
    for key, value in content.items():
        text = json.dumps(value)
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], Mapping):
            text = "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def write_json(path: Path, content: Mapping) -> None:
    """Write JSON atomically."""
    with atomic(path) as temporary:
        temporary.write_text(_format(content), encoding="utf-8")


def read_json(path: Path) -> dict:
    """Read a JSON object; missing and damaged files are ValueErrors that name the file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_unique)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: not found. Is this the right folder, and is the data complete?") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, cannot read it ({error!s:.200}).") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, found a {type(content).__name__}.")
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object of its members; of two with one name, one would be lost."""
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = next(key for n, (key, _) in enumerate(pairs) if any(key == other for other, _ in pairs[:n]))
        raise ValueError(f"the key {twice!r} is there twice")
    return content
