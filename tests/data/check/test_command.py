"""``essjax check``: table, JSON, pictures and exit code."""

import json

from essjax import cli
from tests.data.check.corrupt import CONVENTIONS, NAME


def test_command_prints_writes_and_returns_a_code(copy, tmp_path, capsys):
    arguments = [str(a) for a in (copy, "--json", tmp_path / "out.json", "--pictures", tmp_path / "pictures")]
    assert cli.main(["check", *arguments, "--pairs", "2"]) == 0
    assert "looked at 3 of 7 frames" in " ".join(capsys.readouterr().out.split())
    (picture,) = (path.name for path in (tmp_path / "pictures").iterdir())
    assert picture.startswith(NAME) and picture.endswith(".as-stated.png")
    CONVENTIONS["x flipped"][0](copy)
    assert cli.main(["check", *arguments, "--pairs", "2"]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "motion, references: motion.X has the wrong sign: negate it at import" in output
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["verdict"] == "wrong" and content["findings"][0]["fix"].startswith("motion.X has the wrong sign")
    pictures = {p.name for p in (tmp_path / "pictures").iterdir()}
    assert pictures == {picture, picture.replace("as-stated", "x-flipped")}
    assert cli.main(["check", str(tmp_path)]) == 2 and "dataset.json: not found" in capsys.readouterr().out
