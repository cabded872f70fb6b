"""Clips of a dump that a recipe describes: finds the files, reads them, applies the conversions frame by frame."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from essjax.cameras import Camera, pixel_positions, static_motion
from essjax.data import exr
from essjax.data.importing import convert
from essjax.data.importing.facts import Facts, FrameFacts
from essjax.data.importing.files import fill, find_frames
from essjax.data.importing.images import buffer, radiance, read_images, view_depth
from essjax.data.importing.recipe import Recipe
from essjax.data.importing.stream import Converted
from essjax.frames import Frame, gbuffers_of
from essjax.typing import Jitter, Motion, Plane

MakeFacts = Callable[[str, Recipe, int, int], Facts]
"""(sequence as in the file names, recipe, width, height) -> facts of its frames."""


@jax.jit
def camera_motion(camera: Camera, previous: Camera, jitter: Jitter, depth: Plane) -> Motion:
    """Motion of a static world, at the jittered samples."""
    height, width = depth.shape[:2]
    return static_motion(camera, previous, pixel_positions(height, width, jitter), depth)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecipeClip:
    """One sequence of a dump; a ``stream.Clip``.

    Attributes:
      name: of the sequence to write.
      digits: frame number -> as written in the file names.
      source: what the dataset keeps about where it comes from.
      recipe: files, channels and conventions.
      root: the dump's folder.
      reference_root: where the references are; None: the colour is its own reference.
      sequence: the name within the file names.
      images: those that are imported, a subset of ``recipe.channels``.
      facts: of each frame.
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

    @property
    def numbers(self) -> tuple[int, ...]:
        """Frame numbers, ascending."""
        return tuple(self.digits)

    def path(self, image: str, number: int) -> Path:
        """The file of an image, or of the "reference"."""
        root = self.reference_root if image == "reference" and self.reference_root else self.root
        return root / fill(self.recipe.pattern(image), self.sequence, self.digits[number])

    def files(self, number: int) -> list[Path]:
        """What one frame is read from, there or not."""
        images = (*self.images, *(("reference",) if self.reference_root else ()))
        return list(dict.fromkeys(self.path(image, number) for image in images))

    def said(self, number: int) -> str:
        """The facts of a frame and of the one before, as far as they are not in its files."""
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
        images, header = read_images(
            {image: (self.path(image, number), self.recipe.channels[image]) for image in self.images}
        )
        facts = self.facts(number, header)
        height, width = images["color"].shape[:2]
        jitter = self._jitter(number, facts, width, height)
        color, counts = radiance(images.pop("color"), self.recipe, facts)
        depth = view_depth(images.pop("depth"), self.recipe, facts, jitter)
        hit = np.isfinite(depth)
        counts |= {"pixels": hit.size, "background": int(hit.size - np.count_nonzero(hit))}
        cut = facts.cut or number - 1 not in self.digits
        motion, unwritten = self._motion(images.pop("motion"), number, facts, jitter, depth, cut)
        if self.recipe.motion.encoding in convert.RAW_VELOCITY:
            counts["unwritten"] = unwritten
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
        path = self.path("reference", number)
        stored, _ = read_images({"reference": (path, self.recipe.channels["reference"])})
        reference, more = radiance(stored["reference"], self.recipe, facts)
        return Converted(frame, reference, {**counts, **{name: counts[name] + more[name] for name in more}})

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
        return convert.sample_offset(pixels, rule.sign).astype(np.float32)

    def _motion(
        self, stored: np.ndarray, number: int, facts: FrameFacts, jitter: np.ndarray, depth: np.ndarray, cut: bool
    ) -> tuple[np.ndarray, int]:
        """Motion in essjax's convention, and how many pixels had none of their own."""
        rule, (height, width) = self.recipe.motion, stored.shape[:2]
        written = np.ones((1, 1, 1), bool)
        if rule.encoding != "plain":
            stored, written = convert.decode_velocity(stored, rule.encoding)
        pixels = convert.to_pixels(stored * np.float32(rule.scale), rule.unit, width, height, x=rule.x, y=rule.y)
        if rule.resolution is not None:
            pixels *= np.asarray([width / rule.resolution[0], height / rule.resolution[1]], np.float32)
        motion = convert.to_previous(pixels, rule.sign)
        if rule.jittered and not cut:
            before = self._jitter(number - 1, self.facts(number - 1, {}), width, height)
            motion = convert.without_jitter(motion, jitter, before)
        if written.all() or cut:
            return np.where(written, motion, 0.0).astype(np.float32), int((~written).sum())
        if facts.camera is None or facts.previous is None:
            raise ValueError(
                f"{self.path('motion', number)}: {int((~written).sum())} pixels have no velocity: there the motion "
                "follows from the cameras, which the file's header does not hold. Let the engine write velocity for "
                "everything, or give the cameras ([files] metadata)."
            )
        static = np.asarray(camera_motion(facts.camera, facts.previous, jitter, depth))
        return np.where(written, motion, static), int((~written).sum())


def open_dump(
    source: Path, recipe: Recipe, reference: Path | None, make_facts: MakeFacts, preset: str
) -> list[RecipeClip]:
    """The clips of a dump, in order of their names.

    Args:
      source: the dump's folder.
      recipe: of the dump; where the metadata of a sequence says that motion is dilated, its clip's says so too.
      reference: folder of the references; None: the recipe's, or else the colour.
      make_facts: of one sequence.
      preset: name, to be recorded.

    Raises:
      ValueError: no frames, or files are missing.
    """
    found = find_frames(source, recipe.pattern("color"))
    reference_root = reference or (source if "reference" in recipe.files else None)
    first = {sequence: _first_readable(source, recipe, sequence, digits) for sequence, digits in found.items()}
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
            )
        )
    return clips


def _dilated(facts: Facts, numbers: Iterable[int]) -> bool:
    """Whether the metadata says so, at the first frame that it knows."""
    for number in numbers:
        try:
            return facts(number, {}).dilated
        except ValueError:  # raised again, with the frame's number, when that is converted
            continue
    return False


def _first_readable(
    source: Path, recipe: Recipe, sequence: str, digits: Mapping[int, str]
) -> tuple[set[str], tuple[int, int]]:
    """Which images the first readable frame of a sequence has, and its (width, height)."""
    error = None
    for text in digits.values():
        paths = {image: source / fill(recipe.pattern(image), sequence, text) for image in ("color", *recipe.optional)}
        try:
            files = {path: exr.read(path) for path in dict.fromkeys(paths.values()) if path.is_file()}
            color = exr.read(paths["color"], recipe.channels["color"])[recipe.channels["color"][0]]
        except ValueError as problem:
            error = error or problem
            continue
        there = {image for image, path in paths.items() if set(recipe.channels[image]) <= set(files.get(path, ()))}
        images = {image for image in recipe.channels if image not in ("reference", *recipe.optional)}
        return images | there, (color.shape[1], color.shape[0])
    raise ValueError(f"sequence {sequence!r}: no frame can be read. The first: {error}")
