"""Reading traces, against one written by hand and one of JAX's."""

import gzip
import json

import jax
import jax.numpy as jnp
import pytest

from experiments.trace import describe, device_milliseconds, operations


def _write(folder, events):
    folder.mkdir(exist_ok=True)
    with gzip.open(folder / "host.trace.json.gz", "wt") as file:
        json.dump({"traceEvents": events}, file)


def _event(module, name, microseconds):
    return {"ph": "X", "dur": microseconds, "args": {"hlo_module": module, "hlo_op": name}}


def test_sums_by_operation(tmp_path):
    other = {"ph": "M", "args": {"name": "thread"}}
    _write(tmp_path, [_event("jit_a", "add", 1500), _event("jit_a", "add", 500), _event("jit_b", "dot", 6000), other])
    dot, add = operations(tmp_path)
    assert (add.program, add.name, add.milliseconds, add.count) == ("jit_a", "add", 2.0, 2) and dot.milliseconds == 6.0
    assert describe([dot, add])[0] == "jit_b: 6.0 ms in 1 operations" and "100%  x2    add" in describe([dot, add])[3]


def test_a_trace_of_jax(tmp_path):
    function = jax.jit(lambda x: jnp.sort(x @ x))
    x = jnp.ones((200, 200))
    function(x).block_until_ready()
    with jax.profiler.trace(str(tmp_path)):
        function(x).block_until_ready()
    assert any("sort" in operation.name and operation.milliseconds > 0 for operation in operations(tmp_path))


def test_the_time_that_a_gpu_is_busy(tmp_path):
    """Streams side by side count once, the host's threads and another device not at all."""
    named = [(1, 0, "/device:GPU:0"), (2, 0, "/host:CPU")]
    threads = [(1, 5, "Stream #5(Compute)"), (1, 6, "Stream #6(Memcpy)"), (1, 7, "Steps"), (2, 5, "Stream #5")]
    events = [{"ph": "M", "name": "process_name", "pid": p, "args": {"name": name}} for p, _, name in named]
    events += [{"ph": "M", "name": "thread_name", "pid": p, "tid": t, "args": {"name": n}} for p, t, n in threads]
    spans = [(1, 5, 0, 1000), (1, 6, 500, 1000), (1, 5, 3000, 500), (1, 7, 0, 9000), (2, 5, 0, 9000)]
    events += [{"ph": "X", "pid": p, "tid": t, "ts": ts, "dur": dur} for p, t, ts, dur in spans]
    _write(tmp_path, events)
    assert device_milliseconds(tmp_path) == pytest.approx(2.0)
    _write(tmp_path, events[:-5])
    with pytest.raises(ValueError, match="expected work on a stream of a GPU, found none"):
        device_milliseconds(tmp_path)


def test_no_trace_and_an_empty_one(tmp_path):
    with pytest.raises(ValueError, match=r"expected a \*.trace.json.gz that jax.profiler wrote, found none"):
        operations(tmp_path)
    _write(tmp_path, [])
    with pytest.raises(ValueError, match="expected operations of a jitted program, found none"):
        operations(tmp_path)
