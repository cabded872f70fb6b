"""Tables 4 and 7 of ExtraNet (Guo et al. 2021)."""

from experiments.tables.base import Metric, Row, Table

_SCENES = ("MD", "RF", "BK", "WT")
_METRICS = {"PSNR": Metric("psnr", "ess", "lr"), "SSIM": Metric("ssim", "ess", "lr", digits=3), "VMAF": Metric(None)}

TABLE_4 = Table(
    name="extranet-4",
    title="interpolation and extrapolation",
    source="ExtraNet, SIGGRAPH Asia 2021, Table 4",
    scenes=_SCENES,
    metrics=_METRICS,
    rows={
        "ExtraNet": Row("extranet"),
        "3DWarp": Row("3d-warp"),
        "BSR": Row("bsr"),
        "DAIN": Row(None),
        "GC": Row(None),
        "HIW": Row(None),
    },
    paper={
        "ExtraNet": {
            "PSNR": (28.18, 23.50, 31.19, 28.97),
            "SSIM": (0.880, 0.829, 0.950, 0.912),
            "VMAF": (84.41, 83.87, 91.51, 89.60),
        },
        "3DWarp": {
            "PSNR": (24.31, 19.22, 28.13, 27.83),
            "SSIM": (0.745, 0.618, 0.911, 0.876),
            "VMAF": (76.30, 75.93, 87.01, 86.05),
        },
        "BSR": {
            "PSNR": (23.97, 18.70, 27.00, 27.22),
            "SSIM": (0.713, 0.559, 0.876, 0.837),
            "VMAF": (72.88, 73.51, 82.53, 81.84),
        },
        "DAIN": {
            "PSNR": (25.73, 19.95, 29.47, 29.41),
            "SSIM": (0.794, 0.621, 0.920, 0.910),
            "VMAF": (81.74, 76.32, 88.93, 90.19),
        },
        "GC": {
            "PSNR": (23.68, 17.71, 26.30, 25.22),
            "SSIM": (0.705, 0.480, 0.879, 0.842),
            "VMAF": (70.75, 63.27, 81.36, 79.74),
        },
        "HIW": {
            "PSNR": (23.23, 18.45, 26.95, 26.84),
            "SSIM": (0.663, 0.533, 0.866, 0.824),
            "VMAF": (71.59, 72.68, 83.83, 82.28),
        },
    },
    note="3DWarp, BSR and DAIN interpolate: they need the next rendered frame.",
)

TABLE_7 = Table(
    name="extranet-7",
    title="ablations",
    source="ExtraNet, SIGGRAPH Asia 2021, Table 7",
    scenes=_SCENES,
    metrics=_METRICS,
    rows={
        "ExtraNet": Row("extranet"),
        "w/o L_shade": Row("extranet-no-shade"),
        "w/o HE": Row("extranet-no-history"),
        "w/o OMV": Row("extranet-no-omv"),
    },
    paper={
        "ExtraNet": TABLE_4.paper["ExtraNet"],
        "w/o L_shade": {
            "PSNR": (27.96, 22.51, 29.75, 28.70),
            "SSIM": (0.877, 0.798, 0.937, 0.910),
            "VMAF": (84.29, 79.60, 89.49, 89.53),
        },
        "w/o HE": {
            "PSNR": (27.92, 22.17, 30.49, 28.80),
            "SSIM": (0.877, 0.791, 0.944, 0.908),
            "VMAF": (84.02, 77.44, 90.14, 89.41),
        },
        "w/o OMV": {
            "PSNR": (27.96, 22.51, 30.25, 28.28),
            "SSIM": (0.878, 0.799, 0.941, 0.900),
            "VMAF": (84.15, 79.79, 90.06, 88.29),
        },
    },
    note="HE: history encoder; OMV: occlusion motion vectors.",
)

TABLES = (TABLE_4, TABLE_7)
