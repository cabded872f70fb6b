"""sample, backward_warp, inside_mask: conventions, properties, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.cameras import pixel_positions
from essjax.warp import backward_warp, inside_mask, sample
from essjax.warp.sampling import MODES, OUTSIDE, fetch

H, W = 7, 10
FEW = settings(max_examples=12, deadline=None)
seeds = st.integers(0, 2**31 - 1)
warp = jax.jit(backward_warp, static_argnames=("mode", "outside"))
read = jax.jit(sample, static_argnames=("mode", "outside"))


def image_of(seed, channels=3):
    return np.random.default_rng(seed).uniform(-1, 2, (H, W, channels)).astype(np.float32)


def motion_of(seed, size=4.0):
    return np.random.default_rng(seed + 1).normal(0, size, (H, W, 2)).astype(np.float32)


def cubic(d, a):
    """Keys' kernel (1981, eq 4), written independently of the library."""
    d = abs(d)
    if d <= 1:
        return (a + 2) * d**3 - (a + 3) * d**2 + 1
    return a * d**3 - 5 * a * d**2 + 8 * a * d - 4 * a if d < 2 else 0.0


KERNELS = {
    "bilinear": lambda d: max(0.0, 1 - abs(d)),
    "bicubic": lambda d: cubic(d, -0.5),
    "bicubic-0.75": lambda d: cubic(d, -0.75),
}


def oracle(image, x, y, mode, outside):
    """Sum over all pixels within reach of kernel times value, in float64."""
    height, width, channels = image.shape

    def pixel(r, c):
        if 0 <= r < height and 0 <= c < width:
            return image[r, c].astype(np.float64)
        return image[np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)] if outside == "border" else np.zeros(channels)

    if mode == "nearest":
        return pixel(int(np.floor(y)), int(np.floor(x)))
    total = np.zeros(channels)
    for r in range(int(np.floor(y)) - 4, int(np.floor(y)) + 5):
        for c in range(int(np.floor(x)) - 4, int(np.floor(x)) + 5):
            total += KERNELS[mode](y - r - 0.5) * KERNELS[mode](x - c - 0.5) * pixel(r, c)
    return total


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("outside", OUTSIDE)
def test_matches_a_direct_sum_over_pixels(mode, outside):
    image = image_of(3)
    positions = np.random.default_rng(5).uniform((-4, -4), (W + 4, H + 4), (6, 5, 2)).astype(np.float32)
    got = read(image, positions, mode=mode, outside=outside)
    expected = np.array([[oracle(image, *p, mode, outside) for p in row] for row in positions])
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_convention_by_hand():
    image = jnp.array([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0]])[..., None]  # 2 rows, 3 columns
    at = lambda x, y, **how: float(read(image, jnp.array([[[x, y]]]), **how)[0, 0, 0])
    assert at(0.5, 0.5) == 1.0  # centre of the top left pixel
    assert at(2.5, 0.5) == 4.0  # x is the column
    assert at(0.5, 1.5) == 8.0  # y goes down
    assert at(1.0, 0.5) == 1.5  # halfway between two columns
    assert at(1.0, 1.0) == (1 + 2 + 8 + 16) / 4
    assert at(0.0, 0.5) == 1.0  # border repeats
    assert at(0.0, 0.5, outside="zeros") == 0.5  # half of the read is outside, as grid_sample does
    assert at(-0.5, 0.5, outside="zeros") == 0.0
    assert at(3.25, 2.0, outside="zeros") == 32 * 0.25 * 0.5
    assert at(0.99, 0.01, mode="nearest") == 1.0  # the pixel that contains the position
    assert at(1.01, 1.99, mode="nearest") == 16.0
    assert at(3.01, 0.5, mode="nearest", outside="zeros") == 0.0
    assert at(3.01, 0.5, mode="nearest") == 4.0


@pytest.mark.parametrize(("mode", "weights"), [("bicubic", (-1, 9, 9, -1)), ("bicubic-0.75", (-1.5, 9.5, 9.5, -1.5))])
def test_bicubic_halfway_by_hand(mode, weights):
    row = jnp.array([1.0, 2.0, 4.0, 8.0])  # Keys' kernel at 1.5, .5, .5, 1.5 is the weights above / 16
    value = read(row[None, :, None], jnp.array([[[2.0, 0.5]]]), mode=mode)[0, 0, 0]
    assert float(value) == pytest.approx(float(np.dot(weights, row)) / 16)


def test_motion_points_to_the_previous_frame_by_hand():
    image = np.zeros((H, W, 1), np.float32)
    image[2, 6] = 5.0
    moved = warp(image, jnp.broadcast_to(jnp.array([3.0, -1.0]), (H, W, 2)))  # 3 right, 1 up in the previous frame
    assert np.argwhere(np.asarray(moved)[..., 0] == 5.0).tolist() == [[3, 3]]


@pytest.mark.parametrize("outside", OUTSIDE)
@pytest.mark.parametrize("mode", MODES)
@FEW
@given(seed=seeds)
def test_zero_motion_is_identity(mode, outside, seed):
    image = image_of(seed)
    np.testing.assert_array_equal(warp(image, np.zeros((H, W, 2), np.float32), mode=mode, outside=outside), image)


@pytest.mark.parametrize("mode", MODES)
@FEW
@given(seed=seeds, dx=st.integers(-W - 2, W + 2), dy=st.integers(-H - 2, H + 2))
def test_integer_motion_is_a_shift(mode, seed, dx, dy):
    image = image_of(seed)
    motion = np.broadcast_to(np.float32([dx, dy]), (H, W, 2))
    rows, columns = np.arange(H) + dy, np.arange(W) + dx
    clamped = image[np.clip(rows, 0, H - 1)][:, np.clip(columns, 0, W - 1)]
    np.testing.assert_allclose(warp(image, motion, mode=mode), clamped, atol=1e-6)
    inside = ((rows >= 0) & (rows < H))[:, None, None] & ((columns >= 0) & (columns < W))[None, :, None]
    np.testing.assert_allclose(warp(image, motion, mode=mode, outside="zeros"), clamped * inside, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
@FEW
@given(seed=seeds, value=st.floats(-100, 100, width=32))
def test_constants_are_kept(mode, seed, value):
    image = np.full((H, W, 2), value, np.float32)
    np.testing.assert_allclose(warp(image, motion_of(seed), mode=mode), image, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
@FEW
@given(seed=seeds)
def test_linear_ramps_are_kept_in_the_interior(mode, seed):
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=3)
    y, x = np.mgrid[:H, :W] + 0.5
    positions = rng.uniform((2.5, 2.5), (W - 2.5, H - 2.5), (5, 5, 2)).astype(np.float32)
    expected = a * positions[..., 0] + b * positions[..., 1] + c
    got = read((a * x + b * y + c)[..., None].astype(np.float32), positions, mode=mode)[..., 0]
    np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize("mode", MODES)
@FEW
@given(seed=seeds, a=st.floats(-2, 2, width=32), b=st.floats(-2, 2, width=32))
def test_linear_in_the_image(mode, seed, a, b):
    one, other, motion = image_of(seed), image_of(seed + 7), motion_of(seed)
    together = warp(np.float32(a) * one + np.float32(b) * other, motion, mode=mode, outside="zeros")
    apart = [warp(i, motion, mode=mode, outside="zeros") for i in (one, other)]
    np.testing.assert_allclose(together, a * apart[0] + b * apart[1], atol=2e-5)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("mode", MODES)
@FEW
@given(seed=seeds)
def test_equivariant_to_flips(mode, axis, seed):
    image, motion = image_of(seed), motion_of(seed)
    flipped = np.flip(motion, axis) * np.float32([-1, 1] if axis == 1 else [1, -1])
    got = warp(np.flip(image, axis), flipped, mode=mode, outside="zeros")
    np.testing.assert_allclose(got, np.flip(warp(image, motion, mode=mode, outside="zeros"), axis), atol=2e-5)


@pytest.mark.parametrize("mode", MODES)
def test_batch_elements_are_independent(mode):
    images = np.stack([[image_of(i + 10 * j) for i in range(2)] for j in range(3)])
    motions = np.stack([motion_of(i) for i in range(2)])  # one leading axis less: broadcasts
    got = warp(images, motions, mode=mode)
    for j in range(3):
        for i in range(2):
            np.testing.assert_allclose(got[j, i], warp(images[j, i], motions[i], mode=mode), atol=1e-6)


@pytest.mark.parametrize(("mode", "outside"), [("bilinear", "border"), ("bicubic", "border"), ("bicubic", "zeros")])
def test_gradients_of_a_batch_are_those_of_its_elements(mode, outside):
    images, motions = (np.stack([make(i) for i in range(3)]) for make in (image_of, motion_of))
    target = image_of(9)  # asymmetric
    gradient = jax.jit(jax.grad(lambda i, m: jnp.sum(backward_warp(i, m, mode=mode, outside=outside) * target), (0, 1)))
    together = gradient(images, motions)
    for i in range(3):
        for ours, alone in zip(together, gradient(images[i], motions[i]), strict=True):
            np.testing.assert_allclose(ours[i], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_one_image_is_shared_by_many_positions(mode):
    image, motions = image_of(0), np.stack([[motion_of(i) for i in range(2)]])
    expected = [warp(image, motion, mode=mode) for motion in motions[0]]
    for shared in (image, image[None], image[None, None]):
        got = read(shared, pixel_positions(H, W) + motions, mode=mode)
        assert got.shape == (1, 2, H, W, image.shape[-1])
        np.testing.assert_allclose(got[0], expected, atol=1e-6)


@pytest.mark.parametrize(("mode", "outside"), [("nearest", "zeros"), ("bilinear", "border"), ("bicubic", "zeros")])
def test_gradients_are_finite_at_singular_points(mode, outside):
    gradients = jax.jit(jax.grad(lambda i, m: jnp.sum(backward_warp(i, m, mode=mode, outside=outside) ** 2), (0, 1)))
    for where in (0.0, 0.5, 1e30, -1e30):  # on pixel centres, on their edges, far outside
        for gradient in gradients(image_of(0), jnp.full((H, W, 2), where)):
            assert np.isfinite(gradient).all()


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_gradient_to_motion_matches_finite_differences(mode):
    rng = np.random.default_rng(0)
    image = image_of(1)
    motion = (rng.integers(-2, 3, (H, W, 2)) + rng.uniform(0.2, 0.8, (H, W, 2))).astype(np.float32)
    total = lambda m: jnp.sum(warp(image, m, mode=mode) * image[::-1])
    gradient = np.asarray(jax.jit(jax.grad(total))(motion))
    for index in [(0, 0, 0), (3, 4, 1), (6, 9, 0), (5, 2, 1)]:
        step = np.zeros_like(motion)
        step[index] = 1e-2
        slope = (total(motion + step) - total(motion - step)) / 2e-2
        assert gradient[index] == pytest.approx(float(slope), abs=2e-3)


def test_gradient_flows_to_each_pixel_that_was_read():
    gradient = jax.jit(jax.grad(lambda i: jnp.sum(warp(i, motion_of(0, 0.4)))))(jnp.zeros((H, W, 1)))
    assert float(gradient.sum()) == pytest.approx(H * W, rel=1e-5)  # weights sum to one


def test_nearest_keeps_integers_and_infinities():
    ids = np.arange(H * W, dtype=np.int32).reshape(H, W, 1) + 2**24
    assert warp(ids, motion_of(0), mode="nearest").dtype == jnp.int32
    np.testing.assert_array_equal(warp(ids, np.zeros((H, W, 2)), mode="nearest"), ids)
    depth = np.full((H, W, 1), np.inf, np.float32)
    assert np.isposinf(warp(depth, motion_of(0), mode="nearest")).all()
    far = warp(depth, np.full((H, W, 2), 1e4, np.float32), mode="nearest", outside="zeros")
    assert (np.asarray(far) == 0).all()


def test_half_precision_images_keep_their_type_and_coordinates_theirs():
    image = jnp.asarray(image_of(2), jnp.bfloat16)
    got = warp(image, motion_of(2))
    assert got.dtype == jnp.bfloat16
    np.testing.assert_allclose(got.astype(jnp.float32), warp(image.astype(jnp.float32), motion_of(2)), atol=2e-2)


def test_inside_mask_by_hand():
    motion = np.zeros((2, 3, 2), np.float32)
    motion[0, 0] = (-0.5, 0)  # exactly on the left edge: inside
    motion[0, 1] = (-1.6, 0)
    motion[1, 2] = (0, 0.51)
    motion[1, 0] = (2.5, -1.5)  # the opposite corner: inside
    np.testing.assert_array_equal(jax.jit(inside_mask)(motion)[..., 0], [[1, 0, 1], [1, 1, 0]])


def test_errors_name_the_argument():
    image, motion = image_of(0), motion_of(0)
    with pytest.raises(
        ValueError, match="mode: expected one of nearest, bilinear, bicubic, bicubic-0.75, got 'linear'"
    ):
        backward_warp(image, motion, mode="linear")
    with pytest.raises(ValueError, match="outside: expected one of border, zeros, got 'wrap'"):
        sample(image, motion, outside="wrap")
    with pytest.raises(ValueError, match=r"motion: expected \[..., 7, 10, 2\], got \(5, 10, 2\)"):
        backward_warp(image, motion[:5])
    with pytest.raises(ValueError, match=r"positions: expected \[..., H, W, 2\], got \(7, 10, 3\)"):
        sample(image, image)


def test_fetch_reads_pixels_of_each_image_and_of_one_for_all():
    rng = np.random.default_rng(0)
    images, one = rng.normal(size=(2, 3, 5, 7, 2)).astype(np.float32), rng.normal(size=(5, 7, 2)).astype(np.float32)
    column, row = rng.integers(0, 7, (2, 3, 4, 6)), rng.integers(0, 5, (2, 3, 4, 6))
    a, b = np.ogrid[:2, :3]
    expected = images[a[..., None, None], b[..., None, None], row, column]
    np.testing.assert_array_equal(jax.jit(fetch)(images, column, row), expected)
    np.testing.assert_array_equal(fetch(one, column, row), one[row, column])
    np.testing.assert_array_equal(fetch(one, column[0, 0], row[0, 0]), one[row[0, 0], column[0, 0]])
    np.testing.assert_array_equal(fetch(images[0], column[0, 0], row[0, 0]), images[0][:, row[0, 0], column[0, 0]])
