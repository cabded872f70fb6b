import numpy as np
import pytest

from essjax.scenes.jitter import dlctus_pattern, halton, jitter_sequence, reference_samples


def test_halton_by_hand():
    assert [halton(k, 2) for k in (1, 2, 3, 4)] == [0.5, 0.25, 0.75, 0.125]
    np.testing.assert_allclose([halton(k, 3) for k in (1, 2, 3, 4)], [1 / 3, 2 / 3, 1 / 9, 4 / 9])


def test_kronecker_by_hand():
    jitter = jitter_sequence(40)
    assert jitter.shape == (40, 2) and jitter.dtype == np.float32
    assert (jitter >= -0.5).all() and (jitter < 0.5).all()
    np.testing.assert_allclose(jitter[:3] + 0.5, [(0, 0), (0.829019, 0.600993), (0.658038, 0.201986)], atol=1e-6)


def largest_gap(points):
    """Largest distance to the nearest point, over that of a square grid of as many points; the pixel is a torus."""
    places = (np.stack(np.meshgrid(*2 * [np.arange(32)]), axis=-1).reshape(-1, 1, 2) + 0.5) / 32 - 0.5
    apart = np.abs(places - points)
    return np.sqrt((np.minimum(apart, 1 - apart) ** 2).sum(-1).min(1).max() * 2 * len(points))


@pytest.mark.parametrize("period", [1, 2, 3, 4])
def test_the_rendered_frames_alone_cover_the_pixel_whichever_the_rate(period):
    """Halton by pairs of frames, once ours, had 1.8 after 16 frames at periods 2 and 3 and 2.3 at 4."""
    jitter = jitter_sequence(32 * period)
    for phase in range(period):
        for count in (4, 8, 16, 32):
            assert largest_gap(jitter[phase::period][:count]) < 1.3


def test_prefix_does_not_depend_on_length():
    np.testing.assert_array_equal(jitter_sequence(5), jitter_sequence(40)[:5])


def covered_cells(points, cells):
    return len({tuple(c) for c in np.floor((points + 0.5) * cells).astype(int)})


def test_dlctus_pattern_at_4x4_visits_every_output_pixel_without_neighbours():
    cells = (dlctus_pattern(4) + 0.5) * 4 - 0.5
    np.testing.assert_array_equal(cells, np.round(cells))  # centres of output pixels
    assert len({tuple(cell) for cell in cells}) == 16
    for before, after in zip(np.roll(cells, 1, axis=0), cells, strict=True):
        step = np.abs(after - before)
        assert np.minimum(step, 4 - step).max() == 2  # neither do they touch across the border of the input pixel
    for start in range(16):
        assert len({tuple(cell // 2) for cell in np.roll(cells, -start, axis=0)[:4]}) == 4


def test_dlctus_pattern_at_2x2_by_hand():
    positions = (dlctus_pattern(2) + 0.5) * 2
    hourglass = [(0, 0), (1, 0), (0, 1), (1, 1)]
    np.testing.assert_array_equal(np.floor(positions), hourglass * 4)
    inside = [(1 / 4, 2 / 3), (3 / 4, 1 / 9), (1 / 8, 4 / 9), (5 / 8, 7 / 9)]  # Halton (2, 3), elements 2 to 5
    np.testing.assert_allclose(positions - np.floor(positions), np.repeat(inside, 4, axis=0), atol=1e-6)


@pytest.mark.parametrize("scale", [2, 4])
def test_dlctus_pattern_advances_every_frame_and_repeats_after_16(scale):
    jitter = jitter_sequence(35, pattern="dlctus", scale=scale)
    assert jitter.shape == (35, 2) and jitter.dtype == np.float32
    assert (jitter >= -0.5).all() and (jitter < 0.5).all()
    np.testing.assert_array_equal(jitter[16:32], jitter[:16])
    assert len(np.unique(jitter[:16], axis=0)) == 16


def test_errors():
    with pytest.raises(ValueError, match="jitter: expected one of kronecker, dlctus, got 'sobol'"):
        jitter_sequence(3, pattern="sobol")
    with pytest.raises(ValueError, match="the pattern dlctus exists for the scales 2 and 4, got 3. Use kronecker"):
        jitter_sequence(3, pattern="dlctus", scale=3)


def test_reference_samples_have_distinct_rows_and_columns():
    samples = reference_samples(64)
    assert (samples >= 0).all() and (samples < 1).all()
    assert len(np.unique(np.floor(samples[:, 0] * 64))) == 64
    assert covered_cells(samples - 0.5, 8) >= 48
    np.testing.assert_allclose(samples.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(reference_samples(1), [[0.5, 0.5]])
