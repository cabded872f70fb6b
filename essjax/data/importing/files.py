"""Which sequences and frames a dump holds: paths that match a pattern with ``{sequence}`` and ``{frame}``."""

import glob
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

_PLACEHOLDERS = {"{sequence}": "(?P<sequence>[^/]*?)", "{frame}": r"(?P<frame>\d+)"}


def fill(pattern: str, sequence: str, frame: str = "") -> str:
    """Fill in the path that a pattern means."""
    return pattern.replace("{sequence}", sequence).replace("{frame}", frame)


def _regex(pattern: str) -> re.Pattern:
    text, seen = "", set()
    for part in re.split(r"(\{sequence\}|\{frame\})", pattern):
        if part in _PLACEHOLDERS and part in seen:
            text += f"(?P={part[1:-1]})"
        else:
            text += _PLACEHOLDERS.get(part, re.escape(part))
        seen.add(part)
    return re.compile(text)


def hidden(relative: Path) -> bool:
    """Whether a file is hidden, as the ``._*`` are that macOS leaves beside each file."""
    return any(part.startswith(".") for part in relative.parts)


def _like(root: Path, pattern: str) -> list[Path]:
    """Files that a pattern means if anything could stand for the frame; hidden ones are none."""
    found = (path.relative_to(root) for path in root.glob(fill(glob.escape(pattern), "*", "*")))
    return sorted(path for path in found if not hidden(path))


def index_frames(root: Path, pattern: str) -> dict[str, dict[int, str]]:
    """Sequence -> frame number -> the digits as they are written in the file name, all sorted; may be empty.

    Args:
      root: the dump's folder.
      pattern: path below it; without ``{sequence}`` there is one, named "". Without ``{frame}`` no frame is listed.

    Raises:
      ValueError: two files are the same frame.
    """
    regex, found = _regex(pattern), {}
    for path in _like(root, pattern):
        match = regex.fullmatch(path.as_posix())
        if match is None:
            continue
        frames = found.setdefault(match.groupdict().get("sequence", ""), {})
        digits = match.groupdict().get("frame")
        if digits is None:
            continue
        if int(digits) in frames:
            raise ValueError(f"{root / path}: frame {int(digits)} is there twice, also as {frames[int(digits)]}.")
        frames[int(digits)] = digits
    return {sequence: dict(sorted(frames.items())) for sequence, frames in sorted(found.items())}


def find_frames(root: Path, pattern: str) -> dict[str, dict[int, str]]:
    """``index_frames``, or a ValueError if nothing matches."""
    found = index_frames(root, pattern)
    if not found:
        there = sorted(p.relative_to(root).as_posix() for p in root.glob("*"))[:5] if root.is_dir() else []
        raise ValueError(
            f"{root}: expected files named {pattern}, found none (there is {', '.join(there) or 'nothing'}). "
            "Is this the right folder? Another naming: give a recipe with [files] (docs/guides/importing.md)."
        )
    return found


def unlisted(root: Path, patterns: Iterable[str]) -> list[str]:
    """Files like those of the patterns (same folder and ending) that none of them takes: other names and numbers."""
    patterns = list(dict.fromkeys(patterns))
    taken = [_regex(pattern) for pattern in patterns]
    found = {}
    for pattern in patterns:
        place = PurePosixPath(pattern)
        for path in _like(root, (place.parent / f"{{frame}}{place.suffix}").as_posix()):
            name = path.as_posix()
            if not any(regex.fullmatch(name) for regex in taken):
                found[name] = None
    return sorted(found)
