"""The summary of an evaluation: means per sequence and over sequences."""

import pytest

from experiments.evaluate import _summarise


def _entry(kind, psnr, non_finite=0):
    values = {"psnr": psnr, "psnr_foreground": psnr, "psnr_reference": None}
    return {"kind": kind, "resolution": "hr", **values, "non_finite": non_finite}


def test_a_frame_that_is_not_finite_leaves_no_mean_that_looks_better():
    curves = {
        "broken": {"a": [_entry("ss", None, 1), _entry("ss", 33.0), _entry("ess", 30.0)], "b": [_entry("ss", 31.0)]},
        "sound": {"a": [_entry("ss", 20.0), _entry("ss", 30.0)]},
    }
    rows = {(row["method"], row["sequence"], row["frames"]): row for row in _summarise(curves)}
    for sequence in ("a", "mean"):
        row = rows["broken", sequence, "ss"]
        assert row["psnr"] is None and row["psnr_foreground"] is None and row["non_finite"] == 1
    assert rows["broken", "b", "ss"]["psnr"] == 31.0 and rows["broken", "mean", "ess"]["psnr_foreground"] == 30.0
    assert rows["sound", "mean", "ss"]["psnr_foreground"] == pytest.approx(25.0)
    assert rows["sound", "mean", "ss"]["psnr_reference"] is None  # absent, not spoiled
