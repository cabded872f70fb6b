"""The suites: each a module with ``rows(options)``, and perhaps ``facts(rows)``: what follows from several rows."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from experiments.benchmark.measure import REPETITIONS

Row = dict[str, Any]


class Options(NamedTuple):
    """All that the command line asks for.

    Attributes:
      width: of low-resolution frames, pixels.
      height: of them.
      repetitions: of each case.
      frames: that are streamed for the histogram of latencies.
      peers: also time other frameworks' versions, where they are installed.
      dtypes: the networks' compute types.
      only: beginnings of the names of cases that are run; all when empty. The train and scenes suites take no notice.
    """

    width: int = 960
    height: int = 540
    repetitions: int = REPETITIONS
    frames: int = 300
    peers: bool = True
    dtypes: tuple[str, ...] = ("float32", "bfloat16")
    only: tuple[str, ...] = ()

    def wanted(self, name: str) -> bool:
        """Whether the case of this name is run."""
        return not self.only or name.startswith(self.only)


class Suite(NamedTuple):
    """One suite.

    Attributes:
      summary: one line.
      rows: yields results as they are measured.
      facts: of all rows: name -> number.
    """

    summary: str
    rows: Callable[[Options], Iterator[Row]]
    facts: Callable[[list[Row]], dict[str, float]] = lambda rows: {}


def load() -> dict[str, Suite]:
    """Name -> suite, in the order in which they run."""
    from experiments.benchmark.suites import networks, pipeline, ratios, scenes, train, warp

    return {
        "warp": Suite("warps, and the gradients that training needs", warp.rows),
        "networks": Suite("forward passes of the networks", networks.rows),
        "pipeline": Suite("streaming: SS and ESS frames of whole methods", pipeline.rows, pipeline.facts),
        "ratios": Suite("streaming: one output size from inputs of several", ratios.rows),
        "train": Suite("train steps with backpropagation through time", train.rows, train.facts),
        "scenes": Suite("the built-in renderer", scenes.rows),
    }
