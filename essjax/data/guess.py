"""``essjax import DUMP OUT --guess``: a recipe for a dump that nobody described, tried on its own pictures.

Names and ranges of values give a first recipe (``importing.draft``). A few frames are imported with it, and what
pictures can decide is decided on them as ``check`` does: sign, axes and unit of motion, jitter, the kind of depth.
"""

import itertools
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from essjax.data.check import check_dataset
from essjax.data.check.compare import Comparison
from essjax.data.check.jitter import FEW, OFF, SHIFT_COSTS, JitterCheck, spread
from essjax.data.check.motion import rendered_errors, warp_errors
from essjax.data.check.pairs import Step, steps
from essjax.data.check.surfaces import guide_errors, interior, lands_inside, regions_of
from essjax.data.importing import import_dataset
from essjax.data.importing.convert import halton
from essjax.data.importing.draft import CERTAIN, LIKELY, UNKNOWN, Draft, make_draft
from essjax.data.importing.inventory import Inventory, take_stock
from essjax.data.layout import Dataset
from essjax.sizes import Size, ratios
from essjax.warp import inside_mask

FRAMES = 8
"""Frames that are tried."""
SURE = 1.5
"""dB by which a reading must win to be certain."""
FITS = 0.07
"""LR pixels by which a pattern of jitter may miss what frames show."""
KNOWN = {
    "blender": ("meta.json", "lr.*.exr"),
    "extranet": ("*PreTonemapHDRColor.*.exr",),
    "arm-nss": ("x*/color", "ground_truth"),
    "stssnet": ("NPY/compressed.*.npy",),
}
"""Preset -> what its dumps hold."""


class Guess(NamedTuple):
    """The readings that were found.

    Attributes:
      preset: of a producer that is known by its files; "generic": the recipe says it.
      content: of the recipe, as in its TOML.
      notes: ``table.key`` -> (certain, likely or unknown; why).
      verdicts: row of the check -> its verdict, with this recipe.
    """

    preset: str
    content: Mapping[str, Any]
    notes: Mapping[str, tuple[str, str]]
    verdicts: Mapping[str, str]


class _Reading(NamedTuple):
    """How motion could be meant: keys of the recipe, and what stored values (x, y) are multiplied with."""

    keys: Mapping[str, Any]
    swapped: bool
    factor: np.ndarray


def _readings(size: Size, output: Size) -> list[_Reading]:
    height, width = size
    units = {
        "pixels": ({"unit": "pixels"}, (1.0, 1.0)),
        "uv": ({"unit": "uv"}, (width, height)),
        "ndc": ({"unit": "ndc"}, (width / 2, height / 2)),
        "twice": ({"unit": "uv", "scale": 2.0}, (2 * width, 2 * height)),
    }
    if output != size:
        along_x, along_y = ratios(size, output)
        units["reference"] = ({"unit": "pixels", "resolution": [output[1], output[0]]}, (1 / along_x, 1 / along_y))
    found = []
    for (keys, factor), sign, up, swapped in itertools.product(units.values(), (1, -1), (False, True), (False, True)):
        keys = {**keys, "sign": "previous-current" if sign > 0 else "current-previous", "y": "up" if up else "down"}
        found.append(_Reading(keys, swapped, np.array([sign, -sign if up else sign]) * np.array(factor)))
    return found


def guess_recipe(source: Path) -> Guess:
    """Find out what a dump is.

    Raises:
      ValueError: there are no images, or nothing says which is colour, depth or motion.
    """
    for preset, names in KNOWN.items():
        if all(any(source.glob(name)) for name in names):
            return Guess(preset, {}, {"preset": (CERTAIN, f"it holds {' and '.join(names)}")}, {})
    inventory = take_stock(source)
    if any(group.channels[0].startswith("colour_linear") for group in inventory.groups):
        return Guess("arm-gym", {}, {"preset": (CERTAIN, "it holds colour_linear")}, {})
    draft = make_draft(inventory)
    with _few_frames(source, inventory) as dump:
        with _imported(dump, draft) as dataset:
            _find_motion(draft, dataset, list(steps(dataset, dataset.info.name, 0)))
        _find_jitter(draft, dump, inventory)
        verdicts = _settle(draft, dump)
    _weigh(draft, verdicts)
    return Guess("generic", draft.content, draft.notes, verdicts)


@contextmanager
def _few_frames(source: Path, inventory: Inventory) -> Iterator[Path]:
    """Make a dump of links to the first frames of the first sequence."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / source.resolve().name
        wanted = [frames[n] for frames in inventory.files.values() for n in inventory.numbers[:FRAMES]]
        first = inventory.sequences[0] if inventory.sequences else ""
        if inventory.metadata:
            wanted.append(source / inventory.metadata.replace("{sequence}", first))
        for path in dict.fromkeys(wanted):
            link = root / path.relative_to(source)
            link.parent.mkdir(parents=True, exist_ok=True)
            os.symlink(path.resolve(), link)
        yield root


@contextmanager
def _imported(dump: Path, draft: Draft) -> Iterator[Dataset]:
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "recipe.toml"
        recipe.write_text(to_toml(draft.content, {}), encoding="utf-8")
        yield import_dataset(dump, Path(folder) / "out", "generic", recipe=recipe, skip_broken=True).dataset


def _find_motion(draft: Draft, dataset: Dataset, frames: list[Step]) -> None:
    """Set sign, axes and unit of motion to what explains the pictures best."""
    info = dataset.info
    readings = _readings(info.size, info.output)
    names = tuple(map(str, range(len(readings))))
    own, guided, rendered = (Comparison(names) for _ in range(3))
    for step in frames:
        if step.before is None:
            continue
        stored = np.asarray(step.now.motion, np.float32)
        motions = np.stack(
            [(stored[..., ::-1] if r.swapped else stored) * r.factor.astype(np.float32) for r in readings]
        )
        usable = (np.asarray(inside_mask(motions))[..., 0] > 0) & interior(step.now.gbuffers)
        usable &= lands_inside(step, motions)
        regions = regions_of(step)
        zero = np.zeros(2, np.float32)
        if info.source.get("reference") != "color":
            errors = [warp_errors(step.reference_before, step.reference, m, zero, step.key)[..., 0] for m in motions]
            own.add(np.stack(errors), motions, usable, regions)
        else:
            rendered.add(np.stack([rendered_errors(step, m) for m in motions]), motions, usable, regions)
        guides = guide_errors(step, motions, np.ones(len(readings), bool))
        if guides is not None:
            guided.add(guides, motions, usable, regions)
    choices = [(c, *_winner(c)) for c in (own, guided, rendered) if c.count.any()]
    if not choices:
        for key in ("sign", "y", "unit"):
            draft.notes[f"motion.{key}"] = (UNKNOWN, "nothing moves, or nothing is seen twice")
        return
    comparison, best, margin = max(choices, key=lambda choice: choice[2])
    reading = readings[best]
    undecided = [r for b, r in enumerate(readings) if b != best and not comparison.decidable(best, b)]
    agreed = all(other == best for _, other, _ in choices)
    for key, value in reading.keys.items():
        open_ = any(r.keys.get(key) != value for r in undecided)
        sure = UNKNOWN if margin <= 0 else CERTAIN if margin >= SURE and agreed and not open_ else LIKELY
        draft.set("motion", key, value, sure, f"{margin:.1f} dB before the next reading that can be told from it")
    if reading.swapped:
        channels = draft.content["channels"]["motion"]
        half = len(channels) // 2
        draft.set("channels", "motion", channels[half:] + channels[:half], LIKELY, "y comes first")


def _winner(comparison: Comparison) -> tuple[int, float]:
    """Return the reading whose least margin over the others is largest, and that margin, dB."""
    n = len(comparison.names)
    worst = [
        min((comparison.margin(a, b) for b in range(n) if comparison.decidable(a, b)), default=-np.inf)
        for a in range(n)
    ]
    best = int(np.argmax(worst))
    return best, float(worst[best])


def _find_jitter(draft: Draft, dump: Path, inventory: Inventory) -> None:
    """Set the jitter to what frames show of their references."""
    if "jitter" in inventory.fields:
        draft.set("jitter", "source", "metadata", CERTAIN, "the JSON has a jitter for each frame")
        try:
            with _imported(dump, draft) as dataset:
                _fit_metadata(draft, _compared(dataset)[0], dataset)
        except ValueError as error:  # beyond half a pixel
            draft.content.pop("jitter")
            draft.notes["jitter.source"] = (
                UNKNOWN,
                f"the JSON has a jitter, which cannot be one in pixels ({error})"[:160],
            )
        return
    with _imported(dump, draft) as dataset:
        if dataset.info.source.get("reference") == "color":
            draft.notes["jitter.source"] = (UNKNOWN, "without references no frame shows its jitter")
            return
        checked, numbers = _compared(dataset)
    if len(checked.found) < FEW:
        draft.notes["jitter.source"] = (UNKNOWN, "the pictures have too little detail")
        return
    found = np.array(checked.found)
    if spread(found) < FITS and np.linalg.norm(np.median(found, axis=0)) < FITS:
        draft.set("jitter", "source", "none", CERTAIN, "frames and references show the same places")
        return
    fits = {}
    for first, length in itertools.product(range(17), (8, 16, 32, 64, 1024)):
        pattern = np.array([halton((n % length) + first) for n in numbers]) if first else None
        for sign, y in itertools.product((1, -1), (1, -1)):
            if pattern is not None:
                fits[first, length, sign, y] = float(np.abs(found - pattern * [sign, sign * y]).mean())
    (first, length, sign, y), off = min(fits.items(), key=lambda item: item[1])
    if off > FITS:
        draft.notes["jitter.source"] = (
            UNKNOWN,
            f"frames are jittered (by {spread(found):.2f} px), by no known pattern",
        )
        return
    keys = {"source": "halton", "first": first, "length": length, "sign": "sample" if sign > 0 else "image"}
    for key, value in {**keys, "y": "down" if y > 0 else "up"}.items():
        draft.set("jitter", key, value, LIKELY, f"{off:.2f} px off what {len(found)} frames show")


def _compared(dataset: Dataset) -> tuple[JitterCheck, list[int]]:
    check, numbers = JitterCheck(), []
    for step in steps(dataset, dataset.info.name, 0):
        before = len(check.found)
        check.add_frame(step)
        numbers += [step.number] * (len(check.found) - before)
    return check, numbers


def _fit_metadata(draft: Draft, checked: JitterCheck, dataset: Dataset) -> None:
    """Which sign, axis and unit make what the metadata says what the frames show."""
    if dataset.info.source.get("reference") == "color" or len(checked.found) < FEW:
        for key in ("sign", "y", "unit"):
            draft.notes[f"jitter.{key}"] = (UNKNOWN, "no references with detail to compare with")
        return
    found, stated = np.array(checked.found), np.array(checked.stated)
    sizes = {"pixels": (1, 1), "uv": (dataset.info.width, dataset.info.height)}
    sizes["ndc"] = (dataset.info.width / 2, dataset.info.height / 2)
    fits = {}
    for (unit, size), sign, y in itertools.product(sizes.items(), (1, -1), (1, -1)):
        rest = found - stated * np.array(size) * [sign, sign * y]
        fits[unit, sign, y] = spread(rest) + SHIFT_COSTS * float(np.linalg.norm(np.median(rest, axis=0)))
    ranked = sorted(fits, key=lambda key: fits[key])
    unit, sign, y = ranked[0]
    best, second = fits[ranked[0]], fits[ranked[1]]
    sure = CERTAIN if best < OFF and second > 2 * OFF else LIKELY if best < OFF else UNKNOWN
    for key, value in {"unit": unit, "sign": "sample" if sign > 0 else "image", "y": "down" if y > 0 else "up"}.items():
        draft.set("jitter", key, value, sure, f"{best:.2f} px off what {len(found)} frames show, the next {second:.2f}")


def _settle(draft: Draft, dump: Path) -> dict[str, str]:
    """Check what the recipe makes of the frames, and take back what the check calls wrong; its verdicts at the end."""
    verdicts: dict[str, str] = {}
    for _ in range(3):
        with _imported(dump, draft) as dataset:
            findings = check_dataset(dataset, pairs=0).findings
        verdicts = {finding.check: finding.verdict for finding in findings}
        wrong = {finding.check: finding.fix for finding in findings if finding.verdict == "wrong"}
        depth = draft.content["depth"]
        if "depth is reversed" in wrong.get("depth", "") and depth["kind"] in ("reversed", "forward"):
            other = "forward" if depth["kind"] == "reversed" else "reversed"
            draft.set("depth", "kind", other, LIKELY, "what hides is nearer then")
        elif "along the ray" in wrong.get("depth", ""):
            draft.set("depth", "kind", "distance", LIKELY, "it is the distance along the ray")
        elif "left-handed" in wrong.get("normals", ""):
            draft.set("world", "handedness", "left", LIKELY, "normals fit the surfaces then")
        else:
            break
    return verdicts


def _weigh(draft: Draft, verdicts: Mapping[str, str]) -> None:
    """Nothing is certain that the check does not confirm."""
    motion = [verdicts.get(row) for row in ("motion, references", "motion, rendered frames")]
    rows = {"motion": motion, "jitter": [verdicts.get("jitter, references")], "depth": [verdicts.get("depth")]}
    for name, (sure, why) in list(draft.notes.items()):
        found = rows.get(name.partition(".")[0], ["ok"])
        if "wrong" in found:
            draft.notes[name] = (UNKNOWN, f"{why}; the check contradicts it")
        elif sure == CERTAIN and "ok" not in found and name != "depth.background" and name != "jitter.source":
            draft.notes[name] = (LIKELY, why)
    if verdicts.get("depth") == "ok" and draft.notes.get("depth.kind", (UNKNOWN,))[0] != CERTAIN:
        why = draft.notes["depth.kind"][1]
        draft.notes["depth.kind"] = (LIKELY, f"{why}; what hides is nearer")


def to_toml(content: Mapping[str, Any], notes: Mapping[str, tuple[str, str]]) -> str:
    """Write a recipe as TOML, with a comment on what is not certain and why."""

    def value(item: Any) -> str:
        if isinstance(item, bool):
            return str(item).lower()
        if isinstance(item, (list, tuple)):
            return f"[{', '.join(map(value, item))}]"
        return f'"{item}"' if isinstance(item, str) else f"{item!r}"

    lines = [f"{key} = {value(item)}" for key, item in content.items() if not isinstance(item, Mapping)]
    for table, entries in content.items():
        if isinstance(entries, Mapping):
            lines += ["", f"[{table}]"]
            for key, item in entries.items():
                sure, why = notes.get(f"{table}.{key}", ("", ""))
                lines.append(f"{key} = {value(item)}" + (f"  # {sure}: {why}" if sure else ""))
    said = {f"{table}.{key}" for table, entries in content.items() if isinstance(entries, Mapping) for key in entries}
    lines += [f"# {name}: {sure}: {why}" for name, (sure, why) in notes.items() if name not in said]
    return "\n".join(lines).strip() + "\n"
