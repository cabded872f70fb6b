import dataclasses

import jax
import numpy as np
import pytest

from essjax import frames, scenes, warp
from essjax.color import reinhard
from essjax.scenes import Rendering, render

SIZE = (36, 20)


def leaves_equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("family", scenes.FAMILIES + scenes.EXTRA_FAMILIES)
def test_scenes_are_deterministic_and_differ_by_seed(family):
    scene = scenes.make_scene(family, 5, 6)
    leaves_equal(scene.worlds, scenes.make_scene(family, 5, 6).worlds)
    for seed in (2, 5, 8):  # a prefix of the longer animation
        long = scenes.make_scene(family, seed, 40)
        for length in (3, 12, 19):
            leaves_equal(scenes.make_scene(family, seed, length).at(2), long.at(2))
    assert not np.array_equal(scene.worlds.to_local, scenes.make_scene(family, 6, 6).worlds.to_local)
    assert scene.cut[0]


def test_splits_are_disjoint_and_some_families_are_for_tests_only():
    seeds = {split: set(scenes.split_seeds(split, 50, start=7)) for split in scenes.SPLITS}
    assert all(len(s) == 50 for s in seeds.values()) and len(set.union(*seeds.values())) == 150
    assert scenes.split_seeds("train", 2, start=3) == scenes.split_seeds("train", 5)[3:]
    assert len(scenes.TEST_ONLY_FAMILIES) == 2 and len(scenes.TRAIN_FAMILIES) >= 6
    assert set(scenes.families_of("test")) == set(scenes.FAMILIES)
    for split in ("train", "validation"):
        assert not set(scenes.families_of(split)) & set(scenes.TEST_ONLY_FAMILIES)
    assert not any(set(scenes.families_of(split)) & set(scenes.EXTRA_FAMILIES) for split in scenes.SPLITS)


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="expected one of corridor, .*, got 'forest'"):
        scenes.make_scene("forest", 0, 4)
    with pytest.raises(ValueError, match="frames >= 1, got seed 0 and 0 frames"):
        scenes.make_scene("gloss", 0, 0)
    with pytest.raises(ValueError, match="expected one of train, validation, test, got 'dev'"):
        scenes.split_seeds("dev", 1)
    scene = scenes.make_scene("gloss", 0, 2)
    with pytest.raises(ValueError, match="0 <= frame < 2, got 2. Make a longer scene"):
        scenes.render_frame(scene, 2, *SIZE)
    with pytest.raises(ValueError, match="width: expected a whole number >= 1, got 0"):
        scenes.render_frame(scene, 0, 0, 20)


def test_sequence_is_valid_with_native_frames_and_resumes():
    scene, done = scenes.make_scene("carousel", 3, 3), []
    sequence = scenes.render_sequence(scene, *SIZE, on_frame=done.append, rendering=Rendering(spp=4, native=True))
    assert done == [0, 1, 2] and sequence.scale == 2
    frames.validate_sequence(sequence, requires=frames.OPTIONAL_GBUFFERS)
    assert sequence.frames.color.shape == (3, 20, 36, 3) and sequence.frames.color.dtype == np.float32
    assert sequence.native.color.shape == (3, 40, 72, 3) and sequence.frames.gbuffers.stencil.dtype == np.int32
    assert sequence.frames.gbuffers.stencil.max() > 3
    np.testing.assert_array_equal(sequence.native.jitter, scenes.jitter_sequence(3))
    np.testing.assert_array_equal(sequence.frames.jitter, scenes.jitter_sequence(3))
    assert list(sequence.frames.cut) == [True, False, False]
    resumed = list(scenes.iterate_frames(scene, *SIZE, start=2, rendering=Rendering(spp=4, native=True)))
    assert [n for n, _ in resumed] == [2]
    leaves_equal(resumed[0][1], frames.select_time(sequence, 2))
    other = scenes.render_frame(scene, 2, *SIZE, rendering=Rendering(spp=4, native=True, jitter="dlctus"))
    np.testing.assert_array_equal(other.frames.jitter, scenes.jitter_sequence(3, pattern="dlctus")[2])
    np.testing.assert_array_equal(other.native.jitter, sequence.native.jitter[2])


def test_nothing_recompiles_for_another_frame_size_or_family():
    scenes.render_frame(scenes.make_scene("carousel", 3, 3), 1, *SIZE, rendering=Rendering(spp=4))
    sizes = render.color_along._cache_size(), render.buffers._cache_size()
    scenes.render_frame(scenes.make_scene("gloss", 1, 4), 2, 41, 23, rendering=Rendering(spp=9))
    assert (render.color_along._cache_size(), render.buffers._cache_size()) == sizes


def test_a_cut_ends_history():
    scene = scenes.make_scene("cuts", 0, 40)
    (cuts,) = np.nonzero(scene.cut)
    assert len(cuts) >= 3 and cuts[0] == 0 and 3 <= cuts[1] <= 5
    at_cut = scenes.render_frame(scene, int(cuts[1]), *SIZE, rendering=Rendering(spp=1))
    after = scenes.render_frame(scene, int(cuts[1]) + 1, *SIZE, rendering=Rendering(spp=1))
    assert at_cut.frames.cut and not after.frames.cut
    assert not at_cut.valid.any() and after.valid.mean() > 0.7
    np.testing.assert_allclose(at_cut.frames.motion, 0.0, atol=1e-2)


def test_short_clips_have_a_cut():
    for seed in range(20):  # of the length of training clips in the preset quick
        assert scenes.make_scene("cuts", seed, 10).cut[1:].any()


def test_there_is_hdr_sky_and_glowing_matter():
    s = scenes.render_frame(scenes.make_scene("plaza", 2, 2), 1, 96, 54, rendering=Rendering(spp=4))
    assert s.reference.max() > 8
    sky = ~np.isfinite(s.frames.gbuffers.depth)
    assert 0.05 < sky.mean() < 0.8


def test_rigging_is_thinner_than_a_pixel_before_a_plain_sky():
    """High above the hull, at 96 x 54: rope in pixels whose sample is sky, and sky in pixels whose sample is rope."""
    s = scenes.render_frame(scenes.make_scene("rigging", 2, 3), 2, 96, 54, rendering=Rendering(spp=16))
    sky = ~np.isfinite(s.frames.gbuffers.depth[..., 0])
    assert 0.3 < sky.mean() < 0.6
    above, sky = np.asarray(reinhard(s.reference)).reshape(54, 2, 96, 2, 3).mean((1, 3))[:12], sky[:12]
    rope = np.abs(above - np.median(above, axis=(0, 1))).max(axis=-1)  # 0 where a pixel shows sky alone
    assert (rope[sky] > 0.05).mean() > 0.05
    assert (rope[~sky] < 0.2).mean() > 0.2
    assert s.frames.gbuffers.stencil.max() == 1  # one rigid ship


def test_mip_bias_blurs_frames_but_not_the_reference():
    scene = scenes.make_scene("texture", 4, 2)
    sharp = scenes.render_frame(scene, 1, *SIZE, rendering=Rendering(spp=4))
    soft = scenes.render_frame(scene, 1, *SIZE, rendering=Rendering(spp=4, mip_bias=4.0))
    detail = lambda s: np.abs(np.diff(s.frames.gbuffers.base_color, axis=1)).mean()
    assert detail(soft) < 0.7 * detail(sharp)
    np.testing.assert_array_equal(sharp.reference, soft.reference)
    np.testing.assert_array_equal(sharp.frames.motion, soft.frames.motion)


def test_scenes_have_units_of_their_own_and_record_the_exposure():
    units = {name: {scenes.make_scene(name, seed, 1).unit for seed in range(12)} for name in ("gloss", "plaza")}
    everywhere = set.union(*units.values())
    assert all(len(found) > 3 for found in units.values()) and max(everywhere) >= 256 * min(everywhere)
    assert all(np.log2(unit) % 1 == 0 and 2.0**-7 <= unit < 2.0**7 for unit in everywhere)
    scene = next(s for s in (scenes.make_scene("gloss", seed, 2) for seed in range(20)) if s.unit != 1)
    plain = dataclasses.replace(scene, unit=1.0)
    rendering = Rendering(spp=4, native=True, ranges=True)
    ours, same = (scenes.render_frame(s, 1, *SIZE, rendering=rendering) for s in (scene, plain))
    assert float(same.frames.exposure) == 1.0 and float(ours.frames.exposure) == 1.0 / scene.unit
    for of in (lambda s: s.frames.color, lambda s: s.reference, lambda s: s.native.color,
               lambda s: s.ranges.color_min, lambda s: s.ranges.color_max):  # fmt: skip
        np.testing.assert_array_equal(of(ours) * ours.frames.exposure, of(same))
    for of in (lambda s: s.frames.gbuffers, lambda s: s.frames.motion, lambda s: s.ranges.normal_spread):
        leaves_equal(of(ours), of(same))
    np.testing.assert_array_equal(ours.native.exposure, ours.frames.exposure)


def test_reference_converges():
    """The mean of many randomly placed single samples is what the reference approaches."""
    world = scenes.make_scene("shadows", 2, 1).at(0)
    rng, angle = np.random.default_rng(0), render.pixel_angle(world, SIZE[0])
    count = SIZE[0] * SIZE[1]
    group = render.chunk_size() // count  # samples per call, so that nothing recompiles
    total = np.zeros((count, 3))
    calls = 176 // group
    for _ in range(calls):
        places = [render.screen_grid(*SIZE, rng.uniform(-0.5, 0.5, 2)) for _ in range(group)]
        x, y = (np.pad(np.concatenate(c), (0, render.chunk_size() - group * count)) for c in zip(*places, strict=True))
        color = np.asarray(render.color_along(world, x, y, angle))
        total += color[: group * count].reshape(group, count, 3).mean(axis=0) / calls
    error = {}
    for spp in (1, 64):
        image = np.asarray(reinhard(render.render_reference(world, *SIZE, spp=spp))).reshape(count, 3)
        error[spp] = np.sqrt(np.mean((image - np.asarray(reinhard(total))) ** 2))
    assert error[64] < 0.02 and error[64] < 0.3 * error[1]


def test_statistics_bound_the_reference_and_bumps_add_spread():
    scene = scenes.make_scene("texture", 1, 2)
    frame = scenes.render_frame(scene, 1, *SIZE, rendering=Rendering(scale=1, spp=16, ranges=True))
    stats, reference = frame.ranges, scene.unit * render.render_reference(scene.at(1), *SIZE, spp=16)
    np.testing.assert_allclose(frame.reference, reference, rtol=1e-5)  # two programs
    frames.validate_ranges(stats, 20, 36)
    assert (stats.color_min <= reference + 1e-4).all() and (reference <= stats.color_max + 1e-4).all()
    assert stats.normal_spread.shape == (20, 36, 1)
    flat = stats.normal_spread_smooth == 0
    assert flat.mean() > 0.2 and stats.normal_spread[flat].mean() > 0.01
    edge = (stats.depth_max - stats.depth_min) / stats.depth_max > 0.2
    assert edge.any() and stats.normal_spread_smooth[edge].mean() > stats.normal_spread_smooth.mean()


def test_motion_of_the_nearest_sample():
    """Inside surfaces that of the frame's one sample; at silhouettes it belongs to the foreground."""
    scene = scenes.make_scene("carousel", 3, 4)
    frame = scenes.render_frame(scene, 3, *SIZE, rendering=Rendering(scale=1, spp=16, ranges=True))
    stats = frame.ranges
    smooth = np.isfinite(stats.depth_max) & (stats.depth_max < 1.02 * stats.depth_min)
    difference = np.linalg.norm(stats.motion - frame.frames.motion, axis=-1, keepdims=True)
    assert np.median(np.linalg.norm(frame.frames.motion, axis=-1)) > 0.3 and smooth.mean() > 0.4
    assert np.median(difference[smooth]) < 0.02 and np.quantile(difference[smooth], 0.95) < 0.2
    # A sample that lies behind the nearest by far sees another surface, with a motion of its own.
    behind = frame.frames.gbuffers.depth > 1.2 * stats.depth_min
    assert behind.sum() > 5 and np.median(difference[behind]) > 0.1


def gain(family, seed, index, width=240, height=135, spp=9):
    """PSNR (after x / (1 + x)) of the reference warped from the frame before, over that of not moving it, decibels."""
    scene = scenes.make_scene(family, seed, index + 1)
    before = render.render_reference(scene.at(index - 1), width, height, spp=spp)
    now = scenes.render_frame(scene, index, width, height, rendering=Rendering(scale=1, spp=spp))
    mask = now.valid * now.steady
    warped = np.asarray(warp.backward_warp(before, now.frames.motion))
    target = np.asarray(reinhard(now.reference * now.frames.exposure))
    error = lambda image: (((np.asarray(reinhard(image)) - target) ** 2).mean(-1, keepdims=True) * mask).sum()
    motion = np.linalg.norm(now.frames.motion, axis=-1)[mask[..., 0] == 1]
    return 10 * np.log10(error(before) / error(warped)), np.median(motion), mask.mean()


MOVING = {
    "corridor": (0, 4), "carousel": (0, 4), "grille": (5, 4), "gloss": (5, 4), "shadows": (0, 4), "texture": (1, 4),
    "cuts": (1, 4), "plaza": (2, 4, 288, 162, 16), "rigging": (2, 4, 288, 162, 16),  # slow, and thin
}  # fmt: skip


@pytest.mark.parametrize("family", scenes.FAMILIES + scenes.EXTRA_FAMILIES)
def test_exact_motion_beats_no_motion(family):
    decibels, motion, share = gain(family, *MOVING[family])
    assert motion > 2.0
    assert share > 0.4
    # A pixel that samples the sky beside a rope, or a rope before the sky, has one motion for both.
    assert decibels > (3.0 if family == "rigging" else 6.0)
