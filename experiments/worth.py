"""``python -m experiments.worth WEIGHTS --data DATASET``: what each buffer is worth to trained weights, in dB.

The test clips are played again with buffers taken away, at one or more rates, beside the baselines.
"""

import collections.abc
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from essjax import methods
from essjax.buffers import OPTIONAL_GBUFFERS
from essjax.data import Dataset, read_dataset, without_buffers
from essjax.data.json_files import write_json
from essjax.frames import select_time
from essjax.interfaces import Method
from experiments.environment import environment
from experiments.evaluate import Clip, Clips, Runner, evaluate
from experiments.run import guarded, parse_as

WARMUP = 5
BASELINES = ("taau-half", "bilinear")
Names = tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class WorthOptions:
    """Play the test clips of a dataset with buffers missing: a row per set of them, columns per rate and distance."""

    weights: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WEIGHTS")]
    """a weights file, such as runs/NAME/weights/extrass.safetensors"""
    data: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """an essjax dataset with a test split"""
    rates: tuple[int, ...] = (2,)
    """one frame in so many is rendered"""
    without: tuple[str, ...] = ()
    """sets of buffers to take away, such as base_color+normal; by default each alone, both guides, and all"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """where the numbers go as JSON"""


class Lacking(collections.abc.Sequence[Clip]):
    """Clips without some buffers."""

    def __init__(self, clips: collections.abc.Sequence[Clip], names: Names):
        self._clips, self._names = clips, names

    def __len__(self) -> int:
        return len(self._clips)

    def __getitem__(self, index: int) -> Clip:
        clip = self._clips[index]
        frames = without_buffers(clip.sequence.frames, self._names)
        return dataclasses.replace(clip, sequence=dataclasses.replace(clip.sequence, frames=frames))


def sets_of(dataset: Dataset, method: Method, wanted: Sequence[str]) -> list[Names]:
    """List the sets of buffers to take away, the first of none.

    Args:
      dataset: what it has can be taken.
      method: what it requires cannot.
      wanted: names with "+" between; none: each alone, base colour and normals together, all.

    Raises:
      ValueError: a name that is none of those that can be taken.
    """
    free = [n for n in OPTIONAL_GBUFFERS if n in dataset.info.channels and n not in method.info.requires]
    sets = [tuple(text.split("+")) for text in wanted]
    wrong = [name for names in sets for name in names if name not in free]
    if wrong:
        raise ValueError(
            f"--without: expected some of {', '.join(free) or 'nothing'} ({method.info.name} needs the others, or "
            f"{dataset.path} lacks them), got {', '.join(wrong)}."
        )
    if not sets:
        guides = tuple(name for name in ("base_color", "normal") if name in free)
        sets = [*((name,) for name in free), guides, tuple(free)]
    return list(dict.fromkeys(((), *sets)))


def measure(options: WorthOptions, on_step=lambda text: None) -> dict[str, Any]:
    """Play all of it; returns what goes into ``--out``: ``rows``, each with what is missing, rate, distance, scores.

    Raises:
      ValueError: the files do not fit.
    """
    method, variables = methods.load(options.weights)
    dataset = read_dataset(options.data)
    if not dataset.splits.get("test"):
        raise ValueError(f"{dataset.path}: expected a test split, it has {', '.join(dataset.splits) or 'none'}.")
    clips = Clips(dataset, "test", WARMUP, native=False)
    rows: list[dict[str, Any]] = []
    for names in sets_of(dataset, method, options.without):
        runners = {method.info.name: Runner(method, variables)}
        if not names:  # the baselines look at none of them
            baselines = {name: methods.make(name.replace("-", "_")) for name in BASELINES}
            example = select_time(jax.tree.map(lambda leaf: leaf[:, None], clips[0].sequence.frames), 0)
            runners |= {name: Runner(each, each.init(jax.random.key(0), example)) for name, each in baselines.items()}
        found = evaluate(runners, Lacking(clips, names), rates=options.rates, pictures=0, on_step=on_step)
        rows += [{**row, "without": "+".join(names)} for row in found["rates"]]
    return {
        "schema": 1, "kind": "worth", "method": method.info.name, "rates": list(options.rates), "rows": rows,
        "weights": Path(options.weights).name, "clips": len(clips), "environment": environment(),
    }  # fmt: skip


def table(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines: PSNR of each row at each place, PSNR in holes behind it in brackets."""
    places = sorted({(row["rate"], row["distance"]) for row in found["rows"]})
    cells = {(row["method"], row["without"], row["rate"], row["distance"]): row for row in found["rows"]}
    lines = []
    for method, without in dict.fromkeys(key[:2] for key in cells):
        texts = []
        for place in places:
            row = cells.get((method, without, *place))
            holes = None if row is None else row.get("psnr_holes")
            texts.append("–" if row is None else f"{row['psnr']:.2f}" + (f" ({holes:.2f})" if holes else ""))
        label = f"{method} without {without.replace('+', ', ')}" if without else method
        lines.append([label, *texts])
    return [f"1:{rate} {f'+{distance}' if distance else 'SS'}" for rate, distance in places], lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns 2 after a line about bad input, 130 or 143 after a signal."""
    options = parse_as(WorthOptions, "worth", arguments)
    return guarded(lambda console: _worth(options, console), "Run the same command again.")


def _worth(options: WorthOptions, console: Console) -> int:
    with console.status("playing") as status:
        found = measure(options, lambda text: status.update(f"playing {text}"))
    heads, lines = table(found)
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for head in ("PSNR in dB (in holes)", *heads):
        grid.add_column(head, justify="left" if head.startswith("PSNR") else "right")
    for line in lines:
        grid.add_row(*line)
    console.print(grid)
    if options.out is not None:
        write_json(options.out, found)
        console.print(f"numbers: {options.out}", soft_wrap=True, markup=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
