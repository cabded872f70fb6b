"""``check_dataset``: proves a dataset's conventions on its own pictures, and says what to change."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from essjax.data.check.compare import total
from essjax.data.check.continuity import ContinuityCheck, judge_continuity
from essjax.data.check.coverage import judge_coverage
from essjax.data.check.finding import VERDICTS, Finding, some
from essjax.data.check.geometry import GeometryCheck, judge_geometry
from essjax.data.check.jitter import FIXES, SHIFT, JitterCheck, judge_against, judge_between
from essjax.data.check.motion import MotionCheck, judge_motion, look
from essjax.data.check.pairs import Step, choose, read_step, steps
from essjax.data.check.pictures import write_pictures
from essjax.data.check.surfaces import SurfaceCheck, judge_surfaces, proved
from essjax.data.check.values import ValuesCheck, judge_values
from essjax.data.layout import Dataset, SequenceInfo
from essjax.sizes import ratios

__all__ = ["VERDICTS", "CheckReport", "Finding", "check_dataset"]


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """The findings of ``check_dataset``.

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
        self.motion, self.surfaces, self.continuity = MotionCheck(), SurfaceCheck(), ContinuityCheck()
        self.shown: int | None = None

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
        self.surfaces.add(step, looked.motions)
        self.jitter.add_pair(step, looked)
        self.geometry.add_pair(step, looked)
        self.shown = step.number


def _is_srgb(info: SequenceInfo) -> bool:
    """Whether the recipe of the import says so."""
    rule = info.source.get("color")
    return isinstance(rule, Mapping) and rule.get("encoding") == "srgb"


def _judge(checks: Sequence[_Checks], info: SequenceInfo) -> list[Finding]:
    jitter = [check.jitter for check in checks]
    own = info.source.get("reference") == "color"
    against, shift = judge_against(jitter, ratios(info.size, info.output), own_reference=own)
    references_jittered = own or against.fix == FIXES["none"]
    surfaces = [check.surfaces for check in checks]
    motion = judge_motion(
        [check.motion for check in checks], info, references_jittered=references_jittered, proved=proved(surfaces)
    )
    motion_wrong = any(finding.verdict == "wrong" for finding in motion)
    return [
        *motion,
        judge_surfaces(surfaces, wrong="motion" if motion_wrong else "jitter" if against.verdict == "wrong" else ""),
        against,
        judge_between(jitter, motion_wrong=motion_wrong, against=against),
        shift,
        *judge_geometry([check.geometry for check in checks], motion_wrong=motion_wrong),
        *judge_values([check.values for check in checks], srgb=_is_srgb(info)),
        *judge_continuity([check.continuity for check in checks]),
    ]


def _judge_with_each_alone(checks: Mapping[str, _Checks], info: SequenceInfo) -> list[Finding]:
    """Judge all sequences together, and where one is wrong in its own way, take that one's finding."""
    findings = _judge(list(checks.values()), info)
    alone = {name: _judge([check], info) for name, check in checks.items()}
    for row, finding in enumerate(findings):
        wrong = {name: rows[row] for name, rows in alone.items() if rows[row].verdict == "wrong"}
        if finding.verdict == "wrong" and finding.fix in [other.fix for other in wrong.values()]:
            continue
        for other in list(wrong.values())[:1]:  # what the others say would only blur it
            names = some(name for name, same in wrong.items() if same.fix == other.fix)
            findings[row] = dataclasses.replace(other, found=f"sequence {names}: {other.found}")
    return findings


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
      pairs: pairs of neighbouring frames per sequence, spread over it; 0: all.
      pictures: folder for pictures of the warps, one pair per sequence; None: none.
      progress: called with (frames done, frames in all).

    Raises:
      ValueError: a file is missing or damaged, which the message names, ``pairs`` is negative, or frames are lines.
    """
    if pairs < 0:
        raise ValueError(f"pairs: expected 0 (all frames) or more, got {pairs}.")
    if min(dataset.info.width, dataset.info.height) < 2:
        size = f"{dataset.info.width}x{dataset.info.height}"
        raise ValueError(f"{dataset.path}: expected frames of at least 2x2 pixels, got {size}: a line proves nothing.")
    frames = sum(len(choose(info, pairs)) for info in dataset.sequences.values())
    checks: dict[str, _Checks] = {}
    done = 0
    for name in dataset.sequences:
        checks[name] = _Checks()
        for step in steps(dataset, name, pairs):
            checks[name].add(step)
            done += 1
            progress(done, frames)
    findings = _judge_with_each_alone(checks, dataset.info)
    jitters = [np.array([record["jitter"] for record in info.frames]) for info in dataset.sequences.values()]
    findings.insert([finding.check for finding in findings].index(SHIFT) + 1, judge_coverage(jitters))
    written: list[Path] = []
    if pictures is not None:
        best = total(check.motion.reference for check in checks.values()).best()
        for name, check in checks.items():
            if check.shown is not None:
                written += write_pictures(Path(pictures), read_step(dataset, name, check.shown), best)
    return CheckReport(tuple(findings), frames, sum(len(i.frames) for i in dataset.sequences.values()), tuple(written))
