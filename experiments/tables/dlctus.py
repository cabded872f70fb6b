"""Tables 2, 10, 13, 14 and 16 of the DLCTUS thesis, one per upsampling factor and dataset.

Dataset 2 is dataset 1 with textures half as wide as an output pixel (eq 47).
"""

from typing import NamedTuple

from experiments.tables.base import Metric, Row, Table

_METRICS = {"PSNR": Metric("psnr"), "SSIM": Metric("ssim_dlctus", digits=4)}
_NOTE = "SSIM with C2 = 0.02² as in the thesis."


class _Data(NamedTuple):
    """An upsampling factor on a dataset: how the tables are called, and the settings behind it."""

    suffix: str
    scene: str
    settings: tuple[str, ...]
    half_input: bool = False


_FOUR = _Data("4x4", "4x4, dataset 1", ("data.scale=4", "data.jitter=dlctus"), half_input=True)
_TWO = _Data("2x2", "2x2, dataset 1", ("data.jitter=dlctus",))
_SHARP = _Data("2x2-sharp", "2x2, dataset 2", ("data.jitter=dlctus", "data.mip_bias=-1.0"))


def _table(
    number: int, title: str, data: _Data, rows: dict[str, Row], paper: dict[str, tuple[float, float]], note: str = _NOTE
) -> Table:
    return Table(
        name=f"dlctus-{number}-{data.suffix}",
        title=f"{title}, {data.scene}",
        source=f"DLCTUS thesis, Table {number}",
        scenes=("",),
        metrics=_METRICS,
        rows=rows,
        paper={row: {"PSNR": (psnr,), "SSIM": (ssim,)} for row, (psnr, ssim) in paper.items()},
        settings=data.settings,
        half_input=data.half_input,
        note=note,
    )


def _tables(
    number: int, title: str, rows: dict[str, Row], *datasets: tuple[_Data, tuple[tuple[float, float], ...]]
) -> tuple[Table, ...]:
    """One table per dataset; its numbers are (PSNR, SSIM) in the order of ``rows``."""
    return tuple(_table(number, title, data, rows, dict(zip(rows, numbers, strict=True))) for data, numbers in datasets)


TABLE_2 = _tables(
    2,
    "temporal upsampling",
    {"JAU": Row("jau"), "TUS": Row("tus"), "Xiao et al.": Row("nsrr"), "DLCTUS": Row("dlctus")},
    (_FOUR, ((30.04, 0.8046), (31.73, 0.8830), (34.18, 0.9201), (35.49, 0.9376))),
    (_TWO, ((34.26, 0.9104), (35.65, 0.9484), (38.21, 0.9645), (38.22, 0.9625))),
    (_SHARP, ((31.78, 0.8528), (33.82, 0.9188), (35.40, 0.9376), (35.89, 0.9364))),
)

TABLE_10 = Table(
    name="dlctus-10",
    title=f"the loss in training, {_SHARP.scene}",
    source="DLCTUS thesis, Table 10",
    scenes=("",),
    metrics={
        "L θ=0": Metric("spatial_error", digits=4, low=True),
        "L θ=1": Metric("temporal_error", digits=5, low=True),
        **_METRICS,
    },
    rows={
        "L1": Row("dlctus"),
        "θ = 0.1": Row("dlctus-theta-0.1"),
        "θ = 0.5": Row("dlctus-theta-0.5"),
        "θ = 0.9": Row("dlctus-theta-0.9"),
    },
    paper={
        "L1": {"L θ=0": (0.0166,), "L θ=1": (0.00586,), "PSNR": (35.89,), "SSIM": (0.9365,)},
        "θ = 0.1": {"L θ=0": (0.0166,), "L θ=1": (0.00585,), "PSNR": (35.90,), "SSIM": (0.9360,)},
        "θ = 0.5": {"L θ=0": (0.0166,), "L θ=1": (0.00574,), "PSNR": (35.87,), "SSIM": (0.9358,)},
        "θ = 0.9": {"L θ=0": (0.0179,), "L θ=1": (0.00552,), "PSNR": (35.36,), "SSIM": (0.9278,)},
    },
    settings=_SHARP.settings,
    note=f"L is the spatio-temporal loss on the test frames; the thesis prints SSIM in percent. {_NOTE}",
)

TABLE_13 = _tables(
    13,
    "reprojection at test time",
    {"Bilinear": Row("dlctus-bilinear"), "Bicubic5": Row("dlctus-5tap"), "Bicubic9": Row("dlctus-9tap")},
    (_FOUR, ((34.02, 0.9080), (35.27, 0.9370), (35.49, 0.9376))),
    (_TWO, ((36.54, 0.9429), (38.26, 0.9635), (38.22, 0.9625))),
    (_SHARP, ((34.32, 0.9064), (35.92, 0.9380), (35.89, 0.9364))),
)

TABLE_14 = _tables(
    14,
    "dilated motion at test time",
    {"dilated": Row("dlctus-dilated"), "not dilated": Row("dlctus")},
    (_FOUR, ((35.14, 0.9303), (35.49, 0.9376))),
    (_TWO, ((38.26, 0.9620), (38.22, 0.9625))),
    (_SHARP, ((35.89, 0.9356), (35.89, 0.9364))),
)

TABLE_16 = _tables(
    16,
    "accumulation buffer",
    {"with": Row("dlctus"), "without": Row("dlctus-no-accumulation")},
    (_FOUR, ((35.49, 0.9376), (35.23, 0.9347))),
    (_SHARP, ((35.89, 0.9365), (35.80, 0.9359))),
)

TABLES = (*TABLE_2, TABLE_10, *TABLE_13, *TABLE_14, *TABLE_16)
