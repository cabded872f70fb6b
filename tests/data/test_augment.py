"""Crops and flips: what belongs together stays together. Oracle: the camera projects positions onto their pixels."""

import dataclasses

import jax
import numpy as np
import pytest

from essjax.cameras import Camera, pixel_positions, project, static_motion, unproject
from essjax.data import crop, flip
from essjax.frames import Frame, GBuffers, Sequence, validate_sequence
from tests.helpers import make_ranges, random_camera

H, W, T, SCALE = 9, 14, 3, 2


def scene() -> Sequence:
    """A static world seen by a turning camera with everything consistent: positions, motion, normals, jitter; the
    reference's pixel (y, x) holds its own coordinates. Asymmetric: off-centre camera, a slanted surface, odd height."""
    camera = jax.tree.map(lambda leaf: np.array(leaf[:, 0]), random_camera(3, T, 1, H, W))
    camera = dataclasses.replace(
        camera,
        center=np.tile(np.array([W / 2 + 1.3, H / 2 - 0.6], np.float32), (T, 1)),
        focal=np.tile(np.array([12.0, 11.0], np.float32), (T, 1)),
    )
    jitter = np.array([[0.25, -0.4], [0.25, -0.4], [-0.1, 0.3]], np.float32)
    positions = np.asarray(pixel_positions(H, W, jitter))
    depth = (4.0 + 0.2 * positions[..., :1] + 0.1 * positions[..., 1:]).astype(np.float32)
    depth[:, :2, :5] = np.inf
    previous = jax.tree.map(lambda leaf: np.concatenate([leaf[:1], leaf[:-1]]), camera)
    world = np.asarray(unproject(camera, positions, depth))
    hit = np.isfinite(depth)
    normal = np.where(hit, np.array([0.48, -0.36, 0.8], np.float32), 0.0).astype(np.float32)
    y, x = np.mgrid[: H * SCALE, : W * SCALE].astype(np.float32)
    reference = np.stack([x, y, x + 100 * y], axis=-1)
    low_y, low_x = np.mgrid[:H, :W].astype(np.float32)
    color = np.stack([low_x, low_y, low_x + 100 * low_y], axis=-1)
    frames = Frame(
        color=np.tile(color, (T, 1, 1, 1)),
        gbuffers=GBuffers(
            base_color=np.where(hit, 0.5, 0.0).repeat(3, -1).astype(np.float32),
            normal=normal,
            depth=depth,
            world_position=world,
            stencil=np.tile((low_x > 8)[..., None], (T, 1, 1, 1)).astype(np.int32),
        ),
        motion=np.asarray(static_motion(camera, previous, positions, depth)),
        jitter=jitter,
        cut=np.array([True, False, False]),
        exposure=np.ones(T, np.float32),
        camera=camera,
    )
    valid = np.tile((low_y < 6)[..., None].astype(np.float32), (T, 1, 1, 1))
    return Sequence(frames=frames, reference=np.tile(reference, (T, 1, 1, 1)), valid=valid, steady=1 - valid)


def assert_consistent(sequence: Sequence):
    """Positions project to their samples, motion follows from the cameras, normals face the same angle to the rays."""
    frames, camera = sequence.frames, sequence.frames.camera
    height, width = frames.motion.shape[1:3]
    hit = np.isfinite(frames.gbuffers.depth)
    samples = np.asarray(pixel_positions(height, width, frames.jitter))
    projected, depth = project(camera, frames.gbuffers.world_position)
    np.testing.assert_allclose(np.where(hit, projected, samples), samples, atol=2e-4)
    np.testing.assert_allclose(np.asarray(depth)[hit], frames.gbuffers.depth[hit], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.det(camera.camera_to_world[..., :3, :3]), 1.0, atol=1e-5)
    previous = jax.tree.map(lambda leaf: np.concatenate([leaf[:1], leaf[:-1]]), camera)
    expected = static_motion(camera, previous, samples, frames.gbuffers.depth)
    np.testing.assert_allclose(frames.motion, expected, atol=3e-4)


def cosines(sequence: Sequence) -> np.ndarray:
    """Normal against the direction to the camera."""
    frames = sequence.frames
    to_camera = frames.camera.camera_to_world[:, None, None, :3, 3] - frames.gbuffers.world_position
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    return (to_camera * frames.gbuffers.normal).sum(-1)


def test_the_scene_itself_is_consistent():
    assert_consistent(scene())
    validate_sequence(scene(), "scene")


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_flips_keep_projection_motion_and_angles(direction):
    original = scene()
    flipped = flip(original, direction)
    assert_consistent(flipped)
    axis = 2 if direction == "horizontal" else 1
    np.testing.assert_allclose(cosines(flipped), np.flip(cosines(original), axis), atol=1e-5)
    np.testing.assert_array_equal(flipped.reference, np.flip(original.reference, axis))
    np.testing.assert_array_equal(flipped.valid, np.flip(original.valid, axis))
    np.testing.assert_array_equal(flipped.steady, np.flip(original.steady, axis))
    np.testing.assert_array_equal(flipped.frames.gbuffers.stencil, np.flip(original.frames.gbuffers.stencil, axis))
    assert flipped.frames.gbuffers.stencil.dtype == np.int32


def test_a_horizontal_flip_by_hand():
    original = scene()
    flipped = flip(original, "horizontal")
    np.testing.assert_array_equal(flipped.frames.motion[1, 4, 2], original.frames.motion[1, 4, W - 3] * [-1, 1])
    np.testing.assert_array_equal(flipped.frames.gbuffers.normal[1, 4, 2], np.float32([-0.48, -0.36, 0.8]))
    np.testing.assert_array_equal(flipped.frames.jitter[0], np.float32([-0.25, -0.4]))
    np.testing.assert_allclose(flipped.frames.camera.center[0], [W / 2 - 1.3, H / 2 - 0.6])
    vertical = flip(original, "vertical")
    np.testing.assert_array_equal(vertical.frames.motion[1, 2, 3], original.frames.motion[1, H - 3, 3] * [1, -1])
    np.testing.assert_array_equal(vertical.frames.jitter[0], np.float32([0.25, 0.4]))


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_flipping_twice_changes_nothing(direction):
    original = dataclasses.replace(scene(), native=scene().frames)
    twice = flip(flip(original, direction), direction)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), twice, original)


def test_crops_cut_the_same_place_out_of_frame_and_reference():
    cropped = crop(scene(), 3, 5, 4, 7)
    assert cropped.frames.color.shape == (T, 4, 7, 3) and cropped.reference.shape == (T, 8, 14, 3)
    np.testing.assert_array_equal(cropped.frames.color[0, 0, 0, :2], [5, 3])
    np.testing.assert_array_equal(cropped.reference[0, 0, 0, :2], [10, 6])
    np.testing.assert_array_equal(cropped.reference[:, ::2, ::2, :2] / 2, cropped.frames.color[..., :2])
    assert_consistent(cropped)


def test_valid_loses_pixels_whose_past_is_outside_the_crop():
    original = scene()
    motion = np.zeros_like(original.frames.motion)
    motion[..., 0] = -2.0  # the past is two pixels to the left
    original = dataclasses.replace(original, frames=dataclasses.replace(original.frames, motion=motion))
    cropped = crop(original, 0, 5, 4, 7)
    np.testing.assert_array_equal(cropped.valid[0, 0, :, 0], [0, 0, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(cropped.steady, original.steady[:, :4, 5:12])


def test_flip_then_crop_of_odd_sizes_is_consistent():
    assert_consistent(flip(flip(crop(scene(), 2, 3, 5, 11), "vertical"), "horizontal"))


def test_errors():
    with pytest.raises(ValueError, match=r"crop: 8x4 at \(7, 0\) does not fit into frames of 14x9"):
        crop(scene(), 0, 7, 4, 8)
    with pytest.raises(ValueError, match="expected horizontal or vertical, got 'left'"):
        flip(scene(), "left")


def test_a_frame_without_a_camera_or_masks():
    bare = dataclasses.replace(scene(), valid=None, steady=None)
    bare = dataclasses.replace(bare, frames=dataclasses.replace(bare.frames, camera=None))
    result = crop(flip(bare, "horizontal"), 1, 1, 3, 3)
    assert result.frames.camera is None and result.valid is None and result.frames.motion.shape == (T, 3, 3, 2)
    assert isinstance(scene().frames.camera, Camera)


def with_ranges() -> Sequence:
    ranges = jax.tree.map(np.asarray, make_ranges(5, T, SCALE * H, SCALE * W))
    return dataclasses.replace(scene(), ranges=ranges)


def test_ranges_are_cut_and_mirrored_with_the_reference():
    original = with_ranges()
    cropped = crop(original, 3, 5, 4, 7)
    np.testing.assert_array_equal(cropped.ranges.color_min, original.ranges.color_min[:, 6:14, 10:24])
    np.testing.assert_array_equal(cropped.ranges.motion, original.ranges.motion[:, 6:14, 10:24])
    for direction, axis, sign in (("horizontal", 2, [-1, 1]), ("vertical", 1, [1, -1])):
        flipped = flip(original, direction)
        np.testing.assert_array_equal(flipped.ranges.motion, np.flip(original.ranges.motion, axis) * sign)
        np.testing.assert_array_equal(flipped.ranges.depth_max, np.flip(original.ranges.depth_max, axis))
        validate_sequence(flip(cropped, direction), "cropped")
