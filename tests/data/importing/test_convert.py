"""Each convention by a hand-computed, asymmetric number."""

import numpy as np
import pytest

from essjax.data.importing import convert


def pixel(*values):
    """A one-pixel image."""
    return np.asarray(values, np.float32)[None, None]


def test_velocity_texture():
    """Oracle: Unreal's encoders written out, ndc * 0.499 * 0.5 + 32767 / 65535 and, in version 5, the same of
    sign(ndc) * sqrt(|ndc|) * 2 / sqrt(2); 0 means that nothing was written."""
    ndc = pixel(0.3, -1.2)
    root = np.sign(ndc) * np.sqrt(np.abs(ndc)) * 2 / np.sqrt(2)
    for encoding, stored in (("unreal4", ndc), ("unreal5", root)):
        decoded, written = convert.decode_velocity(stored * 0.2495 + 32767 / 65535, encoding)
        np.testing.assert_allclose(decoded, ndc, atol=1e-6)
        assert written.all()
        decoded, written = convert.decode_velocity(pixel(0.0, 0.0), encoding)
        assert not written.any() and not decoded.any()


def test_motion_vectors_pass():
    """0.5 is no motion; 0.75 a quarter of the image's width, half a unit; a texture that holds 0 is another one."""
    decoded, written = convert.decode_velocity(pixel(0.75, 0.5), "unreal-mrq")
    np.testing.assert_array_equal(decoded[0, 0], [0.5, 0])
    assert written.all()
    with pytest.raises(ValueError, match=r"this image 0 in 100\.0% of the pixels.*encoding unreal4 or unreal5"):
        convert.decode_velocity(pixel(0.0, 0.0), "unreal-mrq")


@pytest.mark.parametrize(
    ("unit", "x", "y", "expected"),
    [
        ("pixels", "right", "down", (0.5, 0.25)),
        ("pixels", "left", "up", (-0.5, -0.25)),
        ("uv", "right", "down", (50, 10)),
        ("uv", "right", "up", (50, -10)),
        ("ndc", "right", "down", (25, 5)),
        ("ndc", "left", "down", (-25, 5)),
    ],
)
def test_units_and_axes(unit, x, y, expected):
    """A vector (0.5, 0.25) in an image of 100 x 40."""
    np.testing.assert_allclose(convert.to_pixels(pixel(0.5, 0.25), unit, 100, 40, x=x, y=y)[0, 0], expected)


def test_sign_of_motion():
    np.testing.assert_array_equal(convert.to_previous(pixel(3, -1), "previous-current")[0, 0], [3, -1])
    np.testing.assert_array_equal(convert.to_previous(pixel(3, -1), "current-previous")[0, 0], [-3, 1])


def test_jitter_is_taken_out_of_the_motion():
    """A still point at x = 7: samples at centre + 0.3 see it at 6.7, before, with -0.1, at 7.1: it seems to come from
    0.4 to the right, though it does not move."""
    seen = pixel(7.1 - 6.7, 0.0)
    still = convert.without_jitter(seen, np.asarray([0.3, 0.2]), np.asarray([-0.1, 0.2]))
    np.testing.assert_allclose(still, 0, atol=1e-6)


def test_sign_of_jitter():
    np.testing.assert_array_equal(convert.sample_offset(np.asarray([0.1, -0.4]), "sample"), [0.1, -0.4])
    np.testing.assert_array_equal(convert.sample_offset(np.asarray([0.1, -0.4]), "image"), [-0.1, 0.4])


@pytest.mark.parametrize(
    ("kind", "far", "stored"),
    [
        ("reversed", np.inf, 0.025),  # near / z
        ("forward", np.inf, 0.975),
        # A projection that maps z = 0.1 to 1 and z = 10 to 0: d = a / z + b, a = 1 / 9.9, b = -a / 10.
        ("reversed", 10.0, (1 / 9.9) * (1 / 4 - 1 / 10)),
        ("forward", 10.0, 1 - (1 / 9.9) * (1 / 4 - 1 / 10)),
        ("linear", np.inf, 4.0),
    ],
)
def test_depth_buffers_of_a_point_at_4_metres(kind, far, stored):
    np.testing.assert_allclose(convert.linear_depth(pixel(stored), kind, 0.1, far), 4.0, rtol=1e-4)


@pytest.mark.parametrize(("kind", "cleared"), [("reversed", 0.0), ("forward", 1.0)])
@pytest.mark.parametrize("far", [50.0, np.inf])
def test_cleared_depth_is_background_and_the_near_plane_is_near(kind, cleared, far):
    assert np.isposinf(convert.linear_depth(pixel(cleared), kind, 0.1, far)).all()
    np.testing.assert_allclose(convert.linear_depth(pixel(1 - cleared), kind, 0.1, far), 0.1, rtol=1e-5)


def test_distance_along_the_ray():
    """3-4-5: through the only pixel of a row, 2.5 px right of the principal point at focal length 10: (1, 0.25, 0)."""
    z = convert.depth_from_distance(
        pixel(8.0), np.asarray([10, 5]), np.asarray([-1.75, -1.0]), np.asarray([0.25, -0.25])
    )
    # x: (0.5 + 0.25 + 1.75) / 10 = 0.25; y: (0.5 - 0.25 + 1) / 5 = 0.25
    np.testing.assert_allclose(z, 8.0 / np.sqrt(1 + 0.25**2 + 0.25**2), rtol=1e-6)


def test_srgb():
    """Oracle: middle grey, 0.5 encoded is 0.2140 linear; the linear toe; white."""
    np.testing.assert_allclose(
        convert.srgb_to_linear(np.float32([0.5, 0.04045, 1.0, -0.1])), [0.21404, 0.00313, 1, 0], atol=1e-5
    )


def test_normals():
    np.testing.assert_allclose(convert.unit_normals(pixel(0, 3, -4), "signed")[0, 0], [0, 0.6, -0.8], rtol=1e-6)
    np.testing.assert_allclose(convert.unit_normals(pixel(0.5, 0.8, 0.1), "unsigned")[0, 0], [0, 0.6, -0.8], rtol=1e-5)
    assert not convert.unit_normals(pixel(0.5, 0.5, 0.5), "unsigned").any()


def test_halton():
    """Oracle: 1/2, 1/4, 3/4 and 1/3, 2/3, 1/9, less one half."""
    got = [convert.halton(index) for index in (1, 2, 3)]
    np.testing.assert_allclose(got, [[0, -1 / 6], [-0.25, 1 / 6], [0.25, 1 / 9 - 0.5]], atol=1e-7)
    with pytest.raises(ValueError, match=r"Halton: expected an element >= 0, got -1"):
        convert.halton(-1)
