"""The G-buffer guided warp against a brute-force NumPy oracle, and its properties."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from essjax.frames import GBuffers
from essjax.warp import candidate_offsets, gbuffer_guided_warp, guided_weights, guides
from experiments.benchmark.measure import Compilations

H, W, G = 13, 18, 6
FEW = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 2**31 - 1)
warp = jax.jit(gbuffer_guided_warp, static_argnames="implementation")
weights_of = jax.jit(guided_weights)
SIGMAS = np.array([0.15, 0.15, 0.15, 0.14, 0.14, 0.14])


def scene(seed, motion_size=4.0, height=H, width=W):
    rng = np.random.default_rng(seed)
    radiance, guide_previous, guide = (rng.uniform(0, 1, (height, width, c)).astype(np.float32) for c in (3, G, G))
    return radiance, guide_previous, guide, rng.normal(0, motion_size, (height, width, 2)).astype(np.float32)


def oracle(radiance, guide_previous, guide, motion, sigma_guide=SIGMAS, sigma_distance=2.0):
    """ExtraSS eq 1-3 as written, pixel by pixel in float64, and by how much the choice of the four was clear."""
    height, width = motion.shape[:2]
    order = [(0, 0)]
    for s in (1, 3, 5, 9):
        for dy in (-s, 0, s):
            for dx in (-s, 0, s):
                if (dx, dy) != (0, 0):
                    order.append((dx, dy))
    result, margin = np.zeros(radiance.shape), np.full((height, width), np.inf)
    for r in range(height):
        for c in range(width):
            x, y = c + 0.5 + float(motion[r, c, 0]), r + 0.5 + float(motion[r, c, 1])
            found = []
            for dx, dy in order:
                column, row = int(np.floor(x)) + dx, int(np.floor(y)) + dy
                if 0 <= column < width and 0 <= row < height:
                    apart = (guide[r, c].astype(np.float64) - guide_previous[row, column]) / sigma_guide
                    away = np.array([x - column - 0.5, y - row - 0.5]) / sigma_distance
                    found.append((0.5 * (apart @ apart + away @ away), row, column))
            found.sort(key=lambda item: item[0])  # stable: the first of equals stays first
            if not found:
                result[r, c] = radiance[
                    np.clip(int(np.floor(y)), 0, height - 1), np.clip(int(np.floor(x)), 0, width - 1)
                ]
                continue
            if len(found) > 4:
                margin[r, c] = found[4][0] - found[3][0]
            kept = found[:4]
            weights = np.exp(kept[0][0] - np.array([cost for cost, _, _ in kept]))
            weights /= weights.sum()
            result[r, c] = sum(w * radiance[row, column] for w, (_, row, column) in zip(weights, kept, strict=True))
    return result, margin


def test_offsets_are_the_33_of_equation_1_in_the_order_that_breaks_ties():
    offsets = candidate_offsets().tolist()
    assert len(offsets) == 33 and len({tuple(o) for o in offsets}) == 33
    assert offsets[:5] == [[0, 0], [-1, -1], [0, -1], [1, -1], [-1, 0]]
    assert offsets[9:11] == [[-3, -3], [0, -3]]
    assert offsets[-1] == [9, 9]


@pytest.mark.parametrize(("seed", "size"), [(0, 1.0), (1, 6.0), (2, 25.0)])
def test_matches_brute_force(seed, size):
    arrays = scene(seed, size)  # the largest motion leaves the image by more than the reach, at many pixels
    expected, margin = oracle(*arrays)
    got = np.asarray(warp(*arrays))
    clear = margin > 1e-3  # costs that agree to 2^-17 may be taken in either order: by number, not by cost
    assert clear.mean() > 0.97
    np.testing.assert_allclose(got[clear], expected[clear], atol=3e-4)


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (33, 2)])
def test_matches_brute_force_on_odd_shapes_with_one_sigma(shape):
    arrays = scene(4, 3.0, *shape)
    got = warp(*arrays, sigma_guide=0.3, sigma_distance=2.0)
    expected, margin = oracle(*arrays, sigma_guide=0.3, sigma_distance=2.0)
    clear = margin > 1e-3
    np.testing.assert_allclose(np.asarray(got)[clear], expected[clear], atol=3e-4)


def test_ties_and_borders_by_brute_force():
    """Equal guides and whole motion: distances tie in groups of four, and the order decides."""
    radiance, _, _, _ = scene(5)
    flat = np.full((H, W, G), 0.5, np.float32)
    motion = np.broadcast_to(np.float32([2, -3]), (H, W, 2))
    got = warp(radiance, flat, flat, motion)
    np.testing.assert_allclose(got, oracle(radiance, flat, flat, motion)[0], atol=1e-5)
    _, pixels = weights_of(flat, flat, motion)
    center = 6 * W + 8  # the centre, then its neighbours above, left, right; the one below comes fifth
    assert pixels[9, 6].tolist() == [center, center - W, center - 1, center + 1]


def test_where_all_candidates_are_outside_the_nearest_border_pixel_is_used():
    radiance, guide_previous, guide, _ = scene(6)
    for motion, row, column in [((500.0, 0.0), None, W - 1), ((-1e30, 1e30), H - 1, 0), ((0.0, -40.0), 0, None)]:
        got = np.asarray(warp(radiance, guide_previous, guide, np.broadcast_to(np.float32(motion), (H, W, 2))))
        rows = np.arange(H) if row is None else np.full(H, row)
        columns = np.arange(W) if column is None else np.full(W, column)
        np.testing.assert_allclose(got, radiance[rows][:, columns], atol=1e-6)


@FEW
@given(seed=seeds, size=st.floats(0, 30))
def test_weights_sum_to_one_and_never_leave_the_image(seed, size):
    _, guide_previous, guide, motion = scene(seed, size)
    weights, pixels = weights_of(guide_previous, guide, motion)
    assert weights.shape == pixels.shape == (H, W, 4)
    np.testing.assert_allclose(np.sum(weights, -1), 1, atol=1e-5)
    assert np.min(weights) >= 0 and np.min(pixels) >= 0 and np.max(pixels) < H * W
    assert (np.diff(weights, axis=-1) <= 1e-4).all()  # best first


@FEW
@given(seed=seeds)
def test_output_is_a_convex_combination_and_linear_in_radiance(seed):
    radiance, guide_previous, guide, motion = scene(seed)
    got = np.asarray(warp(radiance, guide_previous, guide, motion))
    assert got.min() >= radiance.min() - 1e-6 and got.max() <= radiance.max() + 1e-6
    other = np.flip(radiance, 0)
    together = warp(2 * radiance - 3 * other, guide_previous, guide, motion)
    np.testing.assert_allclose(together, 2 * got - 3 * warp(other, guide_previous, guide, motion), atol=2e-5)


@FEW
@given(seed=seeds)
def test_zero_motion_with_distinct_guides_is_identity(seed):
    radiance, guide, _, _ = scene(seed)
    got = warp(radiance, guide, guide, np.zeros((H, W, 2), np.float32), sigma_guide=1e-3)
    np.testing.assert_allclose(got, radiance, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
@FEW
@given(seed=seeds)
def test_equivariant_to_flips(axis, seed):
    """Noise guides have no ties, which are the one thing that a flip changes."""
    radiance, guide_previous, guide, motion = scene(seed)
    flip = lambda image: np.flip(image, axis)
    sign = np.float32([-1, 1] if axis == 1 else [1, -1])
    got = np.asarray(warp(flip(radiance), flip(guide_previous), flip(guide), flip(motion) * sign))
    different = np.abs(got - flip(warp(radiance, guide_previous, guide, motion))).max(-1) > 1e-3
    assert different.mean() < 0.03  # near-ties between the fourth and the fifth


def test_the_guide_separates_surfaces_where_a_plain_warp_blends_them():
    """Half a pixel of motion across an edge between two materials: no colour crosses it."""
    left = np.arange(W)[None, :, None] < W // 2
    color = np.where(left, np.float32([[[1, 0, 0]]]), np.float32([[[0, 0, 1]]])) * np.ones((H, 1, 1), np.float32)
    guide = np.concatenate([color, np.zeros_like(color)], -1)
    got = np.asarray(warp(color, guide, guide, np.full((H, W, 2), 0.4, np.float32)))
    np.testing.assert_allclose(got, color, atol=1e-5)


def test_batch_elements_are_independent():
    scenes = [scene(i) for i in range(4)]
    stacked = [np.stack(parts).reshape(2, 2, *parts[0].shape) for parts in zip(*scenes, strict=True)]
    got = np.asarray(warp(*stacked)).reshape(4, H, W, 3)
    for i in range(4):
        np.testing.assert_allclose(got[i], warp(*scenes[i]), atol=1e-5)


def test_works_in_a_scan_and_under_vmap_with_a_traced_sigma():
    radiance, guide_previous, guide, motion = scene(1)

    def step(image, sigma):
        image = gbuffer_guided_warp(image, guide_previous, guide, motion, sigma_guide=sigma)
        return image, image

    _, scanned = jax.jit(lambda image, sigmas: jax.lax.scan(step, image, sigmas))(radiance, jnp.array([0.1, 0.3]))
    first = warp(radiance, guide_previous, guide, motion, sigma_guide=0.1)
    np.testing.assert_allclose(scanned[0], first, atol=1e-5)
    np.testing.assert_allclose(scanned[1], warp(first, guide_previous, guide, motion, sigma_guide=0.3), atol=1e-5)
    mapped = jax.jit(jax.vmap(lambda s: gbuffer_guided_warp(radiance, guide_previous, guide, motion, sigma_guide=s)))
    np.testing.assert_allclose(mapped(jnp.array([0.1, 0.3]))[0], first, atol=1e-5)


@pytest.fixture(scope="module")
def gradients():
    """Value and gradients of a weighted sum of the image, in one program."""

    def loss(radiance, guide_previous, guide, motion, sigma_guide, sigma_distance):
        image = gbuffer_guided_warp(
            radiance, guide_previous, guide, motion, sigma_guide=sigma_guide, sigma_distance=sigma_distance
        )
        return jnp.sum(image * jnp.linspace(-1, 1, image.size).reshape(image.shape))

    return jax.jit(jax.value_and_grad(loss, tuple(range(6))))


def test_gradients_match_finite_differences(gradients):
    """On a 2x2 image all four pixels are always the winners, so no step crosses a jump of the selection."""
    arguments = [*scene(8, 0.3, 2, 2), np.float32(SIGMAS * 8), np.float32(1.5)]
    slopes = gradients(*arguments)[1]
    probes = {0: (1, 0, 1), 1: (0, 1, 2), 2: (1, 1, 3), 3: (0, 1, 0), 4: (1,), 5: ()}
    for position, index in probes.items():
        step = np.zeros_like(arguments[position])
        step[index] = 2e-3
        shifted = [[a + sign * step if i == position else a for i, a in enumerate(arguments)] for sign in (1, -1)]
        slope = float(gradients(*shifted[0])[0] - gradients(*shifted[1])[0]) / 4e-3
        assert float(np.asarray(slopes[position])[index]) == pytest.approx(slope, rel=0.05, abs=6e-3)
        assert np.abs(slopes[position]).max() > 0


@pytest.mark.parametrize("motion", [0.0, 0.5, 3.0, 1e6, -1e30])
@pytest.mark.parametrize("same_guides", [True, False])
def test_gradients_are_finite_at_singular_points(gradients, motion, same_guides):
    radiance, guide_previous, guide, _ = scene(9)
    guide = guide_previous if same_guides else guide + 1000  # all Gaussians underflow
    field = np.full((H, W, 2), motion, np.float32)
    for slope in gradients(radiance, guide_previous, guide, field, np.float32(SIGMAS), np.float32(1e-2))[1]:
        assert np.isfinite(slope).all()


def test_guides_are_base_colour_and_normal():
    base, normal = np.full((H, W, 3), 0.25), np.full((H, W, 3), -0.5)
    got = guides(GBuffers(base_color=base, normal=normal, depth=np.ones((H, W, 1))))
    assert (
        got.shape == (H, W, 6) and (np.asarray(got)[..., :3] == 0.25).all() and (np.asarray(got)[..., 3:] == -0.5).all()
    )


@pytest.mark.parametrize("size", [(H, W), (3, 40), (1, 1)])
def test_the_network_chooses_what_sorting_chooses(size):
    """Guides of few values make many ties; NaN and infinite guides, motion to nowhere and NaN motion are among them."""
    radiance, guide_previous, guide, motion = scene(11, 6.0, *size)
    guide_previous, guide = (np.round(3 * g) / 3 for g in (guide_previous, guide))
    motion = np.round(2 * motion) / 2
    guide_previous[0, -1], guide[-1, 0], motion[0, 0] = np.nan, np.inf, (1e9, -3.0)
    if size == (H, W):
        motion[5, 7, 0] = np.nan
    arguments = guide_previous, guide, motion
    network, sorting = (
        jax.jit(lambda *a, name=name: guided_weights(*a, implementation=name))(*arguments)
        for name in ("network", "reference")
    )
    used = np.asarray(network[0]) > 0
    np.testing.assert_array_equal(np.asarray(network[1])[used], np.asarray(sorting[1])[used])
    np.testing.assert_array_equal(network[0], sorting[0])
    assert used.mean() > 0.2


@pytest.mark.parametrize(("sigma", "size"), [(1e-25, 1.0), (1e-3, 1e20), (1e-13, 1e3), (1e-18, 1e-30)])
def test_extreme_guides_and_sigmas_stay_finite(sigma, size):
    """Also where scaled guides leave float32's range: every pixel is a mean of pixels, by both ways of selection."""
    radiance, guide_previous, guide, motion = scene(13)
    arguments = radiance, guide_previous * np.float32(size), guide * np.float32(size), motion
    network, sorting = (
        warp(*arguments, sigma_guide=sigma, sigma_distance=sigma, implementation=name)
        for name in ("network", "reference")
    )
    np.testing.assert_array_equal(network, sorting)
    assert radiance.min() - 1e-5 <= np.min(network) and np.max(network) <= radiance.max() + 1e-5


def test_motion_without_a_finite_number_leaves_the_border_pixel_rule():
    radiance, guide_previous, guide, _ = scene(12)
    nowhere = np.full((H, W, 2), np.inf, np.float32)
    got = warp(radiance, guide_previous, guide, nowhere)
    np.testing.assert_array_equal(got, np.broadcast_to(radiance[-1, -1], (H, W, 3)))


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1))
def gradients_of_square(sigma, arrays):
    return jnp.sum(gbuffer_guided_warp(**arrays, sigma_guide=sigma) ** 2)


@pytest.mark.parametrize("argument", ["guide", "guide_previous", "motion"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_gradients_are_finite_where_a_pixel_is_not(argument, value):
    """What matches nothing takes no part in the weights, nor in the gradients of all that does."""
    arrays = dict(zip(("radiance", "guide_previous", "guide", "motion"), map(np.array, scene(7)), strict=True))
    arrays[argument][4, 5] = value
    for leaf in jax.tree.leaves(gradients_of_square(0.3, arrays)):
        assert np.isfinite(leaf).all()


def test_called_eagerly_it_compiles_once():
    arrays = scene(8)
    gbuffer_guided_warp(*arrays)
    with Compilations() as again:
        gbuffer_guided_warp(*arrays)
    assert again.count == 0


def test_540p_fits_in_20_megabytes():
    shapes = [jax.ShapeDtypeStruct((540, 960, c), jnp.float32) for c in (3, 6, 6, 2)]
    compiled = jax.jit(gbuffer_guided_warp).lower(*shapes).compile()
    assert compiled.memory_analysis().temp_size_in_bytes <= 20e6


def test_errors_name_the_argument():
    radiance, guide_previous, guide, motion = scene(0)
    with pytest.raises(ValueError, match=r"sigma_guide: expected one number or one for each of the 6 guide channels"):
        gbuffer_guided_warp(radiance, guide_previous, guide, motion, sigma_guide=(0.1, 0.2))
    with pytest.raises(ValueError, match=r"guide_previous: expected \[..., 13, 18, 6\], got \(13, 18, 3\)"):
        gbuffer_guided_warp(radiance, guide_previous[..., :3], guide, motion)
    with pytest.raises(ValueError, match=r"expected one of auto, network, reference, triton, got 'fast'"):
        gbuffer_guided_warp(radiance, guide_previous, guide, motion, implementation="fast")
    with pytest.raises(ValueError, match=r"expected one of network, reference, got 'triton'"):
        guided_weights(guide_previous, guide, motion, implementation="triton")
    with pytest.raises(
        ValueError, match=r"'triton' needs a GPU and the package jax-triton, and JAX runs on cpu. Install"
    ):
        gbuffer_guided_warp(radiance, guide_previous, guide, motion, implementation="triton")
    with pytest.raises(ValueError, match=r"radiance: expected \[..., 13, 18, C\], got \(12, 18, 3\)"):
        gbuffer_guided_warp(radiance[1:], guide_previous, guide, motion)
