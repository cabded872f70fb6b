"""ExtraNet's method: what the network is shown, against warps made by hand; what a step may read; published weights."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.color import demodulate, expm1, log1p, modulate
from essjax.data.importing.images import buffer
from essjax.data.importing.recipe import load_recipe
from essjax.frames import select_time, without_color
from essjax.methods import extranet, extranet_from_torch
from essjax.methods._extranet import relative_depth
from essjax.methods.rendered import albedo
from essjax.rollout import ESS, SS, alternate, check_supported, unroll
from essjax.warp import backward_warp, compose_motion, hole_mask, jittered_motion, occlusion_motion
from tests.helpers import indices_of, make_frames, random_image
from tests.networks.test_extranet import state_dict
from tests.test_tensors import checkpoint

T, B, H, W = 6, 2, 9, 14
METHOD = extranet()
KINDS = alternate(0).kinds(T)  # SS ESS SS ESS SS ESS


def random_frames(seed=0):
    """Surfaces close enough that a part of the history is valid; another jitter every frame."""
    frames = make_frames(seed, T=T, B=B, H=H, W=W)
    sky = ~jnp.isfinite(frames.gbuffers.depth)
    depth = jnp.where(sky, jnp.inf, random_image(seed + 1, T, B, H, W, 1, low=5.0, high=5.3))
    normal = jnp.where(sky, 0.0, jnp.array([0.6, 0.0, 0.8]))
    gbuffers = dataclasses.replace(frames.gbuffers, depth=depth, normal=normal, world_position=None, stencil=None)
    jitter = random_image(seed + 2, T, B, 2, low=-0.5, high=0.5)
    return dataclasses.replace(frames, gbuffers=gbuffers, jitter=jitter, camera=None)


@functools.cache
def variables():
    return extranet_from_torch(state_dict())


@functools.cache
def step(kind):
    return jax.jit(METHOD.render_step if kind == SS else METHOD.extrapolate_step)


def stream(frames, weights=None, kinds=KINDS):
    """Images, and the last prediction's aux; extrapolated steps get frames without colour."""
    history, images, aux = METHOD.start(select_time(frames, 0)), [], {}
    for n, kind in enumerate(kinds):
        frame = select_time(frames, n)
        frame = frame if kind == SS else without_color(frame)
        history, prediction = step(kind)(weights or variables(), history, frame)
        images.append(prediction.image)
        aux = prediction.aux
    return jnp.stack(images), aux


@jax.jit
def shown_by_hand(frames):
    """What frame 5 is shown of frames 4, 2, 0: ``(warps [3, ...], masks [3, ...], occlusion warp)``."""
    last, warps, masks = select_time(frames, 5), [], []
    for source in (4, 2, 0):
        rendered = select_time(frames, source)
        path, inside = jnp.zeros_like(rendered.motion), jnp.ones((B, H, W, 1))
        for n in range(source + 1, 6):
            jitters = {"jitter": frames.jitter[n], "jitter_previous": frames.jitter[n - 1]}
            path, inside = compose_motion(frames.motion[n], path, **jitters, valid_previous=inside)
        lookup = jittered_motion(path, last.jitter, rendered.jitter)
        shading = demodulate(rendered.color, albedo(rendered.gbuffers))
        warps.append(backward_warp(shading, lookup))
        masks.append(
            inside
            * hole_mask(last.gbuffers, rendered.gbuffers, path, jitter=last.jitter, jitter_previous=rendered.jitter)
        )
        if source == 4:
            around = backward_warp(shading, occlusion_motion(lookup, last.gbuffers.depth, masks[0]))
    return jnp.stack(warps), jnp.stack(masks), around


def test_what_the_network_sees():
    frames = random_frames()
    warps, masks, around = shown_by_hand(frames)
    images, aux = stream(frames)
    seen, last = aux["inputs"], select_time(frames, 5)
    np.testing.assert_allclose(seen.history[..., :3], log1p(warps), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(seen.history[..., 3:], masks)
    np.testing.assert_allclose(seen.warped, jnp.concatenate([log1p(warps[0]), log1p(around)], -1), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(seen.mask, masks[0])
    assert (
        0.1 < float(seen.mask.mean()) < 0.9 and float(jnp.abs(seen.warped[..., :3] - seen.warped[..., 3:]).max()) > 0.1
    )
    sky = ~np.isfinite(last.gbuffers.depth)
    np.testing.assert_array_equal(seen.features[..., :3], np.where(sky, -1.0, last.gbuffers.normal))
    np.testing.assert_array_equal(seen.features[..., 4:5], last.gbuffers.roughness)
    np.testing.assert_array_equal(seen.features[..., 5:6], last.gbuffers.metallic)
    np.testing.assert_allclose(images[5], modulate(expm1(aux["log_shading"]), albedo(last.gbuffers)), rtol=1e-5)
    for n in indices_of(KINDS, SS):
        np.testing.assert_array_equal(images[n], frames.color[n])


def test_before_training_it_warps_the_demodulated_frame():
    frames = random_frames(1)
    fresh = METHOD.init(jax.random.key(0), select_time(frames, 0))
    images, _ = stream(frames, fresh)
    expected = modulate(shown_by_hand(frames)[0][0], albedo(select_time(frames, 5).gbuffers))
    np.testing.assert_allclose(images[5], expected, rtol=1e-4, atol=1e-5)


def test_published_weights_see_a_black_sky_and_the_sky_is_warped():
    """On frames whose rendered sky is another colour only the sky changes, and its pixels come from the warp."""
    frames, method = random_frames(7), extranet(published=True)
    sky = ~np.isfinite(frames.gbuffers.depth)
    render = step(SS)
    extrapolate = jax.jit(method.extrapolate_step)

    def last(frames):
        history, prediction = METHOD.start(select_time(frames, 4)), None
        history, _ = render(variables(), history, select_time(frames, 4))
        _, prediction = extrapolate(variables(), history, without_color(select_time(frames, 5)))
        return prediction

    one, other = last(frames), last(dataclasses.replace(frames, color=jnp.where(sky, frames.color + 1.0, frames.color)))
    surface = np.broadcast_to(~sky[5], one.image.shape)
    np.testing.assert_array_equal(np.asarray(one.image)[surface], np.asarray(other.image)[surface])
    assert float(jnp.abs(one.image - other.image).max()) > 0.5
    at, seen = select_time(frames, 5), one.aux["inputs"]
    lookup = jittered_motion(at.motion, at.jitter, frames.jitter[4])
    before = demodulate(frames.color[4], albedo(select_time(frames, 4).gbuffers))
    warped = backward_warp(before, occlusion_motion(lookup, at.gbuffers.depth, seen.mask))
    np.testing.assert_allclose(np.asarray(one.image)[~surface], np.asarray(warped)[~surface], rtol=1e-4, atol=1e-5)
    assert 5 < (~surface).sum() < surface.sum()


def test_published_weights_see_the_normals_of_the_engine():
    """From an Unreal dump through the import preset to the network: the normals are those of the dump."""
    dumped = np.random.default_rng(3).normal(size=(H, W, 3)).astype(np.float32)
    dumped /= np.linalg.norm(dumped, axis=-1, keepdims=True)
    imported, _ = buffer("normal", dumped, np.ones((H, W, 1), bool), load_recipe("extranet"))
    frames = random_frames(8)
    sky = np.asarray(~np.isfinite(frames.gbuffers.depth[5]))
    normal = jnp.where(jnp.isinf(frames.gbuffers.depth), 0.0, imported)
    frames = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, normal=normal))

    def seen(method):
        return (
            jax.jit(method.extrapolate_step)(
                variables(), method.start(select_time(frames, 4)), without_color(select_time(frames, 5))
            )[1]
            .aux["inputs"]
            .features[..., :3]
        )

    expected = np.where(sky, -1.0, dumped)
    np.testing.assert_allclose(seen(extranet(published=True)), expected, atol=1e-6)
    np.testing.assert_allclose(seen(METHOD), np.where(sky, -1.0, dumped * [1, -1, 1]), atol=1e-6)


def test_depth_as_the_published_weights_know_it():
    depth = jnp.array([[[2.0], [jnp.inf], [6.0]], [[4.0], [8.0], [2.0]]])
    buffers = select_time(random_frames().gbuffers, 0)
    with_sky = relative_depth(dataclasses.replace(buffers, depth=depth))
    np.testing.assert_allclose(with_sky[..., 0], [[0.25, 0, 0.75], [0.5, 1, 0.25]], rtol=1e-5)
    inside = relative_depth(dataclasses.replace(buffers, depth=jnp.minimum(depth, 8.0)))
    np.testing.assert_allclose(inside[..., 0], [[0, 1, 2 / 3], [1 / 3, 1, 0]], rtol=1e-5)
    all_sky = relative_depth(dataclasses.replace(buffers, depth=jnp.full((2, 3, 1), jnp.inf)))
    np.testing.assert_array_equal(all_sky, 0.0)


@functools.cache
def rollout():
    return jax.jit(lambda weights, frames: unroll(METHOD, weights, frames, alternate(0)).image)


def test_streaming_equals_the_rollout_and_hidden_colour_is_not_read():
    frames = random_frames(2)
    poisoned = frames.color.at[jnp.array(indices_of(KINDS, ESS))].set(jnp.nan)
    rolled = rollout()(variables(), dataclasses.replace(frames, color=poisoned))
    np.testing.assert_allclose(log1p(rolled), log1p(stream(frames)[0]), rtol=1e-3, atol=1e-3)


def test_batch_elements_are_independent_and_the_future_is_unknown():
    frames, others = random_frames(3), random_frames(4)
    mixed = jax.tree.map(lambda a, b: a.at[:, 1].set(b[:, 1]), frames, others)
    image, other = (rollout()(variables(), f) for f in (frames, mixed))
    np.testing.assert_allclose(log1p(other[:, 0]), log1p(image[:, 0]), rtol=1e-4, atol=1e-4)
    assert float(jnp.abs(other[:, 1] - image[:, 1]).max()) > 0.1
    later = jax.tree.map(lambda a, b: jnp.concatenate([a[:3], b[3:]]), frames, others)
    other = rollout()(variables(), later)
    np.testing.assert_array_equal(other[:3], image[:3])
    assert float(jnp.abs(other[3] - image[3]).max()) > 0.01


def test_history_ends_at_a_cut():
    frames, others = random_frames(5), random_frames(6)
    frames = dataclasses.replace(frames, cut=frames.cut.at[2, 0].set(True))
    changed = jax.tree.map(lambda a, b: jnp.concatenate([b[:2], a[2:]]), frames, others)
    image, other = (rollout()(variables(), f) for f in (frames, dataclasses.replace(changed, cut=frames.cut)))
    np.testing.assert_array_equal(other[2:, 0], image[2:, 0])
    assert float(jnp.abs(other[5, 1] - image[5, 1]).max()) > 1e-3  # no cut there
    # An extrapolated frame right after a cut has nothing to look at: all of it is a hole.
    first = dataclasses.replace(select_time(frames, 3), cut=jnp.array([True, False]))
    history, _ = step(SS)(variables(), METHOD.start(select_time(frames, 2)), select_time(frames, 2))
    _, prediction = step(ESS)(variables(), history, without_color(first))
    seen = prediction.aux["inputs"]
    assert float(jnp.abs(seen.history[:, 0]).max()) == 0.0 and float(seen.mask[1].max()) == 1.0
    assert bool(jnp.all(jnp.isfinite(prediction.image)))


@pytest.mark.parametrize("options", [{}, {"history": False}, {"occlusion": False}], ids=["full", "no HE", "no OMV"])
def test_shapes_and_training_state(options):
    method, frames = extranet(**options), random_frames()
    bare = without_color(select_time(frames, 0))
    weights = jax.eval_shape(method.init, jax.random.key(0), bare)
    train = functools.partial(method.extrapolate_step, train=True)
    history, prediction = jax.eval_shape(train, weights, method.start(bare), bare)
    assert prediction.image.shape == (B, H, W, 3)
    assert jax.tree.map(jnp.shape, prediction.state["extranet"]["batch_stats"]) == jax.tree.map(
        jnp.shape, weights["extranet"]["batch_stats"]
    )
    same = jax.tree.map(lambda a, b: a.shape == b.shape and a.dtype == b.dtype, history, method.start(bare))
    assert all(jax.tree.leaves(same))  # a history keeps its shapes, so that steps can be scanned
    _, prediction = jax.eval_shape(method.extrapolate_step, weights, method.start(bare), bare)
    assert prediction.state == {}
    lacking = dataclasses.replace(frames, gbuffers=dataclasses.replace(frames.gbuffers, roughness=None))
    with pytest.raises(ValueError, match="extranet needs the buffers roughness"):
        check_supported(method, lacking, (SS, ESS))


def test_published_checkpoint_is_read_without_pytorch(tmp_path):
    path = checkpoint(tmp_path / "model.pth.tar", state_dict())
    for ours, theirs in zip(*map(jax.tree.leaves, (extranet_from_torch(path), variables())), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="ExtraNet weights: expected a file that ends in"):
        extranet_from_torch(tmp_path / "missing.pth.tar")
