"""``python -m tools.verdicts.scramble``: clips in conventions drawn by lot, and what ``--guess`` makes of them."""

import argparse
import json
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from essjax.color import srgb_encode
from essjax.data import exr, import_dataset, read_dataset, read_sequence
from essjax.data.guess import guess_recipe, to_toml
from essjax.data.importing.draft import CERTAIN, LIKELY, UNKNOWN
from essjax.frames import Sequence
from tools.verdicts.clips import CLIPS, render

NEAR = 0.1
PAGE = Path(__file__).parent / "GUESSES.md"
WORDS = {
    "color": ("color", "beauty", "rgb", "Colour", "lr"),
    "depth": ("depth", "z", "Depth", "zbuffer"),
    "motion": ("motion", "velocity", "mv", "MotionVectors"),
    "normal": ("normal", "N", "WorldNormal"),
    "base_color": ("albedo", "basecolor", "BaseColor"),
    "reference": ("reference", "gt", "final", "hr"),
}


class Lot(NamedTuple):
    """How a dump is written."""

    kind: str
    sign: int
    up: bool
    unit: str
    depth: str
    unsigned: bool
    buffers: bool
    reference: bool
    jitter: str
    padding: int
    folders: bool
    words: dict[str, str]


def draw(rng: np.random.Generator) -> Lot:
    """Conventions by lot."""
    pick = lambda *choices: choices[rng.integers(len(choices))]
    kind = pick("exr", "exr", "png", "npy")
    return Lot(
        kind=kind,
        sign=pick(1, -1),
        up=bool(rng.integers(2)),
        unit=pick("uv", "ndc") if kind == "png" else pick("pixels", "uv", "ndc"),
        depth=pick("reversed", "forward") if kind == "png" else pick("linear", "reversed", "forward"),
        unsigned=kind == "png" or bool(rng.integers(2)),
        buffers=bool(rng.integers(4)),
        reference=bool(rng.integers(5)),
        jitter=pick("pixels", "uv", "ndc", "image", "none"),
        padding=pick(1, 3, 4),
        folders=bool(rng.integers(2)),
        words={image: pick(*words) for image, words in WORDS.items()},
    )


def _png(path: Path, image: np.ndarray) -> None:
    order = [2, 1, 0, 3][: image.shape[-1]] if image.shape[-1] > 1 else [0]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., order]))


def pack(values: np.ndarray, count: int, low: int, high: int) -> np.ndarray:
    """``[..., count]`` bytes of values in [0, 1), high one first."""
    rest, digits = np.asarray(values, np.float64) * high, []
    for _ in range(count):
        digits.append(np.clip(np.floor(rest), 0, 255))
        rest = (rest - digits[-1]) * low
    return np.stack(digits, axis=-1).astype(np.uint8)


def images_of(sequence: Sequence, t: int, lot: Lot) -> dict[str, np.ndarray]:
    """Give the images of a frame the conventions of a lot."""
    frames, buffers = sequence.frames, sequence.frames.gbuffers
    height, width = frames.motion.shape[1:3]
    factor = {"pixels": (1, 1), "uv": (width, height), "ndc": (width / 2, height / 2)}[lot.unit]
    motion = lot.sign * frames.motion[t] * [1, -1 if lot.up else 1] / factor
    depth = {
        "linear": np.where(np.isinf(buffers.depth[t]), 1e10, buffers.depth[t]),
        "reversed": NEAR / buffers.depth[t],
        "forward": 1 - NEAR / buffers.depth[t],
    }[lot.depth]
    images = {"color": frames.color[t] * frames.exposure[t], "depth": depth, "motion": motion}
    if lot.buffers:
        images["normal"] = 0.5 * buffers.normal[t] + 0.5 if lot.unsigned else buffers.normal[t]
        images["base_color"] = buffers.base_color[t]
    if lot.reference:
        images["reference"] = sequence.reference[t] * frames.exposure[t]
    return images


def write_dump(folder: Path, sequence: Sequence, lot: Lot) -> None:
    """Write a sequence in the conventions of a lot."""
    for t in range(len(sequence.frames.cut)):
        for image, values in images_of(sequence, t, lot).items():
            word, number = lot.words[image], f"{t + 3:0{lot.padding}d}"
            path = folder / (f"{word}/{number}" if lot.folders else f"{word}.{number}")
            path = path.with_name(path.name + f".{lot.kind}")
            path.parent.mkdir(parents=True, exist_ok=True)
            if lot.kind == "exr":
                letters = "R" if values.shape[-1] == 1 else "RGB"[: values.shape[-1]]
                exr.write(path, {c: np.float32(values[..., i]) for i, c in enumerate(letters)})
            elif lot.kind == "npy":
                np.save(path, np.asarray(values, np.float32))
            elif image == "motion":
                _png(path, pack(0.5 + 0.5 * values, 2, 255, 255).reshape(*values.shape[:2], 4))
            elif image == "depth":
                _png(path, pack(values[..., 0], 4, 256, 256))
            else:
                encoded = values if image == "normal" else np.asarray(srgb_encode(np.clip(values, 0, 1)))
                _png(path, np.rint(255 * encoded).astype(np.uint8))
    if lot.jitter != "none":
        _write_jitter(folder / "shot.json", sequence, lot)


def _write_jitter(path: Path, sequence: Sequence, lot: Lot) -> None:
    height, width = sequence.frames.motion.shape[1:3]
    factor = {"pixels": (1, 1), "uv": (1 / width, 1 / height), "ndc": (2 / width, -2 / height), "image": (-1, -1)}
    records = {}
    for t, jitter in enumerate(sequence.frames.jitter):
        records[str(t + 3)] = {"jitter": (np.asarray(jitter) * factor[lot.jitter]).tolist()}
    path.write_text(json.dumps({"frames": records}))


def score(folder: Path, sequence: Sequence, lot: Lot) -> dict[str, tuple[str, bool]]:
    """Part -> (how sure the guess is, whether it is right)."""
    found = guess_recipe(folder)
    recipe = folder.parent / f"{folder.name}.toml"
    recipe.write_text(to_toml(found.content, found.notes), encoding="utf-8")
    report = import_dataset(folder, folder.parent / f"{folder.name}-out", "generic", recipe=recipe, skip_broken=True)
    got = read_sequence(report.dataset, report.imported[0]).frames
    truth, sure = sequence.frames, lambda *keys: _least(found.notes, keys)
    lengths = np.linalg.norm(truth.motion[1:], axis=-1)
    off = np.linalg.norm(got.motion[1:] - truth.motion[1:], axis=-1)
    finite = np.isfinite(truth.gbuffers.depth) & np.isfinite(got.gbuffers.depth)
    ratio = got.gbuffers.depth[finite] / truth.gbuffers.depth[finite]
    exposed = np.clip(truth.color * truth.exposure[:, None, None, None], 0, 1 if lot.kind == "png" else np.inf)
    parts = {
        "motion": (sure("motion.sign", "motion.y", "motion.unit"), bool((off < 0.2 + 0.05 * lengths).mean() > 0.9)),
        "depth": (sure("depth.kind"), bool(np.quantile(np.abs(ratio / np.median(ratio) - 1), 0.9) < 0.02)),
        "colour": (sure("color.encoding"), bool(np.median(np.abs(got.color - exposed)) < 0.02)),
        "jitter": (sure("jitter.source", "jitter.sign", "jitter.y", "jitter.unit"),
                   bool(np.abs(got.jitter - truth.jitter).max() < 0.08)),
    }  # fmt: skip
    if lot.buffers:
        turned = (got.gbuffers.normal * truth.gbuffers.normal).sum(axis=-1)[(truth.gbuffers.normal != 0).any(axis=-1)]
        parts["normal"] = (sure("normal.encoding"), bool(np.median(turned) > 0.98))
    return parts


def _least(notes: dict[str, tuple[str, str]], keys: tuple[str, ...]) -> str:
    known = [notes[key][0] for key in keys if key in notes]
    return max(known, key=(CERTAIN, LIKELY, UNKNOWN).index, default=UNKNOWN)


def main() -> None:
    """Draw, write, guess and score; write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=Path, help="folder to keep the rendered clips in")
    parser.add_argument("--count", type=int, default=48, help="dumps")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root, tally, wrong = arguments.clips or Path(temporary) / "clips", Counter(), []
        for seed in range(arguments.first, arguments.first + arguments.count):
            clip = list(CLIPS)[seed % len(CLIPS)]
            folder = root / clip.replace(" ", "-")
            dataset = read_dataset(folder) if (folder / "dataset.json").exists() else render(clip, folder)
            lot, dump = draw(np.random.default_rng(seed)), Path(temporary) / f"dump{seed}"
            sequence = read_sequence(dataset, "clip")
            write_dump(dump, sequence, lot)
            try:
                parts = score(dump, sequence, lot)
            except ValueError as error:
                parts = {"recipe": (UNKNOWN, False)}
                print(f"{seed}: {error}")
            for part, (sure, right) in parts.items():
                tally[part, sure, right] += 1
                if not right:
                    wrong.append(f"- {seed} ({clip}, {lot.kind}): {part}, {sure}: {_said(lot)}")
            print(seed, clip, lot.kind, parts, flush=True)
    text = page(tally, wrong, arguments.count)
    print(text)
    if not arguments.first and arguments.count >= 48:
        PAGE.write_text(text, encoding="utf-8")


def _said(lot: Lot) -> str:
    return ", ".join(f"{k} {v}" for k, v in lot._asdict().items() if k not in ("words", "padding", "folders", "kind"))


def page(tally: Counter, wrong: list[str], count: int) -> str:
    """Write the results as Markdown."""
    parts = list(dict.fromkeys(part for part, _, _ in tally))
    cell = lambda part, sure: f"{tally[part, sure, True]} of {tally[part, sure, True] + tally[part, sure, False]}"
    false = sum(n for (_, sure, right), n in tally.items() if sure == CERTAIN and not right)
    lines: list[Any] = [
        "# What `--guess` makes of dumps in conventions drawn by lot",
        "",
        f"Made by `python -m tools.verdicts.scramble`: {count} dumps of the eight clips. Right of all, by how sure.",
        f"Certain and wrong: **{false}**.",
        "",
        "| | certain | likely | unknown |",
        "|---|---|---|---|",
        *[f"| {part} | " + " | ".join(cell(part, s) for s in (CERTAIN, LIKELY, UNKNOWN)) + " |" for part in parts],
        "",
        *(["Not right:", "", *wrong, ""] if wrong else []),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
