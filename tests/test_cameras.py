"""Camera conventions, pinned by numbers worked out by hand in the comments."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from essjax import cameras
from essjax.cameras import Camera
from tests.helpers import random_camera, random_image

H, W = 6, 9


def camera(rotation=None, origin=(0.0, 0.0, 0.0)) -> Camera:
    """Focal length (10, 20) and centre (4, 3): different in x and y, and not the image centre."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    matrix[:3, 3] = origin
    return Camera(camera_to_world=jnp.asarray(matrix), focal=jnp.array([10.0, 20.0]), center=jnp.array([4.0, 3.0]))


def yaw(angle: float) -> np.ndarray:
    """About +Y; positive turns the view from -Z towards -X, to the left."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def point(*xyz) -> jax.Array:
    return jnp.array(xyz, jnp.float32).reshape(1, 1, 3)


def test_pixel_positions():
    positions = cameras.pixel_positions(2, 3)
    assert positions.shape == (2, 3, 2)
    np.testing.assert_allclose(positions[0, 2], [2.5, 0.5])  # (x, y): column first
    np.testing.assert_allclose(positions[1, 0], [0.5, 1.5])
    jittered = cameras.pixel_positions(2, 3, jnp.array([[0.3, -0.2], [0.0, 0.4]]))
    assert jittered.shape == (2, 2, 3, 2)
    np.testing.assert_allclose(jittered[0, 0, 1], [1.8, 0.3], rtol=1e-6)
    np.testing.assert_allclose(jittered[1, 1, 0], [0.5, 1.9], rtol=1e-6)


@pytest.mark.parametrize(
    ("world", "expected", "depth"),
    [
        ((0.0, 0.0, -7.0), (4.0, 3.0), 7.0),  # on the axis: the principal point
        ((1.0, 0.0, -5.0), (4.0 + 10.0 / 5.0, 3.0), 5.0),  # to the right: x grows
        ((0.0, 2.0, -5.0), (4.0, 3.0 - 20.0 * 2.0 / 5.0), 5.0),  # up: y shrinks
    ],
)
def test_project_by_hand(world, expected, depth):
    position, z = cameras.project(camera(), point(*world))
    np.testing.assert_allclose(position[0, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(z[0, 0, 0], depth, rtol=1e-6)


def test_project_of_a_turned_camera():
    # At (2, 0, 0), turned left by 90 degrees: it looks along world -X, its right is world -Z.
    # (-3, 1, -2) is 5 ahead, 2 to the right, 1 up: x = 4 + 10 * 2 / 5, y = 3 - 20 * 1 / 5.
    position, depth = cameras.project(camera(yaw(np.pi / 2), (2.0, 0.0, 0.0)), point(-3.0, 1.0, -2.0))
    np.testing.assert_allclose(position[0, 0], [8.0, -1.0], atol=1e-5)
    np.testing.assert_allclose(depth[0, 0, 0], 5.0, rtol=1e-6)


def test_points_behind_the_camera_are_finite_and_outside():
    position, depth = cameras.project(camera(), point(1.0, 1.0, 3.0))
    assert np.all(np.isfinite(position))
    assert np.all(np.abs(position) > 1e4)
    assert float(depth[0, 0, 0]) == -3.0


def test_motion_of_a_moved_camera():
    positions = cameras.pixel_positions(H, W)
    depth = jnp.full((H, W, 1), 5.0)
    # The camera went 1 m right: everything went 10 * 1 / 5 = 2 px left, so it was 2 px further right: motion +2.
    moved_right = cameras.static_motion(camera(origin=(1, 0, 0)), camera(), positions, depth)
    np.testing.assert_allclose(moved_right, np.broadcast_to([2.0, 0.0], (H, W, 2)), atol=1e-5)
    # It went 1 m up: everything went 20 * 1 / 5 = 4 px down the image, so it was 4 px higher: motion -4.
    moved_up = cameras.static_motion(camera(origin=(0, 1, 0)), camera(), positions, depth)
    np.testing.assert_allclose(moved_up, np.broadcast_to([0.0, -4.0], (H, W, 2)), atol=1e-5)
    # It went 1 m forward, from 6 m to 5 m: offsets from the centre were 5/6 of what they are.
    forward = cameras.static_motion(camera(origin=(0, 0, -1)), camera(), positions, depth)
    np.testing.assert_allclose(forward, -(positions - jnp.array([4.0, 3.0])) / 6.0, atol=1e-5)


def test_sky_motion_by_hand():
    # Turned left by 0.1: what is ahead now was to the left of the axis before, by 10 * tan(0.1).
    positions = jnp.array([[[4.0, 3.0]]])
    motion = cameras.sky_motion(camera(yaw(0.1), (50.0, 3.0, 9.0)), camera(), positions)
    np.testing.assert_allclose(motion[0, 0], [-10.0 * np.tan(0.1), 0.0], atol=1e-5)


def test_sky_ignores_translation_and_static_motion_uses_it_at_infinity():
    positions = cameras.pixel_positions(H, W)
    now, before = camera(yaw(0.05), (3.0, -2.0, 1.0)), camera(yaw(-0.02))
    sky = cameras.sky_motion(now, before, positions)
    same_place = cameras.sky_motion(camera(yaw(0.05)), before, positions)
    np.testing.assert_allclose(sky, same_place, atol=1e-6)
    depth = jnp.full((H, W, 1), 4.0).at[2, 3].set(jnp.inf)
    motion = cameras.static_motion(now, before, positions, depth)
    np.testing.assert_allclose(motion[2, 3], sky[2, 3], atol=1e-6)
    assert float(jnp.abs(motion[2, 4] - sky[2, 4]).max()) > 0.5
    far = cameras.static_motion(now, before, positions, jnp.full((H, W, 1), 1e6))
    np.testing.assert_allclose(far, sky, atol=1e-3)


def test_unproject_of_the_background_is_zero():
    depth = jnp.full((H, W, 1), 2.0).at[0, 0].set(jnp.inf)
    world = cameras.unproject(camera(origin=(7.0, 8.0, 9.0)), cameras.pixel_positions(H, W), depth)
    np.testing.assert_array_equal(world[0, 0], 0.0)
    assert float(jnp.abs(world[0, 1]).max()) > 1.0


@jax.jit
def there_and_back(eye, positions, depth):
    return cameras.project(eye, cameras.unproject(eye, positions, depth))


@given(st.integers(0, 2**16))
def test_project_inverts_unproject(seed):
    eye = random_camera(seed, 3, 2, H, W)  # two leading axes
    positions = cameras.pixel_positions(H, W, random_image(seed, 3, 2, 2, low=-0.5, high=0.5))
    depth = random_image(seed, 3, 2, H, W, 1, low=0.5, high=30.0)
    back, back_depth = there_and_back(eye, positions, depth)
    np.testing.assert_allclose(back, positions, atol=2e-3)
    np.testing.assert_allclose(back_depth, depth, rtol=1e-4)


@jax.jit
def motion_and_place_before(now, before, positions, depth):
    seen_before, _ = cameras.project(before, cameras.unproject(now, positions, depth))
    return cameras.static_motion(now, before, positions, depth), seen_before


@given(st.integers(0, 2**16))
def test_motion_leads_to_the_same_world_point(seed):
    eyes = random_camera(seed, 2, 1, H, W)
    before, now = (jax.tree.map(lambda leaf, t=t: leaf[t], eyes) for t in (0, 1))
    positions = cameras.pixel_positions(H, W)[None]
    depth = random_image(seed, 1, H, W, 1, low=2.0, high=30.0)
    motion, seen_before = motion_and_place_before(now, before, positions, depth)
    np.testing.assert_allclose(positions + motion, seen_before, atol=1e-3)


def test_no_motion_without_camera_motion_and_finite_gradients():
    positions, depth = cameras.pixel_positions(H, W), jnp.full((H, W, 1), jnp.inf).at[1:, :].set(3.0)
    np.testing.assert_allclose(cameras.static_motion(camera(), camera(), positions, depth), 0.0, atol=1e-5)

    def loss(origin):
        matrix = camera().camera_to_world.at[:3, 3].set(origin)
        moved = Camera(camera_to_world=matrix, focal=camera().focal, center=camera().center)
        return jnp.sum(cameras.static_motion(moved, camera(), positions, depth) ** 2)

    assert np.all(np.isfinite(jax.jit(jax.grad(loss))(jnp.array([0.1, 0.2, 0.3]))))


def test_no_product_is_rounded_by_accelerators():
    positions, depth = cameras.pixel_positions(H, W), jnp.ones((H, W, 1))
    program = str(jax.make_jaxpr(lambda p, d: cameras.static_motion(camera(), camera(), p, d))(positions, depth))
    assert program.count("dot_general") == program.count("precision=(Precision.HIGHEST") == 4
