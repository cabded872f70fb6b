"""What the benchmark counts, its command, its files and its page."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import methods
from essjax.rollout import SS, bake, stream_step
from experiments.benchmark import __main__ as command
from experiments.benchmark import inputs, machine, schema, suites
from experiments.benchmark.measure import Case, measure, time_calls
from experiments.benchmark.section import section
from experiments.benchmark.suites import networks, pipeline, train, warp


def test_a_product_by_hand():
    a, b = np.ones((8, 16), np.float32), np.ones((16, 4), np.float32)
    row = measure(Case("product", lambda a, b: jnp.tanh(a @ b), (a, b), work={"pixels": 32}), 3)
    assert row["flops"] == 2 * 8 * 16 * 4
    assert row["least_bytes"] == 4 * (8 * 16 + 16 * 4 + 8 * 4)
    assert row["compilations"] == 1 and row["repetitions"] == 3 and row["compile_seconds"] > 0 < row["median_ms"]


def test_the_products_of_a_loop_count_once_per_turn():
    def loop(x):
        return jax.lax.scan(lambda x, _: (x @ x, None), x, length=5)[0]

    assert measure(Case("loop", loop, (np.eye(4, dtype=np.float32),)), 1)["flops"] == 5 * 2 * 4**3


def test_donated_state_goes_from_call_to_call():
    seen = []

    def following(arguments, output):
        seen.append(float(np.asarray(output)[0]))
        return (output,)

    measure(Case("count", lambda x: x + 1.0, (jnp.zeros(3),), donate=(0,), following=following), 2)
    assert seen == [1.0, 2.0, 3.0, 4.0]  # two to warm up, two timed


def test_roofline_fraction():
    limits = {"copy_bytes_per_second": 1e9, "float32_flops_per_second": 1e10, "bfloat16_flops_per_second": 1e11}
    by_memory = {"flops": 1e6, "least_bytes": 2e6, "median_ms": 4.0}
    assert machine.roofline_fraction(by_memory, limits) == pytest.approx(0.5)
    assert machine.roofline_fraction({**by_memory, "device_ms": 2.5}, limits) == pytest.approx(0.8)
    by_products = {"flops": 1e8, "least_bytes": 2e6, "median_ms": 20.0}
    assert machine.roofline_fraction(by_products, limits) == pytest.approx(0.5)
    assert machine.roofline_fraction(by_products, limits, "bfloat16") == pytest.approx(0.1)


@pytest.mark.parametrize("forward", networks.forwards(33, 32), ids=lambda forward: forward.name.split(",")[0])
def test_networks_are_those_of_the_methods(forward):
    """The channels of each network's inputs, against what its method makes."""
    made = {
        "ExtraSSNet": (methods.extrass(), "extrassnet"), "FRNet": (methods.extrass_e(), "frnet"),
        "ExtraNet": (methods.extranet(), "extranet"), "DLCTUS": (methods.dlctus(), "dlctus"),
        "FASSET": (methods.fasset(), "fasset"), "IFRNet": (methods.ifrnet(), "ifrnet"),
        "NSRR": (methods.nsrr(), "nsrr"),
    }  # fmt: skip
    method, entry = made[forward.name.split(",")[0].split(" ")[0]]
    key = jax.random.key(0)
    theirs = jax.eval_shape(method.init, key, inputs.frame(33, 32))[entry]
    ours = jax.eval_shape(lambda key: forward.network.init(key, *forward.init), key)
    if forward.name.startswith("FRNet"):  # the method's default is narrower or wider: only inputs matter
        theirs, ours = (jax.tree.leaves(tree["params"])[0].ndim for tree in (theirs, ours))
        assert theirs == ours
    else:
        assert jax.tree.map(jnp.shape, ours) == jax.tree.map(jnp.shape, theirs)


def test_streaming_is_the_unrolled_method_and_compiles_once():
    method, frames = methods.taau(), inputs.frames(3, 40, 32)
    method = bake(method, method.init(jax.random.key(0), frames[0]))
    assert pipeline.largest_difference(method, frames) < 1e-5
    seconds = pipeline.latencies(method, "float32", frames, 5)
    assert set(seconds) == {SS} and seconds[SS].shape == (5,) and (seconds[SS] > 0).all()
    assert stream_step(method, SS)._cache_size() == 1


def test_latency_counts_every_frame():
    found = pipeline.latency(np.array([1e-3, 2e-3, 3e-3, 10e-3]))
    assert sum(found["counts"]) == 4 and found["worst"] == 10.0 and found["p50"] == 2.5


def test_linear_fit_by_hand():
    share, r2 = train._fit([1.0, 2.0, 3.0], [3.0, 5.0, 7.0])  # 1 + 2 x
    assert share == pytest.approx(1 / 7) and r2 == pytest.approx(1.0)


@pytest.fixture
def result():
    row = {
        "name": "thing, 4x4", "implementation": "essjax", "median_ms": 2.0, "iqr_ms": 0.1, "repetitions": 3,
        "work": {"pixels": 4e6}, "flops": 4e9, "temporary_megabytes": 1.5,
    }  # fmt: skip
    peer = {key: row[key] for key in ("name", "iqr_ms", "repetitions", "work")}
    peer |= {"implementation": "torch eager", "median_ms": 5.0, "difference_from_essjax": 1e-6}
    return {
        "schema": 1, "kind": "benchmark", "suite": "warp", "rows": [row, peer], "facts": {"a ratio": 1.25},
        "environment": {
            "commit": "abc", "date": "2026-01-01", "device": "cpu", "versions": {"jax": "0", "python": "3"},
        },
        "machine": {
            "copy_bytes_per_second": 1e10, "float32_flops_per_second": 1e11, "bfloat16_flops_per_second": 2e11,
            "load_at_start": 0.5,
        },
        "settings": {"size": [4, 4], "repetitions": 3, "frames": 2},
    }  # fmt: skip


def test_the_page_of_a_gpu_shows_its_own_time(result):
    assert "profiler" not in section("benchmark-warp", result)
    result["rows"][0]["device_ms"] = 1.5
    page = section("benchmark-warp", result)
    assert "| thing, 4x4 | essjax | 2 | 0.1 | 1.5 |  | 2000 Mpixels/s |" in page
    assert "10 calls one after the other" in page


def test_the_page_shows_ratios_and_rates(result):
    page = section("benchmark-warp", result)
    assert "| thing, 4x4 | essjax | 2 | 0.1 |  | 2000 Mpixels/s | 2000 |" in page
    assert "| thing, 4x4 | torch eager | 5 | 0.1 | 2.50 | 800 Mpixels/s |" in page
    assert "copy 10.0 GB/s, product 100 GFLOP/s float32, 200 bfloat16" in page and "- a ratio: 1.25" in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("facts"), "result: facts is missing; expected schema, kind, suite"),
        (lambda r: r["rows"][0].update(median_ms="2"), "row 'thing, 4x4', median_ms: expected float, got '2'"),
        (lambda r: r["rows"][0].update(speed=1.0), "row 'thing, 4x4': unknown entry speed; expected name"),
        (lambda r: r["rows"][0].update(median_ms=0.0), "expected a positive median, got 0.0"),
        (lambda r: r.update(rows=[]), "expected at least one row, got none"),
        (lambda r: r["environment"].pop("commit"), "result, environment: commit is missing"),
        (lambda r: r.update(schema=2), "expected schema 1 and kind 'benchmark', got 2 and 'benchmark'"),
    ],
)
def test_the_schema_names_what_is_wrong(result, change, message):
    schema.check(result)
    change(result)
    with pytest.raises(ValueError, match=message):
        schema.check(result)


def test_the_command_writes_what_it_measured(tmp_path, monkeypatch, capsys):
    case = Case("double, 40x32", lambda x: x * 2.0, (np.ones((32, 40), np.float32),), work={"pixels": 1280})
    suite = suites.Suite(
        "", lambda options: iter([measure(case, options.repetitions)]), lambda rows: {"rows": len(rows)}
    )
    monkeypatch.setattr(suites, "load", lambda: {"warp": suite})
    monkeypatch.setattr(machine, "roofline", lambda n: {
        "copy_bytes_per_second": 1e10, "float32_flops_per_second": 1e11, "bfloat16_flops_per_second": 1e11
    })  # fmt: skip
    arguments = ["--suite", "warp", "--size", "40x32", "--repetitions", "2", "--out", str(tmp_path)]
    assert command.main(arguments) == 0
    (path,) = tmp_path.iterdir()
    assert path.name == f"benchmark-warp-cpu-jax-{jax.__version__}-40x32.json"
    written = json.loads(path.read_text())
    assert written["rows"][0]["name"] == "double, 40x32" and written["facts"] == {"rows": 1.0}
    assert 0 < written["rows"][0]["roofline_fraction"] < 1 and written["settings"]["size"] == [40, 32]
    assert "double, 40x32 (essjax)" in capsys.readouterr().out


def test_a_run_that_breaks_off_leaves_its_rows_and_the_older_result(tmp_path, monkeypatch):
    def rows(options):
        yield {
            "name": "first",
            "implementation": "essjax",
            "median_ms": 1.0,
            "iqr_ms": 0.0,
            "repetitions": 2,
            "work": {},
        }
        raise RuntimeError("second does not compile")

    monkeypatch.setattr(suites, "load", lambda: {"warp": suites.Suite("", rows)})
    monkeypatch.setattr(machine, "roofline", lambda n: {})
    older = tmp_path / f"benchmark-warp-cpu-jax-{jax.__version__}.json"
    older.write_text("older")
    assert command.main(["--suite", "warp", "--out", str(tmp_path)]) == 2
    assert older.read_text() == "older"
    assert json.loads(older.with_suffix(".partial").read_text())["rows"][0]["name"] == "first"


def test_only_the_cases_that_begin_so():
    options = suites.Options(width=32, height=32, repetitions=1, peers=False, only=("bilinear", "fill"))
    assert [row["name"] for row in warp.rows(options)] == ["bilinear, 32x32", "fill holes, 32x32"]


def test_no_case_begins_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(machine, "roofline", lambda n: {})
    assert command.main(["--suite", "warp", "--only", "trilinear", "--out", str(tmp_path)]) == 2
    assert "--only trilinear: no case of the suite warp begins so." in capsys.readouterr().out


def test_calls_are_queued_between_two_looks_at_the_clock():
    calls, waits = [], []
    seconds = time_calls(lambda: calls.append(0), 3, wait=waits.append, queued=4, warm_up=1)
    assert seconds.shape == (3,) and len(calls) == 1 + 3 * 4 and len(waits) == 1 + 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--suite", "warps"], "--suite: expected some of warp, networks, pipeline, ratios, train, scenes, got warps"),
        (["--size", "960"], "--size 960: expected WIDTHxHEIGHT, at least 32x32 pixels"),
        (["--size", "16x16"], "--size 16x16: expected WIDTHxHEIGHT"),
        (["--repetitions", "0"], "expected at least 1 repetition and 2 frames, got 0 and 300"),
        (["--device", "tpu"], "--device: expected cpu or gpu, got 'tpu'"),
        (["--dtypes", "fp8"], "--dtypes: expected some of float32, bfloat16, float16, got fp8"),
    ],
)
def test_bad_arguments_are_one_line(arguments, message, capsys):
    assert command.main(arguments) == 2
    assert message in capsys.readouterr().out.replace("\n", " ")
