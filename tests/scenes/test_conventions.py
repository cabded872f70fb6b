"""Asymmetric checks of every sign, unit and offset against numbers worked out by hand."""

import numpy as np
import pytest

from essjax import cameras, scenes
from essjax.scenes import presets, render, sequence
from essjax.scenes.builder import look_at

FOCAL = 0.9  # of the builder fixture
W, H = 31, 17


def frame_of(scene, index, **settings):
    return scenes.render_frame(scene, index, W, H, rendering=scenes.Rendering(spp=1, **settings))


def test_object_moving_right_has_negative_motion(moving_box):
    s = frame_of(moving_box, 3)
    on_box = (s.frames.gbuffers.stencil == 1)[..., 0]
    front = on_box & (np.abs(s.frames.gbuffers.normal[..., 2] - 1) < 0.05)
    assert front.sum() > 20
    expected = -0.3 * FOCAL * W / 5.0  # the front face lies at 5 m; previous = current + motion
    np.testing.assert_allclose(s.frames.motion[front, 0], expected, rtol=1e-3)
    np.testing.assert_allclose(s.frames.motion[front, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(s.frames.motion[~on_box], 0.0, atol=1e-3)


def test_camera_turning_right_moves_the_sky_left(builder):
    angle = 0.05 * np.arange(builder.frames)
    target = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    builder.set_camera((0, 0, 0), target, focal=FOCAL)
    s = frame_of(builder.build("turning", 0), 1)
    assert not np.isfinite(s.frames.gbuffers.depth).any()
    # Frame 1 has jitter (0, -1/6): the middle column looks along the axis, its row almost.
    np.testing.assert_allclose(s.frames.motion[H // 2, W // 2, 0], FOCAL * W * np.tan(0.05), rtol=1e-3)
    assert (s.frames.motion[..., 0] > 0).all()
    assert s.valid[H // 2, W // 2] == 1 and s.valid[H // 2, W - 1] == 0  # was off screen, right


def test_camera_rising_has_negative_vertical_motion(builder):
    steps = 0.1 * np.arange(builder.frames)
    eye = np.stack([0 * steps, steps, 0 * steps], axis=-1)
    builder.set_camera(eye, eye + [0, 0, -1], focal=FOCAL)
    builder.rect(presets.plaster((0.5, 0.5, 0.5)), (0, 0, -4), 30, 30)
    s = frame_of(builder.build("rising", 0), 2)
    np.testing.assert_allclose(s.frames.motion[..., 1], -0.1 * FOCAL * W / 4.0, rtol=1e-3)
    np.testing.assert_allclose(s.frames.motion[..., 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(s.frames.gbuffers.depth, 4.0, rtol=1e-4)  # view-space z, not distance


@pytest.mark.parametrize("family", ["corridor", "carousel", "cuts"])
def test_world_position_projects_to_the_sample(family):
    s = frame_of(scenes.make_scene(family, 7, 5), 4)
    buffers, camera = s.frames.gbuffers, s.frames.camera
    positions, depth = cameras.project(camera, buffers.world_position)
    hit = np.isfinite(buffers.depth[..., 0])
    expected = cameras.pixel_positions(H, W, s.frames.jitter)
    assert hit.mean() > 0.3 and np.abs(s.frames.jitter).max() > 0.05
    np.testing.assert_allclose(np.asarray(positions)[hit], np.asarray(expected)[hit], atol=5e-3)
    np.testing.assert_allclose(np.asarray(depth)[hit], buffers.depth[hit], rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(buffers.normal[hit], axis=-1), 1.0, atol=1e-4)
    to_eye = camera.camera_to_world[:3, 3] - buffers.world_position
    to_eye = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    cosine = (to_eye * buffers.normal).sum(-1)
    np.testing.assert_allclose(np.clip(cosine, 0, 1)[hit], buffers.n_dot_v[hit, 0], atol=1e-4)
    assert (buffers.normal[~hit] == 0).all() and (buffers.base_color[~hit] == 0).all()


@pytest.mark.parametrize("family", ["corridor", "texture"])
def test_motion_of_static_surfaces_follows_from_the_cameras(family):
    scene = scenes.make_scene(family, 2, 6)
    s, before = frame_of(scene, 5), frame_of(scene, 4)
    static = ((s.frames.gbuffers.stencil == 0) & np.isfinite(s.frames.gbuffers.depth))[..., 0]
    positions = cameras.pixel_positions(H, W, s.frames.jitter)
    expected = cameras.static_motion(s.frames.camera, before.frames.camera, positions, s.frames.gbuffers.depth)
    on_screen = static & (np.abs(np.asarray(expected)).max(-1) < 100)  # else behind the camera
    np.testing.assert_allclose(s.frames.motion[on_screen], np.asarray(expected)[on_screen], atol=2e-2)
    assert np.abs(s.frames.motion[on_screen]).max() > 0.3


def test_sky_motion_follows_from_the_cameras():
    scene = scenes.make_scene("plaza", 1, 4)
    s, before = frame_of(scene, 3), frame_of(scene, 2)
    sky = ~np.isfinite(s.frames.gbuffers.depth[..., 0])
    positions = cameras.pixel_positions(H, W, s.frames.jitter)
    expected = np.asarray(cameras.sky_motion(s.frames.camera, before.frames.camera, positions))
    assert sky.sum() > 20
    np.testing.assert_allclose(s.frames.motion[sky], expected[sky], atol=5e-3)


@pytest.fixture
def without_jitter(monkeypatch):
    monkeypatch.setattr(sequence, "jitter_sequence", lambda length, **_: np.zeros((length, 2), np.float32))


@pytest.mark.usefixtures("without_jitter")
def test_valid_is_what_the_previous_frame_showed(moving_box):
    # The camera stands still: wall pixels are valid where frame 2 showed the wall.
    before, now = frame_of(moving_box, 2), frame_of(moving_box, 3)
    wall = now.frames.gbuffers.stencil == 0
    np.testing.assert_array_equal(now.valid[wall] == 1, before.frames.gbuffers.stencil[wall] == 0)
    assert 3 < (now.valid[wall] == 0).sum() < 40
    assert (now.valid[now.frames.gbuffers.stencil == 1] == 1).mean() > 0.9


@pytest.mark.usefixtures("without_jitter")
def test_steady_marks_what_the_lamp_changes(moving_box):
    before, now = frame_of(moving_box, 2), frame_of(moving_box, 3)
    wall = ((now.frames.gbuffers.stencil == 0) & (now.valid == 1))[..., 0]
    tone = lambda c: c / (1 + c)
    change = np.abs(tone(now.frames.color) - tone(before.frames.color)).max(-1)
    steady = now.steady[..., 0] == 1
    assert (change[wall & steady] < render.STEADY_TOLERANCE + 1e-3).all()
    assert not steady[wall & (change > render.STEADY_TOLERANCE + 1e-3)].any()
    assert (wall & ~steady).any() and steady.any()


def test_mirrors_are_not_steady(builder):
    builder.bounces = 1
    builder.rect(presets.tiles((0.2, 0.2, 0.2), (0.1, 0.1, 0.1), mirror=0.7), (4, 0, -5), 4, 9)
    builder.rect(presets.plaster((0.5, 0.5, 0.5)), (-4, 0, -5), 4, 9)
    s = frame_of(builder.build("mirror", 0), 1)
    assert (s.steady[:, : W // 2 - 1] == 1).all() and (s.steady[:, W // 2 + 1 :] == 0).all()


def test_a_mirror_shows_what_stands_before_it(builder, white):
    """A mirror seen at 45 degrees shows a glowing wall at its side; without bounces it does not."""
    from essjax.scenes.builder import rotation
    from essjax.scenes.materials import Material

    mirror = Material(a=(0.0, 0.0, 0.0), grime=0.0, mirror=1.0, specular=0.5)
    builder.rect(mirror, (0, 0, -4), 2, 2, rotation("y", np.pi / 4))
    builder.rect(white, (9, 0, -4), 9, 9, rotation("y", -np.pi / 2))
    dark = builder.build("mirror", 0)
    builder.bounces = 1
    bright = builder.build("mirror", 0)
    middle = (H // 2, W // 2)
    # Schlick at 45 degrees from 4 %, plus the 15 % that every mirror adds.
    expected = 0.04 + 0.96 * (1 - np.cos(np.pi / 4)) ** 5 + 0.15
    assert frame_of(dark, 0).frames.color[middle].max() == 0
    np.testing.assert_allclose(frame_of(bright, 0).frames.color[middle], expected, rtol=1e-2)


def test_low_resolution_sample_equals_the_high_resolution_render_there():
    world = scenes.make_scene("grille", 3, 3).at(2)
    angle = render.pixel_angle(world, 2 * W)
    jitter = np.array([0.25, -0.25], np.float32)  # LR pixel i samples the centre of HR pixel (2i + 1, 2i)
    low = render.render_buffers(world, world, W, H, jitter, angle)["color"]
    high = render.render_reference(world, 2 * W, 2 * H, spp=1)[0::2, 1::2]
    same = np.abs(low - high).max(-1) < 1e-3 * (1 + high.max(-1))
    assert same.mean() > 0.995  # a ray along a silhouette may round to the other side


def test_reference_is_a_box_filter(builder, white):
    """A white square whose left edge lies at 30 % of a pixel: the pixel shows the other 70 %."""
    edge = (10.3 - W / 2) / (FOCAL * W) * 4.0  # metres at 4 m
    builder.rect(white, (edge + 5.0, 0, -4), 5.0, 5.0)
    image = render.render_reference(builder.build("edge", 0).at(0), W, H, spp=64)
    np.testing.assert_allclose(image[H // 2, 9:12, 0], [0.0, 0.7, 1.0], atol=1.5 / 64)


def test_lambert_and_inverse_square_by_hand(builder):
    """Irradiance 12 at one metre, 2 m above a grey wall seen and lit head on: 12 / 4 * 0.5 / pi, plus a highlight."""
    from essjax.scenes.materials import Material

    builder.rect(Material(a=(0.5, 0.5, 0.5), grime=0.0, roughness=1.0, specular=0.0), (0, 0, -2), 9, 9)
    builder.lamp((0, 0, 0), (12, 6, 0))
    s = frame_of(builder.build("wall", 0), 0)
    np.testing.assert_allclose(s.frames.color[H // 2, W // 2], [12 / 8 / np.pi, 6 / 8 / np.pi, 0], rtol=1e-2, atol=1e-6)


def test_shadows_are_hard_and_where_they_belong(builder):
    """A lamp at the left of a pole throws its shadow to the right."""
    from essjax.scenes.materials import Material

    builder.rect(Material(a=(0.8, 0.8, 0.8), grime=0.0), (0, 0, -8), 20, 20)
    builder.bar(Material(), (0, -9, -4), (0, 9, -4), 0.2)
    builder.lamp((-3, 0, 0), (50, 50, 50))
    s = frame_of(builder.build("pole", 0), 0)
    row = s.frames.color[H // 2, :, 0]
    # Through the pole's axis the shadow falls on the wall at x = 3, column 15.5 + 0.9 * 31 * 3 / 8 = 25.96.
    assert row[25] == 0 and row[29] > 0.05 and row[5] > 0.05
    assert s.frames.gbuffers.depth[H // 2, 25, 0] == pytest.approx(8.0, rel=1e-3)


def test_look_at_and_exposure_and_camera_of_a_frame():
    scene = scenes.make_scene("gloss", 0, 2)
    s = frame_of(scene, 1)
    np.testing.assert_allclose(s.frames.camera.focal, float(scene.at(1).focal) * W, rtol=1e-6)
    np.testing.assert_allclose(s.frames.camera.center, [W / 2, H / 2])
    rotation = s.frames.camera.camera_to_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5) and s.frames.exposure == 1 / scene.unit
    assert look_at(np.zeros(3), np.array([0, 0, -1.0]))[2, 2] == pytest.approx(1.0)
