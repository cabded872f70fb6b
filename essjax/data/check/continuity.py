"""From one frame to the next: duplicated frames, cuts that nobody marked, marked cuts that are none."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from essjax.data.check.compare import DIFFERENT
from essjax.data.check.finding import Finding, some
from essjax.data.check.motion import Look, tone
from essjax.data.check.pairs import Step
from essjax.data.check.readings import camera_motion, jitter_step

DUPLICATE = 1e-4
"""Mean difference of toned pictures below which they are the same; half precision and noise are above."""
CUT = 0.5
"""Correlation of the best warp with the frame: below it nothing is seen again. Measured 0.8 and more within shots, 0.3
and less across cuts."""
MOSTLY = 0.5
"""Share of the picture that objects fill which move by themselves."""
NO_CUT = 0.8
"""Correlation above which a marked cut is none."""


@dataclasses.dataclass
class ContinuityCheck:
    """Signs of cuts and repeats in the pairs of one sequence; lists of "sequence frame"."""

    duplicates: list[str] = dataclasses.field(default_factory=list)
    duplicate_references: list[str] = dataclasses.field(default_factory=list)
    unmarked: list[str] = dataclasses.field(default_factory=list)
    not_cuts: list[str] = dataclasses.field(default_factory=list)
    pairs: int = 0
    marked: int = 0

    def add(self, step: Step, looked: Look) -> bool:
        """Add a pair; returns whether its frames follow each other, which is what the other checks need."""
        assert step.before is not None and step.reference_before is not None
        self.pairs += 1
        self.marked += step.cut
        if step.cut:
            if looked.similarity > NO_CUT:
                self.not_cuts.append(step.where)
            return False
        moves, jitters = _moves(step), np.abs(jitter_step(step)).max() >= 0.05
        same = _same(step.before.color, step.now.color, step.key) and (moves or jitters)
        same_reference = moves and _same(step.reference_before, step.reference, step.key)
        if same:
            self.duplicates.append(step.where)
        if same_reference:
            self.duplicate_references.append(step.where)
        cut = looked.similarity < CUT and not _moves_by_itself(step)
        if cut:
            self.unmarked.append(step.where)
        return not (same or same_reference or cut)


def _moves_by_itself(step: Step) -> bool:
    """Whether objects that move by themselves fill most of the picture: then wrong motion looks like a cut."""
    ids = step.now.gbuffers.stencil
    return ids is not None and float((np.asarray(ids) > 0).mean()) > MOSTLY


def _same(before, now, key: float) -> bool:
    now, before = np.asarray(tone(now, key)), np.asarray(tone(before, key))
    return bool(now.std() > 1e-3 and np.abs(now - before).mean() < DUPLICATE)


def _moves(step: Step) -> bool:
    """Whether motion or cameras say that a tenth of the picture moves."""
    motions = [np.asarray(step.now.motion), camera_motion(step)]
    return any(np.percentile(np.linalg.norm(m, axis=-1), 90) >= DIFFERENT for m in motions if m is not None)


def judge_continuity(checks: Sequence[ContinuityCheck]) -> list[Finding]:
    """Judge duplicated frames and cuts."""
    gather = lambda field: [where for check in checks for where in getattr(check, field)]
    pairs, marked = (sum(getattr(check, field) for check in checks) for field in ("pairs", "marked"))
    return [
        _judge_duplicates(gather("duplicates"), gather("duplicate_references"), pairs),
        _judge_cuts(gather("unmarked"), gather("not_cuts"), pairs, marked),
    ]


def _judge_duplicates(frames: list[str], references: list[str], pairs: int) -> Finding:
    check = "duplicated frames"
    for kind, places in (("frame", frames), ("reference", references)):
        if places:
            found = f"{len(places)} {kind}s show what the one before shows although motion, cameras or jitter differ: "
            fix = "render these frames again, or leave them out and mark the frame after each as a cut"
            return Finding(
                check, "wrong", found + some(places), fix, {"frames": len(frames), "references": len(references)}
            )
    return Finding(check, "ok", f"none in {pairs} pairs")


def _judge_cuts(unmarked: list[str], not_cuts: list[str], pairs: int, marked: int) -> Finding:
    check, numbers = "cuts", {"marked": marked, "unmarked": len(unmarked), "not cuts": len(not_cuts)}
    if unmarked:
        found = f"{len(unmarked)} frames show nothing of the frame before and are not marked as cuts: {some(unmarked)}"
        fix = 'set "cut": true for these frames in sequence.json, or import each shot as a sequence of its own'
        return Finding(check, "wrong", found, fix, numbers)
    if not_cuts:
        found = f"{len(not_cuts)} frames marked as cuts go on with the frame before: {some(not_cuts)}"
        return Finding(check, "warning", found, 'set "cut": false for these frames in sequence.json', numbers)
    return Finding(check, "ok", f"{marked} marked, none missing in {pairs} pairs", "", numbers)
