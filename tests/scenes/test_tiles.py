"""How an image is cut into calls of the renderer."""

import jax
import numpy as np
import pytest

from essjax.scenes import make_scene
from essjax.scenes import render as rendering
from essjax.scenes.render import color_along, in_tiles, pixel_angle, render_reference, screen_grid


def test_images_of_another_shape_show_the_same_to_the_border():
    """1366x768 and 1920x1080, a 32nd: the edges of the outer pixels are at the same screen positions."""
    edges = []
    for width, height, tall in ((43, 24, 1.0), (60, 34, 24 * 60 / (43 * 34))):
        x, y = (axis.reshape(height, width) for axis in screen_grid(width, height, np.zeros(2), tall=tall))
        edges.append([x[0, -1] + 0.5 * (x[0, 1] - x[0, 0]), y[-1, 0] + 0.5 * (y[1, 0] - y[0, 0])])
    np.testing.assert_allclose(edges[0], edges[1], rtol=1e-5)


@pytest.mark.parametrize(
    ("backend", "rays", "calls"),
    [
        ("cpu", 12, [12, 12, 12]),
        ("cpu", 100, [100]),
        ("gpu", 100, [35]),
        ("gpu", 12, [12, 12, 12]),
        ("gpu", 20, [18, 18]),
    ],
)
def test_every_pixel_comes_once_and_in_its_place(monkeypatch, backend, rays, calls):
    """7 x 5 pixels; on an accelerator as few calls, but no larger than needed."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    seen = []

    def function(x, y):
        seen.append(x.size)
        return {"place": np.stack([x, y], axis=-1)}

    y, x = (grid.ravel() for grid in np.mgrid[:5, :7].astype(np.float32))
    images = in_tiles(function, x, y, 7, 5, rays=rays)
    assert seen == calls
    np.testing.assert_array_equal(images["place"], np.stack([x, y], axis=-1).reshape(5, 7, 2))


def test_a_reference_is_the_mean_of_its_samples():
    """Against one ray at a time per sample of the pattern, pixel by pixel."""
    world = make_scene("carousel", 0, 2).at(1)
    width, height, spp = 12, 9, 4
    image = render_reference(world, width, height, spp=spp)
    x, y = screen_grid(width, height, np.zeros(2))
    offsets = (rendering.reference_samples(spp) - 0.5) / width
    angle = pixel_angle(world, width)
    each = [color_along(world, x + np.float32(a), y + np.float32(b), angle) for a, b in offsets]
    np.testing.assert_allclose(image.reshape(-1, 3), np.mean(each, axis=0), rtol=1e-4, atol=1e-5)
    assert image.std() > 0.05
