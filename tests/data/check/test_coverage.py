"""Which rates a clip's jitter serves."""

import numpy as np

from essjax.data.check.coverage import judge_coverage, largest_gap
from essjax.scenes.jitter import halton, jitter_sequence


def plain_halton(length, period=16):
    return np.array([(halton(1 + n % period, 2), halton(1 + n % period, 3)) for n in range(length)]) - 0.5


def test_gap_of_a_grid_is_one_and_of_half_a_pixel_grows():
    side = (np.arange(4) + 0.5) / 4 - 0.5
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(largest_gap(grid), 1.0, atol=0.15)
    half = grid[grid[:, 0] < 0]
    # 8 points in the left half: the middle of the right half is 0.375 away, and half a row from the nearest.
    np.testing.assert_allclose(largest_gap(half), np.hypot(0.375, 0.125) * 4, atol=0.2)


def test_ours_serves_every_rate_and_plain_halton_every_frame():
    finding = judge_coverage([jitter_sequence(64)])
    assert finding.verdict == "ok" and finding.found == "the rendered frames cover the pixel at 1:1, 1:2, 1:3, 1:4"
    finding = judge_coverage([plain_halton(64)])
    assert finding.verdict == "ok" and "at 1:1" in finding.found and "not at 1:2 (gaps" in finding.found
    assert set(finding.numbers) == {"1:1", "1:2", "1:3", "1:4"} and finding.numbers["1:2"] > 1.6


def test_one_bad_sequence_or_phase_is_enough():
    good, stuck = jitter_sequence(40), np.tile([[0.1, 0.2]], (40, 1))
    finding = judge_coverage([good, stuck])
    assert finding.verdict == "warning" and finding.found.startswith("they cover it at no rate; not at 1:1")
    assert "Halton (2, 3) for 1:1" in finding.fix


def test_what_cannot_be_said():
    assert judge_coverage([np.zeros((40, 2))]).found == "the frames have no jitter"
    assert judge_coverage([jitter_sequence(5)]).found == "there are fewer than 6 frames in a row"
    assert list(judge_coverage([jitter_sequence(14)]).numbers) == ["1:1", "1:2"]
