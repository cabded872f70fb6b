"""Steps that are compiled while the data renders; that their shapes are right is tested with every variant."""

import threading
import types

import pytest

from experiments import ahead


@pytest.fixture
def compile_stages(monkeypatch):
    """Starts ``Ahead`` on stages whose compilation waits for an event; "broken" fails. Returns it, event and log.

    Each stage has the tasks that are given as its name's letters after a colon, else one.
    """
    go, log = threading.Event(), []

    def fake(member, stage, task):
        go.wait(10)
        log.append(stage.name + task)
        if stage.name == "broken":
            raise ValueError("crop: too small")
        return f"step of {stage.name}{task}"

    monkeypatch.setattr(ahead, "_compile", fake)

    def stages(names):
        parts = (name.partition(":") for name in names)
        return tuple(types.SimpleNamespace(name=name, tasks=dict.fromkeys(tasks or [""])) for name, _, tasks in parts)

    return lambda *names: (ahead.Ahead(types.SimpleNamespace(stages=stages(names))), go, log)  # type: ignore


def test_a_stage_waits_for_all_of_them(compile_stages):
    made, go, log = compile_stages("frnet", "extrassnet:ab")
    waiting = made.steps["frnet"][""].lower("state", "batch", 0.1)
    threading.Timer(0.1, go.set).start()
    assert waiting.compile() == "step of frnet" and log == ["frnet", "extrassneta", "extrassnetb"]
    assert made.steps["extrassnet"]["b"].lower().compile() == "step of extrassnetb"
    made.close()


def test_an_error_comes_where_the_step_is_needed(compile_stages):
    made, go, _ = compile_stages("frnet", "broken")
    go.set()
    with pytest.raises(ValueError, match="crop: too small"):
        made.steps["frnet"][""].compile()
    made.close()


def test_closing_begins_no_further_one(compile_stages):
    made, go, log = compile_stages("frnet", "extrassnet", "third")
    made.close()
    go.set()
    made._worker.shutdown(wait=True)
    assert log in ([], ["frnet"])
