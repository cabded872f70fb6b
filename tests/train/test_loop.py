"""The loop: an interrupted run continues as if nothing had happened, whatever stopped it; budgets; NaN."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from essjax.train import Budget, Interrupted, NonFiniteLoss, Validation, best_validation
from tests.train import tiny_run


def losses(folder):
    """The log without its clock."""
    lines = [json.loads(line) for line in (Path(folder) / "log.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Folder and final state of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    state, summary = tiny_run.run(folder)
    assert summary["steps"] == tiny_run.STEPS == int(state["state"].step)
    return folder, state


def assert_same_run(folder, state, uninterrupted):
    expected_folder, expected = uninterrupted
    assert losses(folder) == losses(expected_folder)
    jax.tree.map(np.testing.assert_array_equal, state, expected)


def test_log_and_schedule(uninterrupted):
    lines = losses(uninterrupted[0])
    assert [line["step"] for line in lines] == list(range(1, tiny_run.STEPS + 1))
    assert set(lines[0]) == {"step", "near", "far", "loss", "gradient_norm"}
    np.testing.assert_allclose([line["near"] + line["far"] for line in lines], [line["loss"] for line in lines])
    assert lines[-1]["near"] < lines[0]["near"]
    assert len({line["near"] for line in lines}) == len(lines)  # the clips differ


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_after_the_step_and_resumes_exactly(tmp_path, uninterrupted, number):
    before = signal.getsignal(number)

    def on_step(step, progress, terms):
        if step == 5:
            os.kill(os.getpid(), number)

    message = "stopped at step 5; the state is saved. Run the same command with --resume."
    with pytest.raises(Interrupted, match=re.escape(message)):
        tiny_run.run(tmp_path, on_step=on_step)
    assert signal.getsignal(number) is before
    assert len(losses(tmp_path)) == 5
    steps = []
    state, _ = tiny_run.run(tmp_path, on_step=lambda step, progress, terms: steps.append(step))
    assert steps == list(range(6, tiny_run.STEPS + 1))
    assert_same_run(tmp_path, state, uninterrupted)


def test_kill_9_and_resume(tmp_path, uninterrupted):
    arguments = [sys.executable, "-m", "tests.train.tiny_run", str(tmp_path), "0.15"]
    process = subprocess.Popen(arguments, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 120
        while not any(path.name in ("3", "4", "5") for path in (tmp_path / "checkpoints").glob("*")):
            assert process.poll() is None and time.monotonic() < deadline, "it never saved a third step"
            time.sleep(0.02)
        time.sleep(float(np.random.default_rng().uniform(0.0, 0.3)))  # in a step, in a save, or between
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 99, "ne')  # a line that was torn
    steps = []
    state, _ = tiny_run.run(tmp_path, on_step=lambda step, progress, terms: steps.append(step))
    assert 1 < steps[0] <= tiny_run.STEPS  # neither from the start nor from a checkpoint at the end
    assert_same_run(tmp_path, state, uninterrupted)


def test_a_log_without_checkpoint_starts_again(tmp_path, uninterrupted):
    (tmp_path / "log.jsonl").write_text('{"step": 1}\n{"step": 2}\n')
    state, _ = tiny_run.run(tmp_path)
    assert_same_run(tmp_path, state, uninterrupted)


def test_finished_stage_is_only_restored(tmp_path, uninterrupted):
    _, expected = uninterrupted
    state, summary = tiny_run.run(uninterrupted[0], on_step=lambda *_: pytest.fail("it trained again"))
    jax.tree.map(np.testing.assert_array_equal, state, expected)
    assert summary["steps"] == tiny_run.STEPS


class Batches:
    """The tiny batches, each after a pause in seconds."""

    def __init__(self, pause=0.0):
        self.pause, self.batches = pause, tiny_run.tiny_batches()

    def __next__(self):
        time.sleep(self.pause)
        return next(self.batches)

    def get_state(self):
        return self.batches.get_state()

    def set_state(self, state):
        self.batches.set_state(state)


def test_the_best_averaged_weights_are_kept(uninterrupted):
    """Steps 3, 6, 9 and 12 are validated; the score falls after its peak, so the last weights are not the best."""
    _, end = uninterrupted
    assert [entry["step"] for entry in end["validated"]] == [0, 3, 6, 9, 12]
    scores = [entry["ss"] for entry in end["validated"]]
    score = tiny_run.validation().score
    np.testing.assert_allclose(score(end["variables"])["ss"], max(scores), rtol=1e-5)
    averages = {"fit": {"w": end["state"].average}}
    np.testing.assert_allclose(score(averages)["ss"], scores[-1], rtol=1e-5)
    assert scores[-1] < max(scores) and np.any(end["state"].average != end["state"].variables["fit"]["w"])
    np.testing.assert_array_equal(end["variables"]["fit"]["w"], end["best"]["w"])
    assert end["variables"]["frozen"] == {"b": 1.0}


def test_without_validation_the_average_is_kept(tmp_path, uninterrupted):
    end, _ = tiny_run.run(tmp_path, validation=None)
    np.testing.assert_array_equal(end["variables"]["fit"]["w"], end["state"].average)
    jax.tree.map(np.testing.assert_array_equal, end["state"], uninterrupted[1]["state"])
    assert end["validated"] == []


def test_kill_in_a_validation_and_resume(tmp_path, uninterrupted):
    """Nothing of a validation that was torn is left: here its third one raises, with a checkpoint after each step."""
    calls = []

    def score(variables):
        calls.append(len(calls))
        if len(calls) == 3:
            raise RuntimeError("killed")
        return tiny_run.validation().score(variables)

    with pytest.raises(RuntimeError, match="killed"):
        tiny_run.run(tmp_path, validation=Validation(score, 4), save_every=0.0)
    end, _ = tiny_run.run(tmp_path)
    assert_same_run(tmp_path, end, uninterrupted)


@pytest.mark.parametrize(
    ("scores", "best"),
    [
        ([20.0], 0),
        ([20.0, 21.0], 1),
        ([21.0, 20.0], 0),
        ([20.0, 20.0], 1),  # as good, and seen more
        ([np.nan], 0),
        ([20.0, np.nan], 0),
        ([np.nan, 20.0], 1),
        ([np.nan, np.nan], 1),
    ],
)
def test_the_best_validation(scores, best):
    start = {"step": 0, "ss": 30.0, "ess": 30.0}  # never kept, however good
    validated = [{"step": 1000 - n, "ss": score, "ess": score} for n, score in enumerate(scores)]
    assert best_validation([start, *validated]) == best + 1 and best_validation([start]) == 0
    first, second = {"step": 1, "ss": 20.0, "ess": 20.1}, {"step": 2, "ss": 30.0, "ess": 10.0}
    assert best_validation([start, first, second]) == 1  # the mean over kinds


def test_validation_is_announced_and_not_on_the_clock(tmp_path):
    events = []
    _, summary = tiny_run.run(
        tmp_path, validation=Validation(lambda variables: time.sleep(0.3) or {"ss": 1.0}, 2), budget=Budget(4, 0.5),
        on_validation=lambda step, progress, scores: events.append((step, scores)),
    )  # fmt: skip
    assert events == [event for step in (0, 2, 4) for event in ((step, {}), (step, {"ss": 1.0}))]
    assert summary["seconds"] < 0.5 and summary["validation_seconds"] > 0.9


def test_clock_ends_a_stage(tmp_path):
    _, summary = tiny_run.run(tmp_path, budget=Budget(None, 0.4), batches=Batches(0.05))
    assert 1 <= summary["steps"] <= 9 and 0.4 <= summary["seconds"] < 5.0


class SlowToCompile:
    """The tiny step, whose compilation takes ``seconds``."""

    def __init__(self, seconds):
        self.seconds = seconds

    def lower(self, *arguments):
        self.lowered = tiny_run.tiny_step().lower(*arguments)
        return self

    def compile(self):
        time.sleep(self.seconds)
        return self.lowered.compile()


def test_the_clock_counts_neither_compilation_nor_saving(tmp_path):
    """A budget shorter than the compilation still gives as many steps as fit into it; so does one that is resumed."""
    events = []
    options = {
        "batches": Batches(0.02), "step": SlowToCompile(0.6), "on_compile": lambda: events.append("compile"),
        "on_step": lambda step, progress, terms: (events.append(step), time.sleep(0.1)),
    }  # fmt: skip
    _, first = tiny_run.run(tmp_path, budget=Budget(3, 0.5), **options)
    assert events == ["compile", 1, 2, 3] and first["seconds"] < 0.5 and first["compile_seconds"] > 0.6
    _, second = tiny_run.run(tmp_path, budget=Budget(5, 0.5), **options)
    assert events[4:] == ["compile", 4, 5] and first["seconds"] < second["seconds"] < 0.5
    assert second["compile_seconds"] > first["compile_seconds"] + 0.6
    _, third = tiny_run.run(tmp_path, budget=Budget(5, 0.5), **options)  # at its end: nothing is compiled
    assert len(events) == 7 and {**third, "terms": second["terms"]} == second


def test_a_compiled_step_is_taken_as_it_is(tmp_path, uninterrupted):
    batch = next(tiny_run.tiny_batches())
    compiled = tiny_run.tiny_step().lower(tiny_run.initial_state(), batch, 0.1).compile()
    state, summary = tiny_run.run(tmp_path, step=compiled, on_compile=lambda: pytest.fail("it compiled"))
    assert_same_run(tmp_path, state, uninterrupted)
    assert summary["compile_seconds"] == 0.0


def test_steps_without_a_gradient_are_counted_across_a_stop(tmp_path):
    """The gradient is zero in the first 4 steps, then not, then again from step 8 on; runs end at 4, 6, 10 and 12."""

    def step(state, batch, rate):
        state, terms = tiny_run.tiny_step()(state, batch, rate)
        return state, {**terms, "gradient_norm": 1e-30 if 5 <= int(state.step) <= 7 else 0.0}

    found = [tiny_run.run(tmp_path, step=step, budget=Budget(n, None))[1]["still"] for n in (4, 6, 10, 12)]
    assert found == [4, 0, 3, 5]


class Poisoned(Batches):
    """The tiny batches, with NaN in the reference of batch ``bad`` (counted from 1)."""

    def __init__(self, bad):
        super().__init__()
        self.bad, self.count = bad, 0

    def __next__(self):
        self.count += 1
        batch = super().__next__()
        if self.count == self.bad:
            batch.reference[1, 0, 2, 3, 0] = np.nan
        return batch


def test_non_finite_loss_names_the_term_and_saves_the_batch(tmp_path):
    with pytest.raises(NonFiniteLoss) as caught:
        tiny_run.run(tmp_path, batches=Poisoned(4), save_every=0.0)
    path = tmp_path / "non_finite_batch_4.npz"
    assert str(caught.value).startswith(f"step 4: not finite: far, gradient_norm. The batch is in {path}")
    assert "Check the data (NaN, negative or huge radiance) or lower the learning rate." in str(caught.value)
    with np.load(path) as saved:
        assert np.argwhere(np.isnan(saved["reference"])).tolist() == [[1, 0, 2, 3, 0]]
        assert saved["frames.color"].shape == (3, 2, 3, 4, 3)
        assert {"frames.motion", "frames.gbuffers.depth", "frames.jitter", "frames.cut"} <= set(saved.files)
    assert len(losses(tmp_path)) == 3  # only what was good
    steps = []
    tiny_run.run(tmp_path, on_step=lambda step, progress, terms: steps.append(step))
    assert steps[0] == 4  # the last checkpoint is from before the bad batch
    assert np.isfinite([line["loss"] for line in losses(tmp_path)]).all()


def test_budget():
    assert Budget(10, None).progress(4, 1e9) == 0.4
    assert Budget(None, 20.0).progress(1000, 5.0) == 0.25
    assert Budget(10, 20.0).progress(4, 18.0) == 0.9  # whichever ends first
    assert Budget(10, 20.0).progress(8, 1.0) == 0.8
    assert Budget(10, 20.0).progress(30, 1.0) == 1.0
    for nothing in (Budget(0, None), Budget(None, 0.0), Budget(-1, 20.0)):
        assert nothing.progress(0, 0.0) == 1.0
    with pytest.raises(ValueError, match="budget: expected a limit in steps or in seconds, got neither"):
        Budget(None, None).progress(1, 1.0)
