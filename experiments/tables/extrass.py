"""Tables 1, 2 and 3 of ExtraSS (Wu et al. 2023). The authors trained one model per scene."""

from experiments.tables.base import Metric, Row, Table

_SCENES = ("BK", "FR", "SQ", "IF")
_SOURCE = "ExtraSS, SIGGRAPH Asia 2023"

TABLE_1 = Table(
    name="extrass-1",
    title="spatial supersampling",
    source=f"{_SOURCE}, Table 1",
    scenes=_SCENES,
    metrics={"PSNR": Metric("psnr")},
    rows={
        "TAAU": Row("taau"),
        "NSR": Row("nsrr"),
        "Ours-SS": Row("extrass"),
        "Ours-ESS": Row("extrass", "ess"),
        "TAA": Row("taa"),
    },
    paper={
        "TAAU": {"PSNR": (26.83, 19.21, 37.52, 30.03)},
        "NSR": {"PSNR": (28.34, 18.76, 38.43, 30.26)},
        "Ours-SS": {"PSNR": (28.25, 19.89, 37.75, 30.04)},
        "Ours-ESS": {"PSNR": (27.81, 19.86, 37.57, 29.91)},
        "TAA": {"PSNR": (28.23, 20.16, 39.77, 32.05)},
    },
    note="TAAU and NSR get every frame rendered, TAA every frame at native resolution.",
)

TABLE_2 = Table(
    name="extrass-2",
    title="extrapolation at low resolution, without anti-aliasing",
    source=f"{_SOURCE}, Table 2",
    scenes=_SCENES,
    metrics={"PSNR": Metric("psnr", "ess", "lr")},
    rows={
        "ExtraNet": Row("extranet"),
        "IFRNet": Row("ifrnet"),
        "Ours-W": Row("extrass-w"),
        "Ours-E": Row("extrass-e"),
    },
    paper={
        "ExtraNet": {"PSNR": (30.10, 21.50, 35.85, 30.63)},
        "IFRNet": {"PSNR": (26.14, 17.43, 35.33, 26.83)},
        "Ours-W": {"PSNR": (30.74, 21.26, 40.02, 33.10)},
        "Ours-E": {"PSNR": (31.80, 22.00, 40.06, 33.29)},
    },
    note="IFRNet interpolates: it needs the next rendered frame.",
)

TABLE_3 = Table(
    name="extrass-3",
    title="frame generation at the same output resolution",
    source=f"{_SOURCE}, Table 3",
    scenes=_SCENES,
    metrics={"PSNR": Metric("psnr", "ess")},
    rows={"ExtraNet": Row("extranet+taa"), "IFRNet": Row("ifrnet+taa"), "Ours-ESS": Row("extrass")},
    paper={
        "ExtraNet": {"PSNR": (27.82, 21.87, 38.47, 30.75)},
        "IFRNet": {"PSNR": (25.06, 19.86, 38.59, 31.23)},
        "Ours-ESS": {"PSNR": (27.81, 19.86, 37.58, 29.91)},
    },
    note="ExtraNet and IFRNet are fed at output resolution (four times the pixels) and followed by TAA.",
)

TABLES = (TABLE_1, TABLE_2, TABLE_3)
