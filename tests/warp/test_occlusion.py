"""Hole masks and occlusion motion on small worlds whose visibility is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.frames import GBuffers
from essjax.warp import backward_warp, hole_mask, occlusion_motion

H, W = 9, 16
FEW = settings(max_examples=10, deadline=None)
mask = jax.jit(hole_mask)
around = jax.jit(occlusion_motion)
warp = jax.jit(backward_warp)


def wall(first, last, *, stencil=1, near=2.0):
    """A static wall at depth 10 that faces the camera, before it a square object on columns first..last, rows 2..6."""
    y, x = np.mgrid[:H, :W]
    here = ((x >= first) & (x <= last) & (y >= 2) & (y <= 6))[..., None]
    depth = np.where(here, near, 10.0).astype(np.float32)
    position = np.stack([x + 0.5, y + 0.5, np.ones_like(x)], -1) / H * depth  # focal length = H pixels
    return GBuffers(
        base_color=np.where(here, 0.8, 0.2) * np.ones((H, W, 3), np.float32),
        normal=np.broadcast_to(np.float32([0, 0, 1]), (H, W, 3)),
        depth=depth,
        world_position=position.astype(np.float32),
        stencil=np.where(here, stencil, 0).astype(np.int32),
        n_dot_v=np.ones((H, W, 1), np.float32),
    )


def moved_object():
    """The object steps 3 pixels to the right, from columns 4..7 to 7..10: columns 4..6 are disoccluded."""
    current, previous = wall(7, 10), wall(4, 7)
    motion = np.where(current.stencil > 0, np.float32([-3, 0]), np.float32([0, 0]))
    expected = np.ones((H, W))
    expected[2:7, 4:7] = 0
    return current, previous, motion.astype(np.float32), expected


def test_disoccluded_wall_is_the_hole():
    current, previous, motion, expected = moved_object()
    np.testing.assert_array_equal(mask(current, previous, motion)[..., 0], expected)


def test_any_one_of_the_conditions_finds_it():
    """By ids alone, by positions alone, and by depth where a renderer gives neither."""
    current, previous, motion, expected = moved_object()
    drop = lambda g, *names: dataclasses.replace(g, **dict.fromkeys(names))
    closer = lambda g: np.where(g.stencil > 0, np.float32(9.5), np.float32(10))  # by less than the depth threshold
    ids = [dataclasses.replace(drop(g, "world_position"), depth=closer(g)) for g in (current, previous)]
    np.testing.assert_array_equal(mask(*ids, motion)[..., 0], expected)
    depths = [drop(g, "world_position", "stencil", "n_dot_v") for g in (current, previous)]
    np.testing.assert_array_equal(mask(*depths, motion)[..., 0], expected)
    positions = [drop(g, "stencil", "n_dot_v") for g in (current, previous)]
    uncovered = mask(*positions, motion, position_threshold=0.5)[..., 0]
    static = np.asarray(current.stencil[..., 0]) == 0  # without ids a moving object's position counts as moved
    np.testing.assert_array_equal(np.asarray(uncovered)[static], expected[static])


def in_front(gbuffers):
    """The same surfaces, a little closer: as much as hides what lies behind, less than the depth threshold."""
    return dataclasses.replace(gbuffers, depth=gbuffers.depth * np.float32(0.95))


def test_only_what_lies_in_front_hides():
    """Another id, normal and position, but beside or behind: whatever is seen now was not hidden."""
    current, previous, motion, expected = moved_object()
    behind = wall(4, 7, near=30.0)  # what stood there before was a window to something farther away
    assert (np.asarray(mask(current, behind, motion))[2:7, 4:7] == 1).all()
    for factor, found in ((0.97, 0), (0.99, 1)):
        beside = wall(4, 7, near=10.0 * factor)
        np.testing.assert_array_equal(np.asarray(mask(current, beside, motion))[2:7, 4:7], found)


def test_rope_before_the_sky_is_no_hole():
    """A rope thinner than a pixel, hit by some rows in one frame and by others in the next: nothing has moved."""
    y, x = np.mgrid[:H, :W]

    def rope(rows):
        here = (x == 6) & np.isin(y, rows)
        depth = np.where(here, 5.0, np.inf).astype(np.float32)[..., None]
        normal = np.where(here[..., None], np.float32([0, 0, -1]), 0).astype(np.float32)
        return GBuffers(depth=depth, normal=normal, stencil=np.zeros((H, W, 1), np.int32))

    still = np.zeros((H, W, 2), np.float32)
    jitters = {"jitter": jnp.array([0.3, 0.2]), "jitter_previous": jnp.array([-0.2, -0.1])}
    got = np.asarray(mask(rope([1, 2, 5]), rope([0, 3, 4, 5]), still, **jitters))
    assert (got[1:-1, 1:-1] == 1).all()


def test_ids_within_the_threshold_are_the_same():
    current, previous, motion, _ = moved_object()
    release = mask(current, previous, motion, stencil_threshold=1.0, position_threshold=1e9)
    assert (np.asarray(release) == 1).all()


def test_dynamic_pixels_compare_normals_and_static_ones_do_not():
    current = wall(4, 7)
    tilt = np.float32([0, np.sin(0.3), np.cos(0.3)])  # cosine 0.955
    previous = in_front(dataclasses.replace(current, normal=np.broadcast_to(tilt, (H, W, 3))))
    still = np.zeros((H, W, 2), np.float32)
    expected = np.where(np.asarray(current.stencil) > 0, 0, 1)
    np.testing.assert_array_equal(mask(current, previous, still), expected)
    assert (np.asarray(mask(current, previous, still, normal_threshold=0.95)) == 1).all()


def test_static_threshold_is_in_pixel_footprints_and_wider_at_grazing_angles():
    current = wall(99, 99)  # the wall alone: footprint = depth / H
    shift = lambda pixels: in_front(
        dataclasses.replace(current, world_position=current.world_position + np.float32([pixels * 10 / H, 0, 0]))
    )
    still = np.zeros((H, W, 2), np.float32)
    assert (np.asarray(mask(current, shift(1.9), still)) == 1).all()
    assert (np.asarray(mask(current, shift(2.1), still)) == 0).all()
    grazing = dataclasses.replace(current, n_dot_v=np.full((H, W, 1), 0.5, np.float32))
    assert (np.asarray(mask(grazing, shift(3.9), still)) == 1).all()
    assert (np.asarray(mask(grazing, shift(4.1), still)) == 0).all()


@FEW
@given(scale=st.floats(1e-3, 1e3))
def test_scale_free(scale):
    """The same scene in other units has the same holes."""
    current, previous, motion, expected = moved_object()
    resize = lambda g: dataclasses.replace(
        g, depth=g.depth * np.float32(scale), world_position=g.world_position * np.float32(scale)
    )
    np.testing.assert_array_equal(mask(resize(current), resize(previous), motion)[..., 0], expected)


def test_sky_to_sky_is_valid_and_sky_behind_a_surface_a_hole():
    sky = lambda columns: dataclasses.replace(
        wall(99, 99),
        depth=np.where(np.arange(W)[None, :, None] < columns, np.inf, 10.0).astype(np.float32)
        * np.ones((H, 1, 1), "f"),
        normal=np.where(np.arange(W)[None, :, None] < columns, 0.0, 1.0).astype(np.float32) * np.ones((H, 1, 3), "f"),
    )
    still = np.zeros((H, W, 2), np.float32)
    assert (np.asarray(mask(sky(5), sky(8), still)) == 1).all()  # a surface before the sky was never hidden by it
    got = mask(sky(8), sky(5), still)
    expected = np.ones((H, W))
    expected[:, 5:8] = 0
    np.testing.assert_array_equal(got[..., 0], expected)


def test_off_screen_is_a_hole():
    still = wall(99, 99)
    flat = dataclasses.replace(still, world_position=None)
    motion = np.broadcast_to(np.float32([2, -1]), (H, W, 2))
    expected = np.ones((H, W))
    expected[0], expected[:, W - 2 :] = 0, 0
    np.testing.assert_array_equal(mask(flat, flat, motion)[..., 0], expected)


def test_jitter_difference_keeps_silhouettes_valid():
    """One static edge, sampled with opposite jitters: the best of the four taps finds the same surface."""
    current, previous = wall(4, 7, stencil=0), wall(4, 8, stencil=0)
    flat = [dataclasses.replace(g, world_position=None, stencil=None) for g in (current, previous)]
    jitters = {"jitter": jnp.array([0.4, 0.0]), "jitter_previous": jnp.array([-0.4, 0.0])}
    still = np.zeros((H, W, 2), np.float32)
    assert np.asarray(mask(*flat, still))[4, 8, 0] == 0
    assert (np.asarray(mask(*flat, still, **jitters))[1:-1, 1:-1] == 1).all()


def test_batch_elements_are_independent():
    current, previous, motion, expected = moved_object()
    pair = lambda a, b: jax.tree.map(lambda x, y: np.stack([x, y]), a, b)
    got = mask(pair(current, current), pair(previous, current), np.stack([motion, motion * 0]))
    np.testing.assert_array_equal(got[0, ..., 0], expected)
    assert (np.asarray(got[1]) == 1).all()


@pytest.mark.parametrize("which", ["current", "previous"])
@pytest.mark.parametrize(("name", "channels"), [("normal", 3), ("world_position", 3), ("stencil", 1), ("n_dot_v", 1)])
def test_buffers_of_another_size_are_refused(which, name, channels):
    world = {"current": wall(1, 2), "previous": wall(1, 2)}
    small = getattr(world[which], name)[: H // 2, : W // 2]
    world[which] = dataclasses.replace(world[which], **{name: small})
    message = rf"{which}.{name}: expected \[..., 9, 16, {channels}\], got \(4, 8, {channels}\)"
    with pytest.raises(ValueError, match=message):
        hole_mask(world["current"], world["previous"], jnp.zeros((H, W, 2)))


def test_needs_both_jitters():
    with pytest.raises(ValueError, match="hole_mask: expected both jitter and jitter_previous or neither"):
        hole_mask(wall(1, 2), wall(1, 2), jnp.zeros((H, W, 2)), jitter=jnp.zeros(2))


def test_occlusion_motion_reads_background_instead_of_the_occluder():
    current, previous, motion, expected = moved_object()
    hole = mask(current, previous, motion)
    got = np.asarray(around(motion, current.depth, hole))
    np.testing.assert_array_equal(got[expected > 0], motion[expected > 0])  # unchanged outside holes
    np.testing.assert_array_equal(got[expected == 0], np.broadcast_to([-3, 0], (15, 2)))  # the occluder's motion
    color = np.asarray(warp(previous.base_color, got))
    assert (color[expected == 0] == np.float32(0.2)).all()  # wall, where plain motion shows the object:
    assert (np.asarray(warp(previous.base_color, motion))[expected == 0] == np.float32(0.8)).any()


def test_occlusion_motion_fills_the_cracks_of_a_magnified_occluder():
    """The object was larger in t-1: its splat to t-1 leaves cracks, which the wall behind must not fill."""
    depth = np.full((H, W, 1), 10, np.float32)
    depth[2:7, 10:13] = 2
    motion = np.zeros((H, W, 2), np.float32)
    motion[2:7, 10:13, 0] = np.float32([-8, -7, -6])  # columns 10, 11, 12 come from 2, 4, 6: 3 and 5 are cracks
    hole = np.ones((H, W, 1), np.float32)
    hole[2:7, 2:7] = 0
    got = np.asarray(around(motion, depth, hole))
    assert (got[2:7, 2:7, 0] <= -6).all() and (got[hole[..., 0] == 1] == motion[hole[..., 0] == 1]).all()


def test_occlusion_motion_stays_where_nothing_landed():
    motion = np.full((H, W, 2), (0.0, 3.0), np.float32)  # the upper rows of t-1 receive nothing
    got = around(motion, np.ones((H, W, 1), np.float32), np.zeros((H, W, 1), np.float32))
    np.testing.assert_array_equal(got, motion)


def test_gradients_are_finite():
    current, previous, motion, _ = moved_object()
    loss = lambda m: jnp.sum(occlusion_motion(m, current.depth, hole_mask(current, previous, m)) ** 2)
    assert np.isfinite(jax.jit(jax.grad(loss))(motion)).all()
