import base64
import html.parser
import io
import json
import re

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from experiments.report import images as pixels
from experiments.report import print_table, write_report
from experiments.report.pictures import make_picture
from experiments.report.rows import COLUMNS, headline, make_table
from experiments.report.sheets import sheet_name

METHODS = ("bilinear", "extrass", "taau", "taau-half")
REFERENCES = {"taau": "renders every frame: twice the input"}
H, W = 27, 48  # an odd height


def row(method, frames, psnr, **more):
    row = {"method": method, "sequence": "mean", "frames": frames, "resolution": "hr", "psnr": psnr, "ssim": psnr / 40}
    return {**row, "psnr_holes": psnr - 6, "tpsnr": psnr - 1, "hole_share": 0.05, **more}


def make_metrics():
    rows = [row("bilinear", "ss", 24.0, warped_error=0.012, warped_error_reference=0.010)]
    rows += [row("extrass", "ss", 29.0, psnr_range=0.1, warped_error=0.009, warped_error_reference=0.010)]
    rows += [row("extrass", "ess", 28.5, psnr_holes=None), row("taau", "ss", 31.0)]
    rows += [row("taau-half", "ss", 28.0), row("taau-half", "ess", 26.0)]
    rows += [{**r, "sequence": "rods & <grilles>", "psnr": r["psnr"] - 1} for r in rows]
    rows += [{**row(m, "ess", v), "resolution": "lr"} for m, v in (("warp", 23.0), ("extrass-w", 25.0))]
    return {
        "schema": 1, "variant": "extrass", "preset": "quick", "dataset": "built-in scenes", "rows": rows,
        "overrides": ["width=24", "seed=3"],
        "environment": {"commit": "0123456789abcdef", "device": "cpu", "versions": {"jax": "0.10.2"}, "seed": 3},
        "seconds": {"train": 61.4},
        "costs": {"extrass": {"parameters": 262141, "multiply_adds": {"ss": 1_500_000_000, "ess": 2_000_000_000},
                              "latency": 0}, "ifrnet": {"parameters": 7, "multiply_adds": {"ss": 0}, "latency": 1}},
    }  # fmt: skip


def make_entry(frame=6, height=H, width=W):
    rng = np.random.default_rng(frame)
    reference = rng.uniform(0, 4, (height, width, 3)).astype(np.float32)
    images = {"reference": reference, "input": reference[::2, ::2]}
    images |= {method: reference * (1 + 0.1 * k) for k, method in enumerate(METHODS)}
    images["bilinear"] = reference.copy()
    images["bilinear"][15:25, 30:44] += 3.0  # where the methods disagree most
    previous = {name: image * 0.9 for name, image in images.items() if name != "input"}
    return {
        "sequence": "rods & <grilles>", "frame": frame, "kind": "ess", "resolution": "hr", "images": images,
        "previous": previous,
    }  # fmt: skip


def make_curves():
    points = [
        {"frame": n, "kind": kind, "resolution": "hr", "psnr": 20.0 + n, "tpsnr": None, "ssim": np.float32(0.5)}
        for n in (5, 6)
        for kind in ("ss", "ess")
    ]
    return {method: {"rods & <grilles>": points} for method in METHODS}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    path = write_report(
        folder, make_metrics(), curves=make_curves(), pictures=[make_entry(6), make_entry(7)], references=REFERENCES,
        notes=["No native colour, so no taa row </script> {{data}}."],
    )  # fmt: skip
    return path, path.read_text(encoding="utf-8")


def page_data(text):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S).group(1))


class Checker(html.parser.HTMLParser):
    """Collects text, attributes that load something, and elements that are not closed in order."""

    VOID = {"meta", "input", "br", "link", "img"}

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.cells, self.wrong = [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.loads += [value for name, value in attributes if name in ("src", "href", "srcset", "action")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th", "b", "small"):
            self.cells.append(data)


def test_page_is_well_formed_and_self_contained(report):
    path, text = report
    checker = Checker()
    checker.feed(text)
    assert not checker.wrong and not checker.open
    assert not checker.loads  # pictures are in the data, style and script are inline
    assert not re.search(r"https?://|url\(|@import|import\(|fetch\(|XMLHttpRequest", text)
    assert path.stat().st_size < 2_000_000
    for method in (*METHODS, "warp", "extrass-w"):
        assert method in checker.cells
    assert "29.00 ±0.10" in checker.cells and "renders every frame: twice the input" in checker.cells
    facts = ("0123456789ab", "jax 0.10.2", "61 s", "quick width=24 seed=3")
    for expected in (*facts, "extrass: 29.00 dB on rendered frames"):
        assert expected in text
    assert "no taa row &lt;/script&gt; {{data}}." in text  # notes are escaped and not taken for marks
    assert "<grilles>" not in text


def test_data_of_the_page(report):
    data = page_data(report[1])
    assert data["variant"] == "extrass" and data["references"] == ["taau"]
    assert data["curves"]["extrass"]["rods & <grilles>"][0] == {
        "frame": 5, "kind": "ss", "resolution": "hr", "psnr": 25.0, "tpsnr": None, "ssim": 0.5
    }  # fmt: skip
    picture = data["pictures"][0]
    names = [image["name"] for image in picture["images"]]
    assert names[0] == "input" and names[-1] == "reference" and set(names) == {*METHODS, "input", "reference"}
    assert (picture["width"], picture["height"]) == (W, H)
    assert {image["name"] for image in picture["images"] if image["flicker"]} == set(METHODS)
    x, y = picture["focus"]
    wide, high = picture["crop"]
    assert x <= 37 < x + wide and y <= 20 < y + high  # the middle of the disagreement


def test_pictures_are_stored_without_loss(report):
    images = {image["name"]: image for image in page_data(report[1])["pictures"][0]["images"]}
    linear = make_entry(6)["images"]["taau"].astype(np.float64)
    linear = linear / (1 + linear)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    stored = Image.open(io.BytesIO(base64.b64decode(images["taau"]["src"].split(",")[1])))
    assert stored.size == (W, H)
    assert np.abs(np.asarray(stored.convert("RGB")) - expected).max() <= 0.51


def test_every_element_of_the_page_that_the_script_uses_exists(report):
    text = report[1]
    wanted = set(re.findall(r'pick\("([\w-]+)"\)', text)) | {
        f"curve-{n}" for n in ("sequence", "metric", "kind", "resolution")
    }
    wanted |= {"left", "right", "tag-left", "tag-right"}
    assert wanted <= set(re.findall(r'id="([\w-]+)"', text))
    assert "{{" not in text.replace("{{data}}.", "")


def test_sheets_show_every_method_and_stale_ones_go(report, tmp_path):
    folder = report[0].parent / "sheets"
    names = {sheet_name(make_picture(make_entry(n))) for n in (6, 7)}
    assert names == {"rods-grilles-_0006_ess_hr.png", "rods-grilles-_0007_ess_hr.png"}
    assert {path.name for path in folder.iterdir()} == names
    sheet = np.asarray(Image.open(folder / "rods-grilles-_0006_ess_hr.png"))
    assert sheet.shape[1] == 10 + 6 * 330  # six columns: input, four methods, reference
    assert all(sheet[60:200, 10 + 330 * k : 330 * (k + 1)].std() > 5 for k in range(6))
    write_report(tmp_path, make_metrics(), pictures=[make_entry(6)])
    write_report(tmp_path, make_metrics(), pictures=[make_entry(7)])
    assert [path.name for path in (tmp_path / "report" / "sheets").iterdir()] == ["rods-grilles-_0007_ess_hr.png"]


def test_size_limit_drops_pictures_from_the_end_and_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("experiments.report.page.PAGE_BYTES", 60_000)
    monkeypatch.setattr("experiments.report.page.SHEET_BYTES", 1)
    text = write_report(tmp_path, make_metrics(), pictures=[make_entry(n) for n in range(6, 12)]).read_text()
    kept = [picture["frame"] for picture in page_data(text)["pictures"]]
    assert 0 < len(kept) < 6 and kept == list(range(6, 6 + len(kept)))
    assert f"{6 - len(kept)} of 6 pictures were left out" in text
    assert not list((tmp_path / "report" / "sheets").iterdir())


def test_a_report_needs_neither_pictures_nor_curves(tmp_path):
    data = page_data(write_report(tmp_path, make_metrics()).read_text())
    assert data["pictures"] == [] and data["curves"] == {}


def test_table_order_best_and_references():
    table = make_table(make_metrics(), "hr", "mean", REFERENCES)
    assert [line.method for line in table.lines] == ["extrass", "taau-half", "bilinear", "taau"]
    assert table.kinds == ["ss", "ess"] and "holes: 5.0 %" in table.title
    cells = {
        line.method: dict(zip([(k, c.key) for k in table.kinds for c in COLUMNS], line.cells, strict=True))
        for line in table.lines
    }
    assert cells["extrass"]["ss", "psnr"] == ("29.00 ±0.10", True)
    assert cells["taau"]["ss", "psnr"] == ("31.00", False)  # more, but not comparable
    assert cells["bilinear"]["ess", "psnr"] == ("–", False)
    assert cells["extrass"]["ess", "psnr_holes"] == ("–", False)
    assert cells["taau-half"]["ess", "psnr_holes"] == ("20.00", False)  # the only one: no best
    assert cells["bilinear"]["ss", "warped_error"] == ("+2.00", False)
    assert cells["extrass"]["ss", "warped_error"] == ("-1.00", True)  # nearest to the reference
    without = make_table(make_metrics(), "hr", "mean")
    assert without.lines[0].method == "taau" or without.lines[0].cells[0].text != "31.00"


def test_frames_that_are_not_finite_stand_in_the_remark():
    metrics = make_metrics()
    for row in metrics["rows"]:
        if row["method"] in ("bilinear", "taau") and row["frames"] == "ss":
            row |= {"psnr": None, "non_finite": 3}
    lines = {line.method: line for line in make_table(metrics, "hr", "mean", REFERENCES).lines}
    expected = "NaN or infinity in or before 3 frames: no mean of what they spoil"
    assert lines["bilinear"].remark == expected and lines["bilinear"].cells[0] == ("–", False)
    assert lines["taau"].remark == f"{REFERENCES['taau']}; {expected}" and lines["extrass"].remark == ""


def test_headline_names_the_best_comparable_rival():
    assert headline(make_metrics(), REFERENCES) == (
        "extrass: 29.00 dB on rendered frames (+1.00 against taau-half), "
        "28.50 dB on extrapolated frames (+2.50 against taau-half)."
    )
    assert "(-2.00 against taau)" in headline(make_metrics())


@pytest.mark.parametrize("width, columns", [(80, 6), (140, 10)])
def test_terminal_table_fits(width, columns):
    console = Console(width=width, record=True, file=io.StringIO())
    print_table(make_metrics(), references=REFERENCES, console=console)
    text = console.export_text()
    line = next(line for line in text.splitlines() if line.strip().startswith("extrass "))
    assert "29.00 ±0.10" in line and "28.50" in line and "…" not in text
    assert len(re.findall(r"[+-]?\d+\.\d+|–", line.replace("±0.10", ""))) == columns
    assert "* taau: renders every frame: twice the input" in text
    assert text.index("extrass-w") < text.rindex("warp ")


def test_maps_by_hand():
    reference = np.zeros((2, 2, 3), np.float32)
    image = np.zeros((1, 1, 3), np.float32) + [0.3, 0.0, 0.0]
    np.testing.assert_allclose(pixels.error(image, reference), 0.1, atol=1e-6)  # mean over the channels, stretched
    np.testing.assert_allclose(pixels.flicker(image, 0 * image, reference, reference), 0.1, atol=1e-6)
    np.testing.assert_allclose(pixels.flicker(image, image, reference + 0.2, reference), 0.2, atol=1e-6)
    lightness = pixels.color_map().astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) >= -0.5).all() and lightness[-1] > 220 and lightness[0] < 5
    np.testing.assert_array_equal(pixels.colored(np.array([[0.0, 9.0]]), 4.0)[0], pixels.color_map()[[0, 255]])


def test_broken_pixels_do_not_break_the_page(tmp_path):
    entry = make_entry()
    entry["images"]["extrass"] = np.full((H, W, 3), np.nan, np.float32)
    entry["images"]["taau"] = np.full((H, W, 3), np.inf, np.float32)
    assert page_data(write_report(tmp_path, make_metrics(), pictures=[entry]).read_text())["pictures"]


def test_messages(tmp_path):
    entry = make_entry()
    with pytest.raises(ValueError, match="expected the keys sequence, .*; missing: kind"):
        write_report(tmp_path, make_metrics(), pictures=[{k: v for k, v in entry.items() if k != "kind"}])
    with pytest.raises(ValueError, match='frame 6: expected an image "reference", got taau'):
        write_report(tmp_path, make_metrics(), pictures=[{**entry, "images": {"taau": entry["images"]["taau"]}}])
    with pytest.raises(ValueError, match=r"frame 6, taau: expected an image \[H, W, 3\], got \(1, 27, 48, 3\)"):
        images = {**entry["images"], "taau": entry["images"]["taau"][None]}
        write_report(tmp_path, make_metrics(), pictures=[{**entry, "images": images}])


def test_costs_stand_in_a_table_of_their_own(report):
    _, page = report
    assert '<th scope="row">extrass</th><td>262,141</td><td>1.500</td><td>2.000</td><td>0</td>' in page
    assert '<th scope="row">ifrnet</th><td>7</td><td>0.000</td><td>–</td><td>1</td>' in page


def test_how_training_went_is_shown_without_a_script(tmp_path):
    loss = [(step, 0.5 / step) for step in range(1, 1001)]
    validated = [{"step": 300, "ss": 20.0, "ess": 19.0}, {"step": 1000, "ss": 21.5, "ess": 19.5}]
    training = {
        "a <b>": {"loss": loss, "validated": validated},
        "few": {"loss": loss[:1], "validated": validated[:1]},  # one point is no curve
        "broken": {"loss": loss[:2], "validated": [{"step": 1, "ss": float("nan")}, {"step": 2, "ss": float("inf")}]},
    }
    text = write_report(tmp_path, make_metrics(), training=training).read_text()
    assert re.findall(r"<figcaption>([^<]*): (loss|validation, dB)<", text) == [
        ("a &lt;b&gt;", "loss"), ("a &lt;b&gt;", "validation, dB"), ("broken", "loss")
    ]  # fmt: skip
    lines = [line.split() for line in re.findall(r'<polyline points="([^"]*)"', text)]
    assert [len(line) for line in lines] == [143, 2, 2, 2]  # loss, ESS and SS in the order of the scores, loss
    heights = [float(point.split(",")[1]) for point in lines[0]]
    assert heights == sorted(heights) and ">21.5<" in text and ">19<" in text and ">step 1000<" in text
    assert "Learning" not in write_report(tmp_path, make_metrics()).read_text()
