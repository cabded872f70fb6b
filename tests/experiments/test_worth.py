"""What buffers are worth: sets that can be taken away, rows for each, one error for what cannot."""

import json

import jax
import numpy as np
import pytest

from essjax import methods
from essjax.data import read_dataset, write_dataset, write_sequence
from experiments import worth
from tests.helpers import make_sequence


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    root = tmp_path_factory.mktemp("worth")
    made = make_sequence(0, 8, 1, 12, 16)
    write_sequence(root / "data", "s", jax.tree.map(lambda leaf: np.array(leaf[:, 0]), made))
    write_dataset(root / "data", {"test": ["s"]})
    methods.save(root / "w.safetensors", methods.extrass_w(), {})
    return root


def test_each_set_has_its_row_and_what_is_looked_at_matters(files, capsys):
    out = files / "worth.json"
    arguments = [str(files / "w.safetensors"), "--data", str(files / "data"), "--without", "normal", "stencil"]
    assert worth.main([*arguments, "--rates", "3", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "extrass-w without normal" in text and "1:3 +2" in text and "taau-half" in text
    rows = json.loads(out.read_text())["rows"]
    found = {(row["without"], row["distance"]): row["psnr"] for row in rows if row["method"] == "extrass-w"}
    assert set(found) == {(names, distance) for names in ("", "normal", "stencil") for distance in (1, 2)}
    assert found["stencil", 1] == found["", 1] != found["normal", 1]


def test_by_default_each_alone_both_guides_and_all(files):
    dataset = read_dataset(files / "data")
    sets = worth.sets_of(dataset, methods.extrass_w(), ())
    assert sets[0] == () and ("base_color",) in sets and ("base_color", "normal") in sets
    assert max(sets, key=len)[:2] == ("base_color", "normal") and len(max(sets, key=len)) == 8
    assert ("base_color",) not in worth.sets_of(dataset, methods.fasset(), ())


@pytest.mark.parametrize("name", ["base_colour", "depth"])
def test_what_cannot_be_taken_is_one_line(files, capsys, name):
    arguments = [str(files / "w.safetensors"), "--data", str(files / "data"), "--without", name]
    assert worth.main(arguments) == 2
    assert "--without: expected some of base_color, normal," in " ".join(capsys.readouterr().out.split())
