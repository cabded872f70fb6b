"""Which sequences and frames a dump holds: paths that match a pattern with ``{sequence}`` and ``{frame}``."""

import glob
import re
from collections.abc import Mapping
from pathlib import Path

_PLACEHOLDERS = {"{sequence}": "(?P<sequence>[^/]*?)", "{frame}": r"(?P<frame>\d+)"}


def fill(pattern: str, sequence: str, frame: str = "") -> str:
    """The path that a pattern means."""
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


def find_frames(root: Path, pattern: str) -> Mapping[str, Mapping[int, str]]:
    """Sequence -> frame number -> the digits as they are written in the file name, all sorted.

    Args:
      root: the dump's folder.
      pattern: path below it; without ``{sequence}`` there is one, named "".

    Raises:
      ValueError: nothing matches, or two files are the same frame.
    """
    regex, found = _regex(pattern), {}
    for path in root.glob(fill(glob.escape(pattern), "*", "*")):
        match = regex.fullmatch(path.relative_to(root).as_posix())
        if match is None:
            continue
        sequence, digits = match.groupdict().get("sequence", ""), match["frame"]
        frames = found.setdefault(sequence, {})
        if int(digits) in frames:
            raise ValueError(f"{path}: frame {int(digits)} is there twice, also as {frames[int(digits)]}.")
        frames[int(digits)] = digits
    if not found:
        there = sorted(p.relative_to(root).as_posix() for p in root.glob("*"))[:5] if root.is_dir() else []
        raise ValueError(
            f"{root}: expected files named {pattern}, found none (there is {', '.join(there) or 'nothing'}). "
            "Is this the right folder? Another naming: give a recipe with [files] (docs/guides/importing.md)."
        )
    return {sequence: dict(sorted(frames.items())) for sequence, frames in sorted(found.items())}
