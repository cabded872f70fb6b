"""A network that does nothing is named, and so is a training that was too short; nothing else is."""

import io
import types

import numpy as np
import pytest
from rich.console import Console

from experiments import health
from experiments.evaluate import Clip, Runner
from experiments.progress import Phases, TrainingProgress
from experiments.run import exit_code


def report(steps, still=0):
    return {"steps": steps, "seconds": 45.2, "compile_seconds": 21.0, "still": still, "validated": [], "terms": {}}


def test_how_long_it_trained():
    assert health.training_note({"frnet": report(1), "extrassnet": report(250)}) == [
        "Training: frnet 1 step in 45 s (waited 21 s to be compiled); "
        "extrassnet 250 steps in 45 s (waited 21 s to be compiled)."
    ]
    assert health.training_note({}) == []
    validated = [{"step": step, "ess": psnr} for step, psnr in ((0, 23.0), (50, 22.0), (100, 22.126), (150, 22.1))]
    assert health.training_note({"frnet": {**report(150), "validated": validated}})[0].endswith(
        "(waited 21 s to be compiled), kept as it was at step 100, the best of 3 validations (ESS 22.13 dB)."
    )


def test_a_training_that_did_harm():
    start, worse, better = ({"step": n, "ss": psnr, "ess": 20.0} for n, psnr in enumerate((22.0, 21.9, 22.1)))
    reports = {
        "frnet": {**report(150), "validated": [start, worse]},
        "net": {**report(150), "validated": [start, better, worse]},
    }
    reports |= {"never": report(150), "interrupted": {**report(1), "validated": [start]}}
    assert health.no_gain(reports) == [
        "frnet: on the validation frames it is at 20.95 dB, at its start it was at 21.00 dB: this training did harm. "
        "Give it more steps or a smaller learning rate."
    ]


def test_few_steps():
    warnings = health.few_steps({"frnet": report(1), "extrassnet": report(health.FEW_STEPS)})
    assert len(warnings) == 1 and warnings[0].startswith("frnet made only 1 step: too few to learn much")
    assert "--set frnet.seconds=N (or .steps=N)" in warnings[0]


@pytest.mark.parametrize(
    ("steps", "still", "dead"),
    [(300, 9, False), (300, 10, True), (300, 290, True), (6, 5, False), (6, 6, True), (0, 0, False)],
)
def test_a_gradient_of_zero(steps, still, dead):
    messages = health.still_stages({"dlctus": report(steps, still)})
    assert bool(messages) == dead
    if dead:
        assert messages == [f"dlctus: the gradient is exactly zero since step {steps - still + 1} of {steps}."]


def rows(method, *values, kinds=("ss", "ess")):
    return [
        {"method": method, "sequence": name, "frames": kind, "resolution": "hr", "psnr": value}
        for (name, kind), value in zip([(n, k) for n in ("a", "b", "mean") for k in kinds], values, strict=True)
    ]


def test_a_row_that_is_another_methods():
    ours = (20.0, 21.0, 22.0, 23.0, 21.0, 22.0)
    owners = {"jau": None, "taau": None, "dlctus": "dlctus", "twin": "dlctus"}
    table = rows("jau", *ours) + rows("taau", *ours) + rows("twin", *(value + 3e-5 for value in ours))
    message = "{}: its row is that of jau, so its network adds nothing."
    found = health.same_rows(table + rows("dlctus", *ours), {name: owners[name] for name in ("jau", "dlctus", "twin")})
    assert found == [message.format("dlctus"), message.format("twin")]
    alive = rows("dlctus", *ours[:3], 23.1, *ours[4:])  # one kind of one sequence is enough
    assert health.same_rows(rows("jau", *ours) + alive, {"jau": None, "dlctus": "dlctus"}) == []
    fewer = rows("dlctus", *ours[::2], kinds=("ss",))  # a method that predicts one kind, against that kind
    assert health.same_rows(rows("jau", *ours) + fewer, {"jau": None, "dlctus": "dlctus"}) == [message.format("dlctus")]
    assert health.same_rows(rows("jau", *ours[::2], kinds=("ss",)) + rows("dlctus", *ours), owners) == []
    both = rows("nsrr", *ours) + rows("dlctus", *ours)
    assert health.same_rows(both, {"nsrr": "nsrr", "dlctus": "dlctus"}) == [
        "dlctus: its row is that of nsrr, so its network adds nothing."
    ]
    empty = [{**row, "psnr": None} for row in rows("dlctus", *ours)]
    assert health.same_rows(rows("jau", *ours) + empty, {"jau": None, "dlctus": "dlctus"}) == []


class Painter(Runner):
    """Shows its variables."""

    def __init__(self, value):
        self.method = types.SimpleNamespace(info=types.SimpleNamespace(renders_all=False))
        self.variables = {"net": value}

    def __call__(self, sequence, schedule):
        return np.full((len(sequence["t"]), 2, 3, 3), self.variables["net"], np.float32)


@pytest.mark.parametrize(("before", "same"), [(0.5, True), (0.50001, False), (np.nan, False)])
def test_pictures_as_before_training(before, same):
    clip = Clip("a", {"t": np.zeros(20)}, (), [], np.zeros(0), True)  # type: ignore[arg-type]
    clip.exposure = np.ones(20, np.float32)
    found = health.unchanged("dlctus", Painter(0.5), {"net": before, "frozen": 3}, clip)
    assert found == (["dlctus: it shows the same as before training."] if same else [])


def test_a_dead_network_is_named_while_it_trains_and_when_the_command_ends():
    output = io.StringIO()
    console = Console(file=output, width=200)
    with Phases(console) as phases:
        shown = TrainingProgress(phases, "dlctus: ")
        shown.on_compile("net")
        for step in range(1, 40):
            shown.on_step("net", step, step / 40, {"loss": 0.1, "gradient_norm": 0.1 if step < 20 else 0.0})
    assert output.getvalue().count("Dead network: dlctus: net: the gradient is exactly zero since step 20.") == 1
    assert exit_code({"dead": []}, console) == 0
    assert exit_code({"dead": ["net: [x]."]}, console) == 1
    assert output.getvalue().endswith("Dead network: net: [x].\n")
