import numpy as np

from essjax.scenes.jitter import halton, jitter_sequence, reference_samples


def test_halton_by_hand():
    assert [halton(k, 2) for k in (1, 2, 3, 4)] == [0.5, 0.25, 0.75, 0.125]
    np.testing.assert_allclose([halton(k, 3) for k in (1, 2, 3, 4)], [1 / 3, 2 / 3, 1 / 9, 4 / 9])


def test_pairs_share_a_jitter_and_range():
    jitter = jitter_sequence(33)
    assert jitter.shape == (33, 2) and jitter.dtype == np.float32
    np.testing.assert_array_equal(jitter[0:32:2], jitter[1:32:2])
    assert (jitter >= -0.5).all() and (jitter < 0.5).all()


def covered_cells(points, cells):
    return len({tuple(c) for c in np.floor((points + 0.5) * cells).astype(int)})


def test_even_frames_alone_and_odd_frames_alone_cover_the_pixel():
    jitter = jitter_sequence(32)
    plain = jitter_sequence(32, every_frame=True)
    for parity in (0, 1):
        assert covered_cells(jitter[parity::2], 4) >= 13  # of 16 cells by 16 points
        assert set(np.sign(jitter[parity:16:2, 0] + 1e-6)) == {-1, 1}
    # Why it is indexed by n // 2: by n, even and odd frames fall into opposite halves of the pixel.
    assert (plain[0:16:2, 0] >= 0).all() or (plain[0:16:2, 0] < 0).all()


def test_prefix_does_not_depend_on_length():
    np.testing.assert_array_equal(jitter_sequence(5), jitter_sequence(40)[:5])


def test_reference_samples_have_distinct_rows_and_columns():
    samples = reference_samples(64)
    assert (samples >= 0).all() and (samples < 1).all()
    assert len(np.unique(np.floor(samples[:, 0] * 64))) == 64
    assert covered_cells(samples - 0.5, 8) >= 48
    np.testing.assert_allclose(samples.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(reference_samples(1), [[0.5, 0.5]])
