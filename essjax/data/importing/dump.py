"""Clips of a dump that a recipe describes: finds the files, reads them, applies the conversions frame by frame."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data.importing import convert
from essjax.data.importing.facts import Facts, FrameFacts
from essjax.data.importing.files import fill, find_frames, index_frames, unlisted
from essjax.data.importing.images import Stored, buffer, radiance, read_images, repair, view_depth
from essjax.data.importing.motion import frame_motion
from essjax.data.importing.planes import channels_in, count_frames
from essjax.data.importing.recipe import Recipe
from essjax.data.importing.stream import Converted
from essjax.frames import Frame, gbuffers_of

MakeFacts = Callable[[str, Recipe, int, int], Facts]
"""(sequence as in the file names, recipe, width, height) -> facts of its frames."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecipeClip:
    """One sequence of a dump; a ``stream.Clip``.

    Attributes:
      name: of the sequence to write.
      digits: frame number -> as written in the names of the colour's files.
      others: the same of images whose files are named otherwise, as far as their numbers are written in another way.
      source: what the dataset keeps about where it comes from.
      recipe: files, channels and conventions.
      root: the dump's folder.
      reference_root: where the references are; None: the colour is its own reference.
      sequence: the name within the file names.
      images: those that are imported, a subset of ``recipe.channels``.
      facts: of each frame.
      repair: mend single NaN and infinite pixels, counted as "repaired".
    """

    name: str
    digits: Mapping[int, str]
    source: Mapping[str, Any]
    recipe: Recipe
    root: Path
    reference_root: Path | None
    sequence: str
    images: tuple[str, ...]
    facts: Facts
    others: Mapping[str, Mapping[int, str]] = dataclasses.field(default_factory=dict)
    repair: bool = False

    @property
    def numbers(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.digits)

    def path(self, image: str, number: int) -> Path:
        """Return the path of an image, or of the "reference"."""
        root = self.reference_root if image == "reference" and self.reference_root else self.root
        digits = self.others.get(image, {}).get(number, self.digits[number])
        return root / fill(self.recipe.pattern(image), self.sequence, digits)

    def files(self, number: int) -> list[Path]:
        """List the files that one frame is read from, there or not."""
        images = (*self.images, *(("reference",) if self.reference_root else ()))
        return list(dict.fromkeys(self.path(image, number) for image in images))

    def said(self, number: int) -> str:
        """Return the facts of a frame and of the one before, as far as they are not in its files."""
        if "metadata" not in self.recipe.files:
            return ""
        said = []
        for n in (number - 1, number):
            if n in self.digits:
                try:
                    said.append(dataclasses.asdict(self.facts(n, {})))
                except ValueError as error:  # the metadata lacks the frame: converting it says so
                    said.append({"missing": str(error)})
        return repr(said)

    def missing(self) -> list[Path]:
        """Files of the clip that are not there."""
        paths = dict.fromkeys(path for number in self.numbers for path in self.files(number))
        return [path for path in paths if not path.is_file()]

    def convert(self, number: int) -> Converted:
        """Read and convert one frame; a ValueError names the file or channel."""
        images, header, repaired = self._read(number, self.images)
        facts = self.facts(number, header)
        height, width = images["color"].shape[:2]
        jitter = self._jitter(number, facts, width, height)
        stored_motion = images.pop("motion")
        images = {name: convert.at_samples(image, width, height, jitter) for name, image in images.items()}
        color, counts = radiance(images.pop("color"), self.recipe, facts)
        depth = view_depth(images.pop("depth"), self.recipe, facts, jitter)
        hit = np.isfinite(depth)
        counts |= {"pixels": hit.size, "background": int(hit.size - np.count_nonzero(hit))}
        cut = facts.cut or number - 1 not in self.digits
        before = None if cut else self._jitter_before(number, width, height)
        motion, unwritten, still = frame_motion(
            stored_motion, images.pop("written", None), self.recipe.motion, facts, jitter, before, depth,
            self.path("motion", number),
        )  # fmt: skip
        rare = {"repaired": repaired, "unwritten": unwritten, "still": still}
        counts |= {name: count for name, count in rare.items() if count}
        converted = {name: buffer(name, image, hit, self.recipe) for name, image in images.items()}
        buffers = {name: image for name, (image, _) in converted.items()}
        counts["outside"] = sum(outside for _, outside in converted.values())
        frame = Frame(
            color=color,
            gbuffers=gbuffers_of({**buffers, "depth": depth}),
            motion=motion,
            jitter=jitter,
            cut=np.asarray(cut),
            exposure=None if facts.exposure is None else np.asarray(facts.exposure, np.float32),
            camera=facts.camera,
            reactive=buffers.get("reactive"),
        )
        if self.reference_root is None:
            return Converted(frame, color, counts)
        stored, _, repaired = self._read(number, ("reference",))
        reference, more = radiance(stored["reference"], self.recipe, facts)
        more |= {"repaired": repaired} if repaired else {}
        return Converted(frame, reference, {**counts, **{name: counts.get(name, 0) + more[name] for name in more}})

    def _read(self, number: int, names: Iterable[str]) -> tuple[dict[str, np.ndarray], Mapping[str, Any], int]:
        """Images as they are stored, the header of the first, and how many pixels were mended."""
        recipe = self.recipe
        wanted = {
            name: Stored(self.path(name, number), recipe.channels[name], number if recipe.stacked(name) else None)
            for name in names
        }
        images, header = read_images(wanted, recipe.packings)
        return images, header, sum(repair(name, image) for name, image in images.items()) if self.repair else 0

    def _jitter_before(self, number: int, width: int, height: int) -> np.ndarray:
        """Jitter of the frame before; asked for only where motion holds the difference."""
        if not self.recipe.motion.jittered:
            return np.zeros(2, np.float32)
        return self._jitter(number - 1, self.facts(number - 1, {}), width, height)

    def _jitter(self, number: int, facts: FrameFacts, width: int, height: int) -> np.ndarray:
        rule = self.recipe.jitter
        if rule.source == "none":
            return np.zeros(2, np.float32)
        if rule.source == "halton":
            stored = convert.halton((number % rule.length) + rule.first)
        elif facts.jitter is None:
            raise ValueError(
                f"{fill(self.recipe.files['metadata'], self.sequence)}, frame {number}: jitter is missing."
            )
        else:
            stored = facts.jitter
        pixels = convert.to_pixels(stored, rule.unit, width, height, y=rule.y)
        offset = convert.sample_offset(pixels, rule.sign).astype(np.float32)
        if not (np.abs(offset) <= 0.5).all():
            path = fill(self.recipe.files.get("metadata", ""), self.sequence) or self.path("color", number)
            raise ValueError(
                f"{self.root / path}, frame {number}: jitter: expected at most half a pixel, got {offset.tolist()} "
                f"pixels from {np.asarray(stored).tolist()} in {rule.unit}. Is that its unit ([jitter] in the recipe)?"
            )
        return offset


def open_dump(
    source: Path, recipe: Recipe, reference: Path | None, make_facts: MakeFacts, preset: str, *, repair: bool = False
) -> list[RecipeClip]:
    """Open the clips of a dump, in order of their names.

    Args:
      source: the dump's folder.
      recipe: of the dump; where the metadata of a sequence says that motion is dilated, its clip's says so too.
      reference: folder of the references; None: the recipe's, or else the colour.
      make_facts: of one sequence.
      preset: name, to be recorded.
      repair: see ``RecipeClip``.

    Raises:
      ValueError: no frames, or files are missing.
    """
    found = _numbered(source, recipe)
    reference_root = reference or (source if "reference" in recipe.files else None)
    others = {name: _other_digits(source, reference_root, recipe, name, digits) for name, digits in found.items()}
    first = {name: _first_readable(source, recipe, name, digits, others[name]) for name, digits in found.items()}
    present = [image for image in recipe.channels if all(image in images for images, _ in first.values())]
    clips = []
    for sequence, digits in found.items():
        width, height = first[sequence][1]
        facts = make_facts(sequence, recipe, width, height)
        dilated = recipe.motion.dilated or _dilated(facts, digits)
        of_clip = dataclasses.replace(recipe, motion=dataclasses.replace(recipe.motion, dilated=dilated))
        clips.append(
            RecipeClip(
                name=sequence or source.resolve().name,
                digits=digits,
                source={"preset": preset, "reference": "own" if reference_root else "color", **of_clip.record()},
                recipe=of_clip,
                root=source,
                reference_root=reference_root,
                sequence=sequence,
                images=tuple(present),
                facts=facts,
                others=others[sequence],
                repair=repair,
            )
        )
    return clips


def _numbered(source: Path, recipe: Recipe) -> dict[str, dict[int, str]]:
    """Sequence -> frame number -> digits, of frames in files of their own or all in one."""
    found = find_frames(source, recipe.pattern("color"))
    if not recipe.stacked("color"):
        return found
    count = lambda name: count_frames(source / fill(recipe.pattern("color"), name), recipe.channels["color"][0])
    return {name: {number: str(number) for number in range(count(name))} for name in found}


def _other_digits(
    source: Path, reference_root: Path | None, recipe: Recipe, sequence: str, digits: Mapping[int, str]
) -> dict[str, dict[int, str]]:
    """Image -> number -> digits, where an image's files pad their numbers otherwise than the colour's do."""
    others = {}
    for image in (*recipe.channels, *(("reference",) if reference_root else ())):
        pattern, root = recipe.pattern(image), reference_root if image == "reference" and reference_root else source
        if recipe.stacked(image) or (pattern == recipe.pattern("color") and root == source):
            continue
        written = index_frames(root, pattern).get(sequence, {})
        different = {number: text for number, text in written.items() if digits.get(number, text) != text}
        if different:
            others[image] = different
    return others


def unlisted_files(clips: Iterable[RecipeClip]) -> list[str]:
    """Files beside those of the clips that nothing takes; they may be frames under another name."""
    found: dict[str, None] = {}
    for root, recipe in {clip.root: clip.recipe for clip in clips}.items():
        names = ("color", *recipe.channels, *(("reference",) if "reference" in recipe.files else ()))
        found |= dict.fromkeys(unlisted(root, [recipe.pattern(name) for name in names]))
    return list(found)


def _dilated(facts: Facts, numbers: Iterable[int]) -> bool:
    """Whether the metadata says so, at the first frame that it knows."""
    for number in numbers:
        try:
            return facts(number, {}).dilated
        except ValueError:  # raised again, with the frame's number, when that is converted
            continue
    return False


def _first_readable(
    source: Path,
    recipe: Recipe,
    sequence: str,
    digits: Mapping[int, str],
    others: Mapping[str, Mapping[int, str]],
) -> tuple[set[str], tuple[int, int]]:
    """Which images the first readable frame of a sequence has, and its (width, height)."""
    error = None
    for number, text in digits.items():
        written = {image: others.get(image, {}).get(number, text) for image in ("color", *recipe.optional)}
        paths = {image: source / fill(recipe.pattern(image), sequence, written[image]) for image in written}
        frame = number if recipe.stacked("color") else None
        try:
            files = {path: channels_in(path, frame) for path in dict.fromkeys(paths.values()) if path.is_file()}
            color = read_images({"color": Stored(paths["color"], recipe.channels["color"], frame)})[0]["color"]
        except ValueError as problem:
            error = error or problem
            continue
        there = {image for image, path in paths.items() if set(recipe.channels[image]) <= set(files.get(path, ()))}
        images = {image for image in recipe.channels if image not in ("reference", *recipe.optional)}
        return images | there, (color.shape[1], color.shape[0])
    raise ValueError(f"sequence {sequence!r}: no frame can be read. The first: {error}")
