"""The rows of a run's table: which methods, with which variables, and what to tell the reader about them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from essjax.data.json_files import NUMBER, TEXT, check, read_json, write_json
from essjax.frames import Sequence as FrameSequence
from essjax.frames import frame_images, frame_size, select_time
from essjax.interfaces import Method, MethodInfo
from essjax.typing import PyTree
from experiments import checks
from experiments.evaluate import Clip, Clips, Runner
from experiments.members import Member
from experiments.tuning import Setting, setting_variables, tune
from experiments.variants import VARIANTS


class Trained(NamedTuple):
    """The results of training a variant.

    Attributes:
      initial: entry -> linen variables, before training.
      variables: the same after it.
      report: stage -> what ``essjax.train.train`` says of it.
    """

    initial: PyTree
    variables: PyTree
    report: dict[str, Any]


def make_runners(
    members: Mapping[str, Member],
    names: Sequence[str],
    trained: Mapping[str, Trained],
    clips: Clips,
    validation: Clips | None,
    out: Path,
    on_step: Callable[[str], None] = lambda text: None,
) -> tuple[dict[str, Runner], dict[str, Setting]]:
    """Runners of the rows that fit the data; the TAA family is tuned on ``validation``.

    The chosen settings are kept in ``out / "tuning.json"``: a resumed run does not search again.

    Args:
      members: all rows, in the order of the table.
      names: those that must have a row.
      trained: owner -> what its training gave.
      clips: that will be scored.
      validation: for tuning; None: there are none, and defaults are not tuned.
      out: folder of the run.
      on_step: called with what is being tuned.
    """
    example = clips.outline(0).sequence
    runners, chosen = {}, {}
    kept = _read_settings(out / "tuning.json")
    frames = select_time(example.frames, 0)
    for row, member in members.items():
        method, settings = member.method, member.settings
        if method.info.native and example.native is None or row not in names and unfit(method, example):
            continue
        if VARIANTS[row].tuned and settings.evaluation.tune and validation is not None:
            if row not in kept:
                on_step(f"tuning {row}")
                kept[row] = tune(lambda clamp, member=member: _clamped(member, clamp), validation)
            chosen[row] = kept[row]
            method, variables = _clamped(member, kept[row].clamp), setting_variables(kept[row])
        elif member.owner:
            variables = {stage.name: trained[member.owner].variables[stage.name] for stage in member.stages}
        else:
            variables = method.init(jax.random.key(0), frames)
        runners[row] = Runner(method, variables, settings.compiler_options)
    write_json(out / "tuning.json", {row: setting._asdict() for row, setting in chosen.items()})
    return runners, chosen


def _clamped(member: Member, clamp: str) -> Method:
    arguments = dataclasses.replace(member.settings.method, clamp=clamp)
    return VARIANTS[member.name].method(dataclasses.replace(member.settings, method=arguments))


def unfit(method: Method, sequence: FrameSequence) -> str:
    """Why ``method`` cannot be run and scored on ``sequence``, or an empty string."""
    return checks.unfit(method.info, frame_images(sequence.frames), frame_size(sequence.frames), sequence.size)


def _read_settings(path: Path) -> dict[str, Setting]:
    if not path.exists():
        return {}
    content, fields = read_json(path), {"clamp": TEXT, "alpha": NUMBER, "sigma": NUMBER, "psnr": NUMBER}
    for row, setting in content.items():
        check(f"{path}: {row}", setting, fields)
    return {row: Setting(*(setting[name] for name in fields)) for row, setting in content.items()}


def table_references(runners: Mapping[str, Runner], pixels: float) -> dict[str, str]:
    """Rows that are not on equal terms with methods that extrapolate every other LR frame, and why.

    ``pixels``: those of the reference over those of the frame.
    """
    reasons = {row: unequal(runner.method.info, pixels) for row, runner in runners.items()}
    return {row: reason for row, reason in reasons.items() if reason}


def unequal(info: MethodInfo, pixels: float) -> str:
    """Say what a method gets that others do not (more pixels, a later frame); an empty string if nothing.

    Args:
      info: of the method.
      pixels: those of the reference over those of the frame.
    """
    reasons = []
    times = (2 if info.renders_all else 1) * (pixels if info.native else 1)
    if times > 1:
        frames = "every frame rendered" if info.renders_all else "rendered frames"
        where = " at native resolution" if info.native else ""
        reasons.append(f"gets {frames}{where}: {_TIMES.get(times, f'{times:.3g} times')} the input")
    if info.latency:
        reasons.append(f"+{info.latency} frame of latency: it interpolates; frames without a later one are not scored")
    return "; ".join(reasons)


_TIMES = {2: "twice", 4: "four times", 8: "eight times"}


def _left_out(members: Mapping[str, Member], names: Sequence[str], sequence: FrameSequence) -> list[str]:
    """One remark per variant or baseline that does not fit the data."""
    remarks = []
    for row, member in members.items():
        reason = unfit(member.method, sequence) if row not in names else ""
        if member.method.info.native and sequence.native is None:
            reason = "this dataset has no colour at native resolution"
        if reason:
            remarks.append(f"No {row} row: {reason}.")
    return remarks


def notes(
    members: Mapping[str, Member], names: Sequence[str], clips: Sequence[Clip], chosen: Mapping[str, Setting]
) -> list[str]:
    """Collect what the reader of the table with the variants ``names`` must know."""
    warmup = members[names[0]].settings.evaluation.warmup
    share = sum(clip.holes[clip.scored].mean() for clip in clips) / len(clips)
    exact = "exact, from the renderer" if clips[0].exact_holes else "estimated from the G-buffers"
    scored = sum(len(clip.scored) for clip in clips)
    recorded = all(clip.sequence.frames.exposure is not None for clip in clips)
    exposure = "recorded with the frames" if recorded else "0.18 over the log-mean of its reference, one per sequence"
    remarks = [
        f"{scored} frames of {len(clips)} sequences are scored, each as SS and as ESS; {warmup} frames at the "
        f"start and after a cut warm up. Holes ({100 * share:.1f} % of LR pixels): {exact}. PSNR, SSIM of exposed "
        f"radiance after x/(1+x) and sRGB; exposure: {exposure}. HR results score against the anti-aliased reference, "
        "LR results against that frame's own jittered, aliased colour."
    ]
    for row, setting in chosen.items():
        text = f"alpha {setting.alpha:g}, sigma {setting.sigma:g}, clamp {setting.clamp}"
        remarks.append(f"{row}: {text}, the best on the validation frames ({setting.psnr:.2f} dB there).")
    remarks += _left_out(members, names, clips[0].sequence)
    if not clips[0].exact_holes:
        remarks.append(_foreground_note())
    return remarks


def _foreground_note() -> str:
    return (
        "psnr_foreground leaves the background out; psnr_reference scores LR results against the reference read at the "
        "sample positions (foreground): a noisy frame as target rewards denoising, that one does not. Both are in "
        "metrics.json."
    )
