"""Labels against a brute-force oracle of every equation, and on small scenes whose labels are known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import labels
from essjax.frames import SampleRanges
from essjax.labels import ALIASING, GHOSTING, Thresholds
from tests.helpers import make_ranges

B, H, W = 2, 11, 17
AT = Thresholds(ghosting_depth=0.3, ghosting_velocity=4.0, ghosting_color=0.1, ghosting_overlap=0.3, opening=2)
"""Thresholds that noise passes and fails about as often."""

visibility = jax.jit(labels.visibility_ghosting, static_argnames="at")
shading = jax.jit(labels.shading_ghosting, static_argnames="at")
label = jax.jit(labels.label, static_argnames="at")


def closeness(depth):
    return 0.0 if np.isinf(depth) else 1.0 / depth


def neighbours(y, x):
    around = [(y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    return [(v, u) for v, u in around if 0 <= v < H and 0 <= u < W]


def origin(motion, y, x):
    """The pixel that W leads to (the nearest one inside), and whether the position is inside."""
    there_x, there_y = x + 0.5 + motion[y, x, 0], y + 0.5 + motion[y, x, 1]
    inside = 0 <= there_x <= W and 0 <= there_y <= H
    return min(max(int(np.floor(there_y)), 0), H - 1), min(max(int(np.floor(there_x)), 0), W - 1), inside


def brute_visibility(now, then):
    """Equations 1 to 4, pixel by pixel."""
    marked, result = np.zeros((H, W), bool), np.zeros((H, W), bool)
    inside = np.ones((H, W), bool)
    for y in range(H):
        for x in range(W):
            v, u, inside[y, x] = origin(now.motion, y, x)
            here, there = closeness(now.depth_min[y, x, 0]), closeness(then.depth_min[v, u, 0])
            closer = there > 0 and (there - here) / there > AT.ghosting_depth
            moves = ((now.motion[y, x] - then.motion[v, u]) ** 2).sum() > AT.ghosting_velocity
            marked[y, x] = closer and moves
    for y in range(H):
        for x in range(W):
            result[y, x] = marked[y, x] or not inside[y, x]
            here = closeness(now.depth_min[y, x, 0])
            for v, u in neighbours(y, x):
                other = closeness(now.depth_min[v, u, 0])
                closer = other > 0 and (other - here) / other > AT.ghosting_depth
                moves = ((now.motion[y, x] - now.motion[v, u]) ** 2).sum() > AT.ghosting_velocity
                result[y, x] |= marked[v, u] and closer and moves
    return result


def brute_shading(now, then):
    """Equations 5 and 6, then the union of all 2 x 2 squares of marks."""
    marked = np.zeros((H, W), bool)
    tone = lambda color: color / (1 + color)
    for y in range(H):
        for x in range(W):
            v, u, _ = origin(now.motion, y, x)
            low, high = tone(now.color_min[y, x]), tone(now.color_max[y, x])
            low_then, high_then = tone(then.color_min[v, u]), tone(then.color_max[v, u])
            size = lambda a, b: np.prod(np.maximum(b - a + 1 / 256, 0))
            common = size(np.maximum(low, low_then), np.minimum(high, high_then))
            overlap = common / (size(low, high) + size(low_then, high_then) - common)
            marked[y, x] = np.abs(high - high_then).max() > AT.ghosting_color and overlap < AT.ghosting_overlap
    return brute_opening(marked, 2)


def brute_opening(marked, size):
    result = np.zeros_like(marked)
    for y in range(1 - size, H):
        for x in range(1 - size, W):
            square = (slice(max(y, 0), max(y + size, 0)), slice(max(x, 0), max(x + size, 0)))
            if marked[square].all():
                result[square] = True
    return result


def brute_geometry(now):
    near, far = (np.where(np.isinf(d), 0.0, 1 / d) for d in (now.depth_min, now.depth_max))
    with np.errstate(invalid="ignore"):
        return ((near - far) / near > AT.aliasing_depth) | (now.normal_spread_smooth > AT.aliasing_normal)


def brute_texture(now):
    ratio = np.abs((now.color_max - now.color_min) / now.color_max).max(-1, keepdims=True)
    return ((now.normal_spread > AT.aliasing_normal) | (ratio > AT.aliasing_color)) & ~brute_geometry(now)


@pytest.fixture(scope="module")
def pair():
    """Noise, with pixels of one depth only and ones that change little, so that every class occurs."""
    now, then = make_ranges(0, B, H, W), make_ranges(1, B, H, W)
    chance = np.random.default_rng(2).uniform(size=(3, B, H, W, 1))
    now = dataclasses.replace(
        now,
        depth_max=jnp.where(chance[0] < 0.7, now.depth_min * 1.005, now.depth_max),
        normal_spread_smooth=jnp.where(chance[1] < 0.7, 0.1 * now.normal_spread_smooth, now.normal_spread_smooth),
        normal_spread=jnp.where(chance[1] < 0.5, 0.1, now.normal_spread),
        color_min=jnp.where(chance[2] < 0.7, 0.8 * now.color_max, now.color_min),
    )
    return now, then


def each(pair):
    for b in range(B):
        yield b, *(jax.tree.map(lambda leaf, b=b: np.asarray(leaf[b]), ranges) for ranges in pair)


def test_every_equation_equals_brute_force(pair):
    found = {"visibility": visibility(*pair, at=AT), "shading": shading(*pair, at=AT)}
    cut = jnp.zeros(B, bool)
    both = label(*pair, cut, at=AT)
    for b, now, then in each(pair):
        seen, shaded = brute_visibility(now, then), brute_shading(now, then)
        np.testing.assert_array_equal(found["visibility"][b, ..., 0], seen)
        np.testing.assert_array_equal(found["shading"][b, ..., 0], shaded)
        geometry, texture = brute_geometry(now)[..., 0], brute_texture(now)[..., 0]
        np.testing.assert_array_equal(both.aliasing[b, ..., 0], np.where(geometry, 0, np.where(texture, 1, 2)))
        ghosting = np.where(seen, 0, np.where(shaded & ~geometry & ~texture, 1, 2))
        np.testing.assert_array_equal(both.ghosting[b, ..., 0], ghosting)
        for classes in (both.aliasing, both.ghosting):
            assert {int(c) for c in np.unique(classes[b])} == {0, 1, 2}


def test_a_cut_is_visibility_ghosting_everywhere(pair):
    both = label(*pair, jnp.array([False, True]), at=AT)
    assert (both.ghosting[1] == GHOSTING.index("visibility")).all() and (both.ghosting[0] != 0).any()
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), pair[1], pair[0], pair[1])
    cut = jnp.zeros((3, B), bool).at[2, 1].set(True)
    sequence = jax.jit(labels.label_sequence, static_argnames="at")(stacked, cut, at=AT)
    assert (sequence.ghosting[0] == 0).all() and (sequence.ghosting[2, 1] == 0).all()
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1], b), sequence, label(pair[0], pair[1], cut[1], at=AT))
    assert (sequence.ghosting[2, 0] != 0).any()


# --- Small scenes ----------------------------------------------------------------------------------------------------


def plain(depth: float = 10.0, color: float = 0.4) -> dict[str, np.ndarray]:
    """A wall that rests, without any edge."""
    full = lambda channels, value: np.full((H, W, channels), value, np.float32)
    return {
        "depth_min": full(1, depth), "depth_max": full(1, depth), "color_min": full(3, color),
        "color_max": full(3, color), "normal_spread": full(1, 0.0), "normal_spread_smooth": full(1, 0.0),
        "motion": full(2, 0.0),
    }  # fmt: skip


def with_box(left: int, motion: float, edge: bool = True) -> dict[str, np.ndarray]:
    """The wall, and a box before it in rows 3 to 7, four pixels wide; pixels left and right of it hold its edge."""
    images = plain()
    box = (slice(3, 8), slice(left, left + 4))
    images["depth_min"][box], images["depth_max"][box], images["motion"][box] = 4.0, 4.0, [motion, 0.0]
    if edge:
        images["depth_max"][3:8, [left, left + 3]] = 10.0
    return images


def draw(classes, names) -> list[str]:
    """A character per pixel: the first letter of its class, a dot for none."""
    letters = [name[0] if name != "none" else "." for name in names]
    return ["".join(letters[int(c)] for c in row) for row in np.asarray(classes)[..., 0]]


def test_a_box_that_moves_uncovers_the_wall_behind_it():
    """It moves three pixels to the right: columns 4 to 6 show the wall again."""
    now, then = SampleRanges(**with_box(7, -3.0)), SampleRanges(**with_box(4, -3.0))
    both = label(now, then, jnp.asarray(False), at=Thresholds())
    rows = draw(both.ghosting, GHOSTING)
    assert rows[3:8] == ["....vvv.........."] * 5
    assert rows[:3] + rows[8:] == ["." * W] * 6
    assert draw(both.aliasing, ALIASING)[3:8] == [".......g..g......"] * 5


def test_a_slow_box_and_one_that_rests_leave_history_alone():
    for left, motion in ((5, -1.0), (4, 0.0)):  # eq 2: one pixel is not more than one squared pixel
        now, then = SampleRanges(**with_box(left, motion)), SampleRanges(**with_box(4, motion))
        assert draw(label(now, then, jnp.asarray(False), at=Thresholds()).ghosting, GHOSTING) == ["." * W] * H


def test_a_light_that_goes_on_is_shading_ghosting_but_texture_is_not():
    now, then = plain(), plain()
    for images, value in ((now, 0.9), (then, 0.4)):
        images["color_min"][2:9, 3:12], images["color_max"][2:9, 3:12] = value, value
    now["color_min"][5, 7] = 0.1  # a detail: aliasing, and no shading ghosting
    now["color_max"][0, 16] = 0.9  # a lone pixel at the corner
    both = label(SampleRanges(**now), SampleRanges(**then), jnp.asarray(False), at=Thresholds())
    rows = draw(both.ghosting, GHOSTING)
    assert rows[2:5] + rows[6:9] == ["...sssssssss....."] * 6 and rows[5] == "...ssss.ssss....."
    assert rows[:2] + rows[9:] == ["." * W] * 4
    assert draw(both.aliasing, ALIASING)[5] == ".......t........."
    # The same change with history whose box overlaps: spatial detail, not light.
    then["color_max"][2:9, 3:12] = 0.85
    both = label(SampleRanges(**now), SampleRanges(**then), jnp.asarray(False), at=Thresholds(ghosting_overlap=0.01))
    assert draw(both.ghosting, GHOSTING) == ["." * W] * H


def test_what_comes_from_outside_has_no_history():
    now = plain()
    now["motion"][..., 0] = -2.0
    both = label(SampleRanges(**now), SampleRanges(**now), jnp.asarray(False), at=Thresholds())
    assert draw(both.ghosting, GHOSTING) == ["vv" + "." * (W - 2)] * H


@pytest.mark.parametrize("size", [2, 3, 5])
def test_opening_keeps_squares(size):
    marks = np.random.default_rng(size).uniform(size=(B, H, W, 1)) < [0.0, 0.0, 0.6, 0.8, 0.0, 0.92][size]
    opened = np.asarray(labels.opening(jnp.asarray(marks), size=size))
    for b in range(B):
        np.testing.assert_array_equal(opened[b, ..., 0], brute_opening(marks[b, ..., 0], size))
    assert 0.05 < opened.mean() < marks.mean()
    np.testing.assert_array_equal(labels.opening(jnp.asarray(opened), size=size), opened)  # twice is once


def test_thresholds_of_other_heights():
    assert Thresholds.of_height(1080) == Thresholds()
    small = Thresholds.of_height(108)
    assert small.aliasing_depth == pytest.approx(0.1) and small.opening == 2
    assert Thresholds.of_height(2160).opening == 5
