"""docs/methods.md: ``python -m experiments.methods_page`` writes it; parameters, work and latency are computed."""

from pathlib import Path
from typing import NamedTuple

from essjax.deploy import method_cost
from essjax.interfaces import Method
from experiments.variants import VARIANTS, config_of

PAGE = Path(__file__).resolve().parent.parent / "docs" / "methods.md"
WIDTH, HEIGHT = 960, 540


class Entry(NamedTuple):
    """What cannot be computed about a method.

    Attributes:
      paper: where it comes from.
      idea: one or two sentences.
      unknown: what the paper does not say and what we chose, in short.
      reactive: what becomes of a reactive pixel in an extrapolated frame.
    """

    paper: str
    idea: str
    unknown: str
    reactive: str = "–"


ENTRIES: dict[str, Entry] = {
    "extrass": Entry(
        "ExtraSS 2023",
        "G-buffer guided warp and FRNet extrapolate at low resolution; one U-Net with two encoders supersamples "
        "rendered and extrapolated frames alike",
        "FRNet's layers, all sigmas, how the output is composed: coarse-to-fine flow after IFRNet, tuned sigmas, a "
        "blend of clamped history and samples plus a residual",
        "nothing of the history at output resolution",
    ),
    "extrass-e": Entry(
        "ExtraSS 2023",
        "its low-resolution part: guided warp, then FRNet's flow",
        "as above",
        "no: the guided warp goes by G-buffers alone",
    ),
    "extrass-w": Entry(
        "ExtraSS 2023", "its guided warp alone: 33 candidates, the 4 most similar are blended", "sigmas", "no: as above"
    ),
    "extranet": Entry(
        "ExtraNet 2021",
        "plain and occlusion-aware warps of the last frame, holes filled by a gated U-Net that also sees three encoded "
        "earlier frames",
        "thresholds of the holes depend on the scene's scale: ours are in pixel footprints",
        "a hole",
    ),
    "extranet+taa": Entry(
        "ExtraSS 2023, Table 3",
        "ExtraNet at output resolution, TAA behind it",
        "TAA's settings: its defaults, not tuned",
        "a hole",
    ),
    "extranet-plus": Entry(
        "FASSET",
        "ExtraNet fed zero-padded high-resolution frames",
        "its 0.10 M parameters are not the released net's",
        "a hole",
    ),
    "fasset": Entry(
        "FASSET",
        "one recurrent gated U-Net for both kinds, its features decoded at any output size by an implicit MLP",
        "widths, the recurrent module, what it remembers (hidden state and last output) and how that is warped",
        "a hole",
    ),
    "extranet+nsrr": Entry(
        "FASSET, Table 2", "extrapolates at low resolution, then supersamples every frame", "–", "a hole"
    ),
    "nsrr+extranet": Entry(
        "FASSET, Table 2", "supersamples rendered frames, then extrapolates at high resolution", "–", "a hole"
    ),
    "dlctus": Entry(
        "DLCTUS thesis",
        "a small residual network at a quarter of the output size blends jitter-aligned input and warped history, with "
        "its own count of samples",
        "colour must lie in [0, 1]: x / (1 + x)",
    ),
    "classifier": Entry(
        "Guo et al. 2022",
        "a classifier labels ghosting and aliasing pixels; history is rectified by class and blended by a small "
        "network",
        "rectification and some widths are in a main paper that we do not have",
    ),
    "nsrr": Entry(
        "Xiao et al. 2020",
        "five zero-upsampled frames with learned features, warped to the current one, reweighted, reconstructed by a "
        "U-Net",
        "no YCbCr, as the thesis trains it",
    ),
    "ifrnet": Entry(
        "Kong et al. 2022",
        "flows to both neighbours, coarse to fine, with an intermediate feature",
        "jitter of its inputs",
        "no: both neighbours are read everywhere",
    ),
    "ifrnet+taa": Entry(
        "ExtraSS 2023, Table 3",
        "IFRNet at output resolution, TAA behind it",
        "TAA's settings: its defaults, not tuned",
        "no: as above",
    ),
    "bsr": Entry(
        "Yang et al. 2011",
        "fixed-point search for each pixel in both neighbours, then a blend",
        "iterations",
        "no: as above",
    ),
    "3d-warp": Entry(
        "Mark et al. 1997", "both neighbours splatted to the middle by motion and depth", "hole filling", "no: as above"
    ),
    "tus": Entry("DLCTUS thesis", "TAAU with the thesis' own settings", "–"),
    "taau": Entry(
        "Yang et al. 2020", "temporal accumulation of jittered samples on the output grid", "best setting, tuned"
    ),
    "taau-half": Entry(
        "–",
        "TAAU on rendered frames, its output warped in between",
        "best setting, tuned",
        "warped all the same: there is nothing else; new in the next rendered frame",
    ),
    "taa": Entry("Karis 2014", "temporal accumulation at native resolution", "best setting, tuned"),
    "warp": Entry("–", "bilinear warp of the last rendered frame", "–", "no: there is nothing else to show"),
    "jau": Entry("DLCTUS thesis", "upsampling that knows where the samples lie", "–"),
    "bilinear": Entry("–", "upsampling that does not", "–"),
    "bicubic": Entry("–", "the same, bicubic", "–"),
}
HEAD = f"""# Methods

Generated by `python -m experiments.methods_page`; do not edit. One row per method; `python -m experiments.run --list`
also names ablations and test-time variations. All get colour, depth, motion and jitter; "also needs" is what a dataset
must have beyond that. Parameters and multiply-adds are those of the traced steps with the settings of `--preset paper`,
per frame of {WIDTH}x{HEIGHT} input ({2 * WIDTH}x{2 * HEIGHT} for those marked native); element-wise work and warps are
not counted. Latency: later frames that an image waits for. What we chose in detail: [deviations.md](deviations.md).

Where a frame's reactive mask is 1, a *rendered* frame shows nothing of its history, whatever the method
(`tests/methods/test_shots.py`); the last column but one says what such a pixel is in an *extrapolated* frame.

| method | from | idea | also needs | kinds | parameters | 10⁹ multiply-adds SS / ESS | latency | reactive | we chose |
|---|---|---|---|---|---:|---:|---:|---|---|
"""


def line(name: str, entry: Entry) -> str:
    """The row of one method."""
    method: Method = VARIANTS[name].method(config_of(name, "paper", []))
    info, factor = method.info, 2 if method.info.native else 1
    cost = method_cost(method, WIDTH * factor, HEIGHT * factor)
    work = " / ".join(f"{cost.multiply_adds[k] / 1e9:.1f}" if k in cost.multiply_adds else "–" for k in ("ss", "ess"))
    kinds = ", ".join(kind.upper() for kind in ("ss", "ess") if kind in info.predicts)
    kinds += " (every frame rendered)" if info.renders_all else ""
    kinds += " (native)" if info.native else ""
    needs = ", ".join(sorted(info.requires)) or "–"
    cells = (
        f"`{name}`", entry.paper, entry.idea, needs, kinds, f"{cost.parameters:,}" if cost.parameters else "–", work,
        str(cost.latency), entry.reactive, entry.unknown,
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


def page() -> str:
    """The whole page."""
    return HEAD + "\n".join(line(name, entry) for name, entry in ENTRIES.items()) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
