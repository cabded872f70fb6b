"""``check_dataset``: proves a dataset's conventions on its own pictures, and says what to change."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from essjax.data.check.compare import best_reading
from essjax.data.check.continuity import ContinuityCheck, judge_continuity
from essjax.data.check.finding import VERDICTS, Finding
from essjax.data.check.geometry import GeometryCheck, judge_geometry
from essjax.data.check.jitter import JitterCheck, judge_jitter
from essjax.data.check.motion import MotionCheck, judge_motion, look
from essjax.data.check.pairs import Step, choose, steps
from essjax.data.check.pictures import write_pictures
from essjax.data.check.values import ValuesCheck, judge_values
from essjax.data.layout import Dataset

__all__ = ["VERDICTS", "CheckReport", "Finding", "check_dataset"]


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """What ``check_dataset`` found.

    Attributes:
      findings: one per check.
      looked_at: frames that were read.
      frames: frames that there are.
      pictures: files that were written.
    """

    findings: tuple[Finding, ...]
    looked_at: int
    frames: int
    pictures: tuple[Path, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst of all findings."""
        return max((finding.verdict for finding in self.findings), key=VERDICTS.index)

    def as_json(self) -> dict[str, Any]:
        """JSON types."""
        return {
            "verdict": self.verdict,
            "looked_at": self.looked_at,
            "frames": self.frames,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
        }


class _Checks:
    """Every check, over one sequence."""

    def __init__(self):
        self.values, self.geometry, self.jitter = ValuesCheck(), GeometryCheck(), JitterCheck()
        self.motion, self.continuity = MotionCheck(), ContinuityCheck()
        self.shown: Step | None = None

    def add(self, step: Step) -> None:
        self.values.add(step)
        self.geometry.add_frame(step)
        self.jitter.add_frame(step)
        if step.before is None:
            return
        looked = look(step)
        if not self.continuity.add(step, looked):
            return
        self.motion.add(step, looked)
        self.jitter.add_pair(step, looked)
        self.geometry.add_pair(step, looked)
        self.shown = step


def check_dataset(
    dataset: Dataset,
    *,
    pairs: int = 24,
    pictures: Path | None = None,
    progress: Callable[[int, int], Any] = lambda done, total: None,
) -> CheckReport:
    """Check every sequence of a dataset; memory does not grow with its length.

    Args:
      dataset: from ``read_dataset``.
      pairs: pairs of neighbouring frames per sequence, evenly spread; 0: all.
      pictures: folder for pictures of the warps, one pair per sequence; None: none.
      progress: called with (frames done, frames in all).

    Raises:
      ValueError: a file is missing or damaged; the message names it.
    """
    total = sum(len(choose(info, pairs)) for info in dataset.sequences.values())
    checks: dict[str, _Checks] = {}
    done = 0
    for name in dataset.sequences:
        checks[name] = _Checks()
        for step in steps(dataset, name, pairs):
            checks[name].add(step)
            done += 1
            progress(done, total)
    by = lambda field: {name: getattr(check, field) for name, check in checks.items()}
    motion = judge_motion(by("motion"), dataset.info)
    motion_wrong = any(finding.verdict == "wrong" for finding in motion)
    findings = [
        *motion,
        *judge_jitter(by("jitter"), motion_wrong=motion_wrong, scale=dataset.info.scale),
        *judge_geometry(by("geometry"), motion_wrong=motion_wrong),
        *judge_values(by("values")),
        *judge_continuity(by("continuity")),
    ]
    written: list[Path] = []
    if pictures is not None:
        best = best_reading(check.motion.reference for check in checks.values())
        for check in checks.values():
            written += write_pictures(Path(pictures), check.shown, best) if check.shown is not None else []
    return CheckReport(tuple(findings), total, sum(len(i.frames) for i in dataset.sequences.values()), tuple(written))
