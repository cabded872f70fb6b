"""Guides made of depth: what a plane's normals are, edges, background, odd sizes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from essjax.frames import select_time
from essjax.warp import depth_guide, guides, normals_from_depth
from essjax.warp.depth_guides import FOCAL
from tests.helpers import make_frames

H, W = 13, 22


def plane(normal, distance):
    """Depth of the plane n . p = distance for a camera at the origin that looks along z, y down; H x W."""
    focal = FOCAL * max(H, W)
    y, x = np.mgrid[:H, :W] + 0.5
    rays = np.stack([(x - W / 2) / focal, (y - H / 2) / focal, np.ones_like(x)], axis=-1)
    return jnp.asarray(distance / (rays @ np.asarray(normal)), jnp.float32)[..., None]


def test_normals_of_a_plane_are_even_and_tell_planes_apart():
    """Of log depth, so they do not depend on the distance; exact in the middle of the picture."""
    for normal in ((0.3, -0.2, 0.93), (0.0, 0.0, 1.0), (-0.5, 0.1, 0.86)):
        normal = np.array(normal) / np.linalg.norm(normal)
        near, far = (np.asarray(jax.jit(normals_from_depth)(plane(normal, d))) for d in (2.0, 50.0))
        np.testing.assert_allclose(near, far, atol=2e-3)
        middle = near[H // 2, W // 2]
        np.testing.assert_allclose(np.abs(middle / middle[2]), np.abs(normal / normal[2]), atol=0.03)
        assert (near.reshape(-1, 3) @ middle).min() > 0.93  # the same plane all over
        np.testing.assert_allclose(np.linalg.norm(near, axis=-1), 1.0, rtol=1e-5)


def test_an_edge_belongs_to_neither_side_and_background_has_no_normal():
    depth = jnp.where(jnp.arange(W)[None, :, None] < 9, 2.0, plane((0.3, 0.0, 0.95), 9.0)).at[:4].set(jnp.inf)
    normals = np.asarray(normals_from_depth(depth))
    np.testing.assert_array_equal(normals[:4], 0.0)
    np.testing.assert_allclose(normals[4:, :9], np.broadcast_to([0.0, 0.0, 1.0], (H - 4, 9, 3)), atol=1e-6)
    assert (normals[5:, 9:, 0] > 0.1).all() or (normals[5:, 9:, 0] < -0.1).all()
    one = normals_from_depth(jnp.full((2, 1, 1, 1), 3.0))  # a single pixel
    np.testing.assert_array_equal(one, np.broadcast_to([0.0, 0.0, 1.0], (2, 1, 1, 3)))


def test_depth_differences_are_relative():
    a, b = (depth_guide(jnp.array([[[d]]])) for d in (10.0, 10.5))
    c, d = (depth_guide(jnp.array([[[d]]])) for d in (0.01, 0.0105))
    np.testing.assert_allclose(b - a, d - c, atol=1e-5)
    assert a.shape == (1, 1, 3) and np.isfinite(depth_guide(jnp.array([[[jnp.inf]]]))).all()
    np.testing.assert_allclose(float((b - a)[0, 0, 0]), 0.15, atol=0.01)  # one sigma of base colour at 5 %


def test_guides_are_base_colour_and_normals_where_they_are():
    gbuffers = select_time(make_frames(0, T=1, B=2, H=H, W=W), 0).gbuffers
    np.testing.assert_array_equal(guides(gbuffers), np.concatenate([gbuffers.base_color, gbuffers.normal], axis=-1))
    poor = dataclasses.replace(gbuffers, base_color=None)
    np.testing.assert_array_equal(guides(poor)[..., :3], depth_guide(gbuffers.depth))
    np.testing.assert_array_equal(guides(poor)[..., 3:], gbuffers.normal)
    poor = dataclasses.replace(gbuffers, normal=None)
    np.testing.assert_array_equal(guides(poor)[..., :3], gbuffers.base_color)
    np.testing.assert_array_equal(guides(poor)[..., 3:], normals_from_depth(gbuffers.depth))
