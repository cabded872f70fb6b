"""Tables of the papers: filling in, the order of rows, and that every literal fits."""

import json

import pytest

from essjax.deploy import Cost
from experiments import tables
from experiments.tables.base import Metric, Row, Table, agreement, check, markdown, measured, verdict
from experiments.variants import VARIANTS

TOY = Table(
    name="toy-1",
    title="a toy",
    source="Nobody, Table 1",
    scenes=("A", "B"),
    metrics={"PSNR": Metric("psnr", "ess"), "error": Metric("mean_error", low=True), "VMAF": Metric(None)},
    rows={"ours": Row("extrass"), "ours SS": Row("extrass", "ss"), "theirs": Row("taau"), "absent": Row(None)},
    paper={
        "ours": {"PSNR": (30.0, 20.0), "error": (1.0, 1.0)},
        "ours SS": {"PSNR": (31.0, 21.0)},
        "theirs": {"PSNR": (10.0, None), "error": (2.0, 2.0), "VMAF": (90.0, 80.0)},
        "absent": {"PSNR": (99.0, 98.0)},
    },
)


def row(method, frames, psnr, **more):
    return {"method": method, "frames": frames, "resolution": "hr", "sequence": "mean", "psnr": psnr, **more}


METRICS = {
    "rows": [
        row("extrass", "ess", 25.0),
        row("extrass", "ss", 24.0, mean_error=3.0),
        row("taau", "ess", 23.0),
        row("taau", "ss", 22.0, mean_error=2.5),
        {**row("taau", "ess", 1.0), "sequence": "one"},
    ]
}


def test_numbers_come_from_the_right_rows():
    ours = measured(TOY, METRICS)
    assert ours["ours"] == {"PSNR": 25.0, "error": 3.0, "VMAF": None}
    assert ours["ours SS"]["PSNR"] == 24.0 and ours["theirs"] == {"PSNR": 23.0, "error": 2.5, "VMAF": None}
    assert ours["absent"] == {"PSNR": None, "error": None, "VMAF": None}


def test_the_order_is_judged_pair_by_pair():
    """PSNR: the paper has SS > ESS > theirs, here ESS > SS > theirs. Error (low is good): the other way round."""
    ours = measured(TOY, METRICS)
    found = agreement(TOY, ours, "PSNR")
    assert (found.same, found.total, found.different) == (2, 3, [("ours SS", "ours")])
    assert agreement(TOY, ours, "error").different == [("ours", "theirs")]
    text = verdict(TOY, ours)
    assert "PSNR: 2 of 3 pairs in the paper's order; here ours above ours SS." in text
    assert "error: 0 of 1 pairs" in text and "VMAF" not in text


def test_markdown_shows_their_scenes_their_mean_and_ours():
    lines = markdown(TOY, measured(TOY, METRICS)).splitlines()
    assert next(line for line in lines if line.startswith("| ours (")) == (
        "| ours (`extrass`) | 30.00 | 20.00 | 25.00 | **25.00** | 1.00 | 1.00 | 1.00 | **3.00** | – | – | – | – |"
    )
    assert any(line.startswith("| absent (not implemented) | 99.00 | 98.00 | 98.50 | – |") for line in lines)


def test_costs_are_shown_in_millions_and_billions():
    costs = Table(
        "c", "", "", ("",), {"P": Metric("cost.parameters"), "M": Metric("cost.multiply_adds", "ess")},
        {"x": Row("fasset")}, {},
    )  # fmt: skip
    cost = Cost(2_500_000, {"ss": 1, "ess": 3 * 10**9}, 0)
    assert measured(costs, {"rows": []}, {"fasset": cost})["x"] == {"P": 2.5, "M": 3.0}


def test_a_literal_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match="toy-1, ours, PSNR: expected one of .* with 2 numbers, got 1"):
        check(TOY._replace(paper={"ours": {"PSNR": (1.0,)}}))
    with pytest.raises(ValueError, match="row 'our' is not among ours"):
        check(TOY._replace(paper={"our": {}}))


def test_every_row_stands_for_a_variant():
    assert set(tables.TABLES) >= {"extrass-1", "extrass-2", "extrass-3", "extranet-4", "extranet-7", "fasset-2"}
    for table in tables.TABLES.values():
        unknown = {row.variant for row in table.rows.values() if row.variant} - set(VARIANTS)
        assert not unknown, (table.name, unknown)
        assert set(table.paper) == set(table.rows), table.name


def test_the_command_names_what_is_wrong(tmp_path, capsys):
    from experiments.tables.__main__ import main

    assert main(["extrass-9", "--out", str(tmp_path)]) == 2
    assert "unknown table 'extrass-9'; choose from extrass-1" in capsys.readouterr().out.replace("\n", " ")
    assert main(["--list"]) == 0
    assert "extranet-4" in capsys.readouterr().out


def test_the_command_fills_a_table(tmp_path, monkeypatch, capsys):
    """The comparison itself is tested elsewhere: here it returns known rows."""
    from experiments import experiment
    from experiments.tables.__main__ import main

    asked = {}

    def fake(request, console):
        asked.update(request._asdict())
        return {"dataset": "d", "environment": {}, "seconds": {}, **METRICS}

    monkeypatch.setattr(experiment, "run_experiment", fake)
    monkeypatch.setitem(tables.TABLES, "toy-1", TOY._replace(settings=("data.scale=4",)))
    assert main(["toy-1", "--preset", "smoke", "--out", str(tmp_path), "--set", "stages.steps=3"]) == 0
    assert asked["names"] == ("extrass", "taau") and asked["overrides"] == ("data.scale=4", "stages.steps=3")
    content = json.loads((tmp_path / "tables.json").read_text())
    assert content["tables"]["toy-1"]["ours"]["PSNR"] == 25.0 and content["runs"][0]["tables"] == ["toy-1"]
    monkeypatch.setitem(tables.TABLES, "toy-1", TOY._replace(half_input=True))
    assert main(["toy-1", "--preset", "paper", "--out", str(tmp_path)]) == 0
    assert asked["overrides"] == ("data.size=[480,270]", "stages.crop=[64,64]")
    assert "**25.00**" in (tmp_path / "tables.md").read_text() and "toy-1" in capsys.readouterr().out
