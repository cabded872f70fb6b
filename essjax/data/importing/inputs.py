"""What a frame of a dump is made from: its files and what the metadata says. A second import notices a change."""

import dataclasses
import hashlib
from pathlib import Path

from essjax.data.importing.blender import BlenderClip
from essjax.data.importing.dump import RecipeClip


def files_of(clip: BlenderClip | RecipeClip, number: int) -> list[Path]:
    """The files of one frame, there or not."""
    if isinstance(clip, BlenderClip):
        return clip.files(number)
    images = (*clip.images, *(("reference",) if clip.reference_root else ()))
    return list(dict.fromkeys(clip.path(image, number) for image in images))


def made_from(clip: BlenderClip | RecipeClip, number: int) -> str:
    """A short text that changes with the name, size or date of a file of the frame, and with its metadata."""
    said = clip.said(number) if isinstance(clip, BlenderClip) else _said(clip, number)
    files = [(path.name, *_size_and_date(path)) for path in files_of(clip, number)]
    return hashlib.blake2b(repr((files, said)).encode(), digest_size=8).hexdigest()


def _size_and_date(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except FileNotFoundError:
        return -1, -1
    return stat.st_size, stat.st_mtime_ns


def _said(clip: RecipeClip, number: int) -> str:
    """The facts of a frame and of the one before, as far as they are not in its files."""
    if "metadata" not in clip.recipe.files:
        return ""
    said = []
    for n in (number - 1, number):
        if n in clip.digits:
            try:
                said.append(dataclasses.asdict(clip.facts(n, {})))
            except ValueError as error:  # the metadata lacks the frame: converting it says so
                said.append({"missing": str(error)})
    return repr(said)
