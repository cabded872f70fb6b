"""The optimiser's state, the learning rate, and checkpoints that come back whole or say why not."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from essjax.train import (
    Checkpoints,
    Recurrent,
    adam,
    averaged,
    constant,
    cosine,
    create_state,
    halving,
    learning_rate,
    make_train_step,
    muon,
)
from tests.train import tiny_run


def state_of(width):
    variables = {"net": {"kernel": jnp.arange(2.0 * width).reshape(2, width)}, "other": {"b": jnp.ones(3)}}
    return create_state(variables, "net", adam())


def test_unknown_entry():
    with pytest.raises(ValueError, match="trained: expected one of fit, frozen, got 'frnet'"):
        create_state({"fit": {}, "frozen": {}}, "frnet", adam())


def test_learning_rate():
    decay = functools.partial(cosine, floor=0.05)
    rate = lambda step, progress: learning_rate(step, progress, peak=2.0, decay=decay, warmup_steps=10)
    np.testing.assert_allclose([rate(0, 0.0), rate(4, 0.0), rate(9, 0.0), rate(99, 0.0)], [0.2, 1.0, 2.0, 2.0])
    np.testing.assert_allclose(rate(99, 0.5), 2.0 * (0.05 + 0.95 * 0.5), rtol=1e-6)
    np.testing.assert_allclose(rate(4, 0.5), 0.5 * rate(99, 0.5), rtol=1e-6)  # a warm-up on a clock that runs
    np.testing.assert_allclose([rate(99, 1.0), rate(99, 1.5)], 0.1, rtol=1e-6)
    falling = [rate(99, progress) for progress in np.linspace(0.0, 1.0, 20)]
    assert all(a > b for a, b in zip(falling, falling[1:], strict=False))


def test_decays():
    late = [cosine(progress, start=0.2, floor=0.0) for progress in (0.0, 0.2, 0.6, 1.0)]
    np.testing.assert_allclose(late, [1.0, 1.0, 0.5, 0.0], atol=1e-12)
    assert [halving(progress, times=5) for progress in (0.0, 0.19, 0.21, 0.99, 1.0)] == [1.0, 1.0, 0.5, 0.0625, 0.0625]
    assert constant(0.7) == 1.0


def test_statistics_are_folded_in_and_have_no_gradient():
    """The trained entry's new statistics arrive as returned; a frozen entry's do not."""
    variables = {name: {"params": {"w": jnp.ones(2)}, "batch_stats": {"mean": jnp.full(2, 3.0)}} for name in "ab"}

    def objective(variables, clip):
        state = {name: {"batch_stats": {"mean": variables[name]["batch_stats"]["mean"] + 1.0}} for name in "ab"}
        return {"sum": jnp.sum(variables["a"]["params"]["w"] * variables["a"]["batch_stats"]["mean"])}, state

    transform = adam()
    step = make_train_step(objective, transform, "a")
    state, terms = step(create_state(variables, "a", transform), next(tiny_run.tiny_batches()), 0.1)
    np.testing.assert_allclose(terms["gradient_norm"], 3.0 * np.sqrt(2.0), rtol=1e-6)
    np.testing.assert_array_equal(state.variables["a"]["batch_stats"]["mean"], 4.0)
    np.testing.assert_array_equal(state.variables["b"]["batch_stats"]["mean"], 3.0)
    assert np.all(np.asarray(state.variables["a"]["params"]["w"]) < 1.0)
    assert {leaf.size for leaf in jax.tree.leaves(state.optimizer)} == {1, 2}  # step count; moments of w alone


def test_the_moments_of_all_arrays_are_one_vector_each():
    """Hundreds of tiny loops take as long to compile as a network."""
    weights = {name: {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3)} for name in ("first", "second")}
    assert sorted(leaf.shape for leaf in jax.tree.leaves(adam().init(weights))) == [(), (18,), (18,)]


def test_muon_moves_kernels_by_orthogonal_matrices_and_all_else_as_adam():
    """NumPy's singular values: of a first step are alike, whatever the gradient's."""
    random = np.random.default_rng(0)
    weights = {"kernel": jnp.zeros((3, 3, 5, 7)), "bias": jnp.zeros(7)}
    gradient = {
        "kernel": jnp.asarray(random.normal(size=(3, 3, 5, 7)) * 0.01),
        "bias": jnp.asarray(random.normal(size=7)),
    }
    updates, plain = (t.update(gradient, t.init(weights), weights)[0] for t in (muon(), adam()))
    values = np.linalg.svd(np.asarray(updates["kernel"]).reshape(45, 7), compute_uv=False) / (0.2 * np.sqrt(45))
    assert values.min() > 0.6 and values.max() < 1.3
    assert np.sum(updates["kernel"] * gradient["kernel"]) > 0  # along the gradient: the step goes against it
    np.testing.assert_allclose(updates["bias"], plain["bias"], rtol=1e-6)


def test_one_step_equals_adam_by_hand():
    """NumPy's Adam behind a clip of the norm; the frozen entry stays as it was, to the last bit."""
    clip = jax.tree.map(jnp.asarray, next(tiny_run.tiny_batches()))
    state, terms = tiny_run.tiny_step()(tiny_run.initial_state(), clip, 0.25)
    color = np.mean(clip.frames.color, axis=(0, 1, 2, 3))
    reference = np.mean(clip.reference, axis=(0, 1, 2, 3))
    gradient = -2.0 * color - 0.2 * reference
    norm = np.linalg.norm(gradient)
    assert norm > 1.0  # so that the clip acts
    np.testing.assert_allclose(terms["gradient_norm"], norm, rtol=1e-5)
    np.testing.assert_allclose(terms["near"], np.sum(color**2), rtol=1e-5)
    np.testing.assert_allclose(terms["loss"], terms["near"] + terms["far"], rtol=1e-6)
    clipped = gradient / norm
    expected = -0.25 * clipped / (np.abs(clipped) + 1e-8)  # bias-corrected first step of Adam
    np.testing.assert_allclose(state.variables["fit"]["w"], expected, rtol=1e-4)
    np.testing.assert_array_equal(state.variables["frozen"]["b"], 1.0)
    assert int(state.step) == 1


def test_the_average_forgets_the_start():
    """NumPy's recursion: over a tenth of the steps at first, over 1 / (1 - decay) of them later."""
    state, clip = tiny_run.initial_state(), next(tiny_run.tiny_batches())
    mean = np.zeros(3)
    for n in range(12):
        state, _ = tiny_run.tiny_step()(state, clip, 0.1)
        decay = min(0.5, (1 + n) / (10 + n))
        mean = decay * mean + (1 - decay) * np.asarray(state.variables["fit"]["w"])
        np.testing.assert_allclose(state.average, mean, rtol=1e-5)
    variables = averaged(state, "fit")
    np.testing.assert_allclose(variables["fit"]["w"], mean, rtol=1e-5)
    assert variables["frozen"] is state.variables["frozen"]
    plain = tiny_run.initial_state(average=False)
    assert plain.average is None and averaged(plain, "fit") is plain.variables
    plain, _ = tiny_run.tiny_step()(plain, clip, 0.1)
    assert plain.average is None


def test_statistics_are_not_averaged():
    entry = {"params": {"w": jnp.ones((2, 1)), "b": jnp.zeros(3)}, "batch_stats": {"mean": jnp.full(2, 3.0)}}
    state = create_state({"net": entry}, "net", adam(), average=True)
    assert state.average.shape == (5,)
    jax.tree.map(np.testing.assert_array_equal, averaged(state, "net"), {"net": entry})


def test_non_finite_step_changes_nothing_but_the_count():
    clip = jax.tree.map(jnp.asarray, next(tiny_run.tiny_batches()))
    state, _ = tiny_run.tiny_step()(tiny_run.initial_state(), clip, 0.1)
    before = jax.tree.map(np.array, state)
    bad = jax.tree.map(lambda leaf: leaf * jnp.nan if leaf.dtype == jnp.float32 else leaf, clip)
    after, terms = tiny_run.tiny_step()(state, bad, 0.1)
    assert not np.isfinite(terms["loss"])
    jax.tree.map(
        np.testing.assert_array_equal, (after.variables, after.optimizer), (before.variables, before.optimizer)
    )
    assert int(after.step) == 2


def test_a_recurrent_objective_carries_its_history_in_the_state(tmp_path):
    """Its history is the sum of the clips' first colours: carried on, kept by checkpoints, not spoilt by a bad clip."""

    def follow(variables, clip, history):
        terms, state = tiny_run.objective(variables, clip)
        return terms, state, history + clip.frames.color[0]

    objective = Recurrent(lambda clip: jnp.zeros_like(clip.frames.color[0]), follow)
    batches = tiny_run.tiny_batches()
    clips = [jax.tree.map(jnp.asarray, next(batches)) for _ in range(2)]
    state, step = tiny_run.initial_state(), make_train_step(objective, adam(), "fit")
    variables = {name: state.variables[name] for name in ("fit", "frozen")}
    state = create_state(variables, "fit", adam(), history={"": objective.start(clips[0])})
    for clip in clips:
        state, _ = step(state, clip, 0.1)
    expected = np.asarray(clips[0].frames.color[0] + clips[1].frames.color[0])
    np.testing.assert_allclose(state.history[""], expected, rtol=1e-6)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(2, state, {"seconds": 1.0})
    np.testing.assert_array_equal(checkpoints.restore(state)[0].history[""], state.history[""])
    checkpoints.close()
    bad = jax.tree.map(lambda leaf: leaf * jnp.nan if leaf.dtype == jnp.float32 else leaf, clips[0])
    np.testing.assert_allclose(step(state, bad, 0.1)[0].history[""], expected, rtol=1e-6)
    np.testing.assert_allclose(
        objective(variables, clips[0])[0]["near"], tiny_run.objective(variables, clips[0])[0]["near"]
    )


def test_the_callers_variables_survive_donation():
    variables = {"fit": {"w": jnp.zeros(3)}, "frozen": {"b": jnp.ones(())}}
    clip = next(tiny_run.tiny_batches())
    tiny_run.tiny_step()(create_state(variables, "fit", adam()), clip, 0.1)
    np.testing.assert_array_equal(variables["fit"]["w"], 0.0)
    np.testing.assert_array_equal(variables["frozen"]["b"], 1.0)


def test_step_refuses_gradients_of_other_trees():
    step = make_train_step(tiny_run.objective, optax.identity(), "absent")
    with pytest.raises(KeyError, match="absent"):
        step(tiny_run.initial_state(), next(tiny_run.tiny_batches()), 0.1)


def test_round_trip_and_retention(tmp_path):
    checkpoints = Checkpoints(tmp_path / "a" / "b")  # made with its parents
    assert checkpoints.latest() is None
    state = state_of(3)
    for step in (1, 2, 5):
        scaled = jax.tree.map(lambda leaf, s=step: leaf * s, state)
        checkpoints.save(step, scaled, {"seconds": step / 2, "batches": {"next": step}})
    checkpoints.save(5, state, {"seconds": 99.0})  # exists: nothing happens
    checkpoints.close()
    again = Checkpoints(tmp_path / "a" / "b")
    assert again.latest() == 5
    restored, progress = again.restore(state)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, 5 * b), restored, state)
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    assert progress == {"seconds": 2.5, "batches": {"next": 5}}
    again.close()
    assert sorted(path.name for path in (tmp_path / "a" / "b").glob("[0-9]*")) == ["2", "5"]


def test_a_restored_state_is_another_program_to_nobody(tmp_path):
    """Arrays that are committed to a device lower to another program: a resumed run would compile its step again."""
    fresh, clip = tiny_run.initial_state(), next(tiny_run.tiny_batches())
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(0, fresh, {})
    restored, _ = checkpoints.restore(fresh)
    checkpoints.close()
    assert not any(leaf.committed for leaf in jax.tree.leaves(restored))
    texts = {tiny_run.tiny_step().lower(state, clip, 0.1).as_text() for state in (fresh, restored)}
    assert len(texts) == 1


def test_no_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    message = f"{tmp_path}: expected a checkpoint, found none. Train first, or check --out."
    with pytest.raises(ValueError, match=re.escape(message)):
        checkpoints.restore(state_of(3))
    checkpoints.close()


def test_other_shapes_and_other_trees(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(7, state_of(3), {"seconds": 1.0})
    other = create_state({"net": {"weights": jnp.zeros(3)}}, "net", adam())
    kernel = ".variables['net']['kernel']"
    found = {f"{kernel} is float32[2, 3] there, float32[2, 4] here, and 2 more": state_of(4)}
    found[".variables['net']['weights'] is absent there, float32[3] here, and 4 more"] = other
    for reason, wrong in found.items():
        message = (
            f"{tmp_path}: checkpoint 7 does not fit this configuration ({reason}). "
            "Use the settings that it was trained with, or another --out."
        )
        with pytest.raises(ValueError, match=re.escape(message)):
            checkpoints.restore(wrong)
    checkpoints.close()


def test_a_save_that_was_killed_is_cleared_away(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(3, state_of(3), {"seconds": 1.0})
    checkpoints.close()
    torn = tmp_path / "4.unfinished"
    (torn / "state").mkdir(parents=True)
    (torn / "state" / "half").write_text("written")
    again = Checkpoints(tmp_path)
    assert again.latest() == 3
    again.save(4, state_of(3), {"seconds": 2.0})
    assert again.latest() == 4 and not torn.exists()
    again.close()
