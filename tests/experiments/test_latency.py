"""How methods that lag are run and scored: each image with its own frame, and only where there is one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax.methods.interpolation import interpolator
from essjax.rollout import alternate
from experiments.evaluate import Clip, Runner, _new_picture, evaluate, has_image, schedules, score_clip
from tests.helpers import make_sequence

T, H, W = 9, 12, 16


@pytest.fixture(scope="module")
def clip():
    """A shot of six frames and one of three; of every scored frame but one the later frame is known."""
    sequence = jax.tree.map(lambda leaf: leaf[:, 0], make_sequence(0, T=T, B=1, H=H, W=W))
    frames = dataclasses.replace(sequence.frames, cut=jnp.arange(T) % 6 == 0)
    numbers = tuple(range(20, 20 + T))
    return Clip(
        "clip", dataclasses.replace(sequence, frames=frames), numbers, [3, 4, 5, 7, 8], np.zeros((T, H, W, 1)), True
    )


MEAN = interpolator("mean", lambda variables, pair, train: (0.5 * (pair.earlier.color + pair.later.color), {}))


def test_images_stand_at_their_frames_and_others_are_not_scored(clip):
    color, runner, rows = np.asarray(clip.sequence.frames.color), Runner(MEAN, {}), {}
    for schedule in schedules(MEAN):
        kinds = schedule.kinds(T)
        images = runner(clip.sequence, schedule)
        for n in (0, 1, 2, 3, 4, 6, 7):
            expected = color[n] if kinds[n] == "ss" else 0.5 * (color[n - 1] + color[n + 1])
            if kinds[n] == "ss" or n not in (0, 6):
                np.testing.assert_allclose(images[n], expected, rtol=1e-6)
        for row in score_clip(MEAN, clip, images, kinds):
            assert row["kind"] == "ess" and row["frame"] not in rows
            rows[row["frame"]] = row
    assert sorted(rows) == [23, 24, 27]  # 25 ends a shot, 28 the sequence
    shown = {parity: alternate(parity).kinds(T) for parity in (0, 1)}
    shown = {parity: [n for n in range(T) if has_image(clip, n, MEAN, kinds)] for parity, kinds in shown.items()}
    # 6 is a cut: where it is not rendered, nothing of its shot was yet.
    assert shown == {0: [0, 1, 2, 3, 4, 6, 7], 1: [0, 1, 2, 3, 4, 7]}
    expected = 0.5 * (color[3] + color[5])
    error = np.mean((_shown(expected) - _shown(color[4])) ** 2)
    assert rows[24]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)


def _shown(color):
    linear = color / (1 + color)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("rate", "kind", "now", "before"), [(2, "ss", 4, 2), (2, "ess", 3, 1), (3, "ss", 4, 1), (3, "ess", 2, None)]
)
def test_the_input_shows_what_was_rendered_last(clip, rate, kind, now, before):
    """The previous picture is that of the same phase, ``rate`` frames back; as ESS, as far away as it gets."""
    color, picture = np.asarray(clip.sequence.frames.color), _new_picture(clip, 4, kind, True, rate)
    if before is None:  # it would be before the clip
        np.testing.assert_array_equal(picture["images"]["input"], color[now])
        assert picture["previous"] == {}
        return
    np.testing.assert_array_equal(picture["images"]["input"], color[now])
    np.testing.assert_array_equal(picture["previous"]["input"], color[before])
    np.testing.assert_array_equal(picture["images"]["reference"], color[4])
    np.testing.assert_array_equal(picture["previous"]["reference"], color[4 - rate])


@pytest.mark.parametrize(("n", "kind"), [(7, "ss"), (7, "ess"), (8, "ess"), (2, "ess")])
def test_what_precedes_the_shot_is_no_previous_picture(clip, n, kind):
    """Frame 6 is a cut: as ESS, frame 8 would be compared with a picture made of nothing."""
    assert _new_picture(clip, n, kind, True, 2)["previous"] == {}
    assert _new_picture(clip, 8, "ss", True, 2)["previous"] and _new_picture(clip, 3, "ess", True, 2)["previous"]


def test_pictures_show_no_repeated_frame(clip):
    last = dataclasses.replace(clip, scored=[8])
    assert evaluate({"mean": Runner(MEAN, {})}, [last])["pictures"] == []
