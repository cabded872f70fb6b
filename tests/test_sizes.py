"""Output sizes by hand, and what is refused."""

import pytest

from essjax.sizes import check_scale, crop_steps, describe_scale, output_size, ratios, scale_of, whole_ratio


def test_sizes_by_hand():
    assert output_size(2, (541, 959)) == (1082, 1918)
    assert output_size(1.5, (541, 959)) == (812, 1438)  # 811.5 and 1438.5, to even
    assert output_size((1920, 1080), (768, 1366)) == (1080, 1920)
    assert ratios((768, 1366), (1080, 1920)) == (1920 / 1366, 1080 / 768)


@pytest.mark.parametrize(
    ("size", "output", "scale", "text"),
    [
        ((54, 96), (108, 192), 2, "x2"),
        ((54, 96), (81, 144), 1.5, "x1.5"),
        ((54, 96), (72, 128), 4 / 3, "x1.333"),
        ((541, 959), (812, 1438), (1438, 812), "1438x812"),
    ],
)
def test_the_simplest_scale_of_two_sizes_makes_the_one_of_the_other(size, output, scale, text):
    assert scale_of(size, output) == scale and type(scale_of(size, output)) is type(scale)
    assert output_size(scale_of(size, output), size) == output
    assert describe_scale(scale) == text


def test_whole_ratio():
    assert whole_ratio((5, 8), (15, 24)) == 3 and whole_ratio((5, 8), (5, 8)) == 1
    assert whole_ratio((5, 8), (15, 16)) is None and whole_ratio((4, 8), (6, 12)) is None


def test_crops_begin_and_end_where_the_reference_has_whole_pixels():
    assert crop_steps((54, 96), (108, 192)) == (1, 1)
    assert crop_steps((54, 96), (81, 144)) == (2, 2)
    assert crop_steps((54, 96), (135, 128)) == (2, 3)  # 2.5 and 4/3
    assert crop_steps((768, 1366), (1080, 1920)) is None


def test_scales_are_numbers_as_json_has_them():
    assert check_scale(2.0) == 2 and type(check_scale(2.0)) is int
    assert check_scale([1920, 1080]) == (1920, 1080)


@pytest.mark.parametrize("scale", [0.5, float("nan"), float("inf"), "2", True, (1920,), (1.5, 2.0), (0, 5), None])
def test_other_scales_are_refused(scale):
    with pytest.raises(ValueError, match=r"scale: expected a number >= 1 or the output's \(width, height\), got"):
        check_scale(scale)


def test_outputs_are_not_smaller():
    with pytest.raises(ValueError, match="scale: expected an output of at least the input's 960x540, got 1280x500"):
        output_size((1280, 500), (540, 960))
