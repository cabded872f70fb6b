import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from essjax.exposure import clip_exposure
from essjax.metrics import (
    METRICS,
    aggregate,
    flicker,
    has_source,
    score_rollout,
    spatio_temporal_error,
    tpsnr,
    warped_error,
)
from tests.helpers import random_image

T, H, W = 5, 13, 18


def shown(linear):
    """Display transform, written again in NumPy."""
    linear = np.asarray(linear, np.float64)
    linear = linear / (1 + linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_tpsnr_by_hand():
    frames = [random_image(k, 6, 7, 3, high=0.4) for k in range(2)]
    # A constant error does not flicker; one that grows by 0.1 scores 20 dB.
    assert float(tpsnr(frames[1] + 0.3, frames[0] + 0.3, frames[1], frames[0])) > 90
    assert float(tpsnr(frames[1] + 0.3, frames[0] + 0.2, frames[1], frames[0])) == pytest.approx(20, abs=1e-3)
    np.testing.assert_allclose(flicker(frames[1] + 0.3, frames[0] + 0.2, frames[1], frames[0]), 0.1, atol=1e-6)


def test_warped_error_follows_the_motion():
    previous = random_image(1, 2, H, W, 3, high=1.0)
    image = jnp.roll(previous, 2, axis=-2)  # moved right by 2: previous = current + (-2, 0)
    motion = jnp.broadcast_to(jnp.array([-2.0, 0.0]), (2, H, W, 2))
    valid = jnp.ones((2, H, W, 1)).at[:, :, :2].set(0.0)
    np.testing.assert_allclose(jax.jit(warped_error)(image, previous, motion, valid=valid), 0.0, atol=1e-6)
    assert (np.asarray(warped_error(image, previous, -motion, valid=valid)) > 0.1).all()
    still = jnp.zeros_like(motion)
    expected = np.abs(np.asarray(image) - np.asarray(previous)).mean((1, 2, 3))
    np.testing.assert_allclose(warped_error(image, previous, still), expected, rtol=1e-5)
    assert np.isnan(warped_error(image, previous, motion, valid=0.0 * valid)).all()


def test_spatio_temporal_error_follows_the_error_of_the_previous_frame():
    target, error = random_image(1, 2, H, W, 3), random_image(2, 2, H, W, 3, low=-0.2, high=0.2)
    motion = jnp.broadcast_to(jnp.array([-2.0, 0.0]), (2, H, W, 2))
    # An error that moves with the surface costs nothing in time; what enters on the left repeats the border.
    moved = jnp.concatenate([error[:, :, :1], error[:, :, :1], error[:, :, :-2]], axis=2)
    arguments = (target + moved, target[:, ::-1] + error, target, target[:, ::-1], motion)
    np.testing.assert_allclose(spatio_temporal_error(*arguments, theta=1.0), 0.0, atol=1e-6)
    expected = 2 * np.abs(moved).mean((1, 2, 3))
    np.testing.assert_allclose(spatio_temporal_error(*arguments, theta=0.0), expected, rtol=1e-5)
    assert (np.asarray(spatio_temporal_error(*arguments[:4], -motion, theta=1.0)) > 0.1).all()


@pytest.fixture(scope="module")
def rollout():
    targets = random_image(0, T, H, W, 3, high=4.0)
    images = jnp.maximum(targets + random_image(1, T, H, W, 3, low=-0.3, high=0.3), 0.0)
    holes = jnp.zeros((T, H, W, 1)).at[:, 2:8, 3:7].set(1.0).at[4].set(0.0).at[4, 0, :15].set(1.0)
    return {
        "images": images,
        "targets": targets,
        "holes": holes,
        "motion": jnp.zeros((T, H, W, 2)),
        "exposure": jnp.ones(T),
    }


KINDS = ("ss", "ess", "ss", "ess", "ss")
EVERY = ("ss",) * T


def test_score_rollout_matches_numpy(rollout):
    rows = score_rollout(**rollout, scored=[2, 3, 4], kinds=KINDS)
    assert list(rows) == [2, 3, 4]
    assert [row["kind"] for row in rows.values()] == ["ss", "ess", "ss"]
    images, targets = shown(rollout["images"]), shown(rollout["targets"])
    for n, row in rows.items():
        assert row["psnr"] == pytest.approx(peak_signal_noise_ratio(targets[n], images[n], data_range=1), rel=1e-4)
        expected = structural_similarity(
            images[n], targets[n], channel_axis=-1, data_range=1,
            gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        )  # fmt: skip
        assert row["ssim"] == pytest.approx(expected, abs=1e-4)
        change = (images[n] - images[n - 2]) - (targets[n] - targets[n - 2])
        assert row["tpsnr"] == pytest.approx(-10 * np.log10((change**2).mean()), rel=1e-4)
        hole = np.asarray(rollout["holes"][..., 0]) == 1
        valid = ~hole[n] & ~hole[n - 1]  # nothing moves
        assert row["warped_error"] == pytest.approx(np.abs(images[n] - images[n - 2])[valid].mean(), rel=1e-4)
        expected = np.abs(targets[n] - targets[n - 2])[valid].mean()
        assert row["warped_error_reference"] == pytest.approx(expected, rel=1e-4)
        assert row["ssim"] - 0.2 < row["ssim_dlctus"] < row["ssim"]  # the smaller constant forgives less
        assert row["hole_share"] == pytest.approx(hole[n].mean(), rel=1e-5)
        assert row["spatial_error"] is None and row["temporal_error"] is None  # the frame before is of another kind
    error = (images[3] - targets[3])[2:8, 3:7] ** 2
    assert rows[3]["psnr_holes"] == pytest.approx(-10 * np.log10(error.mean()), rel=1e-4)
    assert rows[4]["psnr_holes"] is None  # 15 pixels are too few


def test_where_every_frame_is_rendered_the_thesis_loss_looks_one_frame_back(rollout):
    images, targets = shown(rollout["images"]), shown(rollout["targets"])
    row = score_rollout(**rollout, scored=[3], kinds=EVERY)[3]
    x, y = images[3] - targets[3], images[2] - targets[2]  # nothing moves
    assert row["spatial_error"] == pytest.approx((np.abs(x) + np.abs(y)).mean(), rel=1e-4)
    assert row["temporal_error"] == pytest.approx(np.abs(x - y).mean(), rel=1e-4)


def test_temporal_metrics_are_those_of_equal_phases(rollout):
    """Pictures between those that count change nothing; without a frame of the same kind in the shot there is none."""
    temporal = ("tpsnr", "warped_error", "warped_error_reference")
    values = lambda rows, n: [rows[n][name] for name in temporal]
    one = score_rollout(**rollout, scored=[2, 3, 4], kinds=EVERY)
    repeated = {**rollout, "images": rollout["images"].at[3].set(rollout["images"][2])}
    other = score_rollout(**repeated, scored=[2, 3, 4], kinds=KINDS)
    assert values(other, 2) == values(one, 2) and values(other, 4) == values(one, 4)
    assert values(other, 3) != values(one, 3)
    parity = score_rollout(**rollout, scored=[1, 2, 3], kinds=("ss", "ss", "ess", "ss", "ess"))
    assert values(parity, 3) == values(one, 3) and values(parity, 1) == values(parity, 2) == [None] * 3
    cut = score_rollout(**rollout, scored=[2, 3, 4], kinds=EVERY, cuts=[True, False, True, False, False])
    assert values(cut, 2) == values(cut, 3) == [None] * 3 and values(cut, 4) == values(one, 4)
    assert cut[2]["temporal_error"] is None and cut[3]["temporal_error"] == one[3]["temporal_error"]


def test_what_was_made_of_nothing_is_no_predecessor(rollout):
    """Frame 2 is a cut that is not rendered, so frame 4 has nothing of its kind to be compared with."""
    kinds, cuts = ("ss", "ss", "ess", "ss", "ess"), [True, False, True, False, False]
    np.testing.assert_array_equal(has_source(kinds, cuts), [True, True, False, True, True])
    assert score_rollout(**rollout, scored=[4], kinds=kinds, cuts=cuts)[4]["tpsnr"] is None
    assert score_rollout(**rollout, scored=[4], kinds=kinds)[4]["tpsnr"] is not None


def test_what_frames_are_made_of():
    random = np.random.default_rng(0)
    for _ in range(20):
        kinds, cuts = random.choice(["ss", "ess"], 15), random.random(15) < 0.2
        expected, found = [], False
        for kind, cut in zip(kinds, cuts, strict=True):
            found = bool(kind == "ss" or (found and not cut))
            expected.append(found)
        np.testing.assert_array_equal(has_source(kinds, cuts), expected)


def test_warped_error_follows_both_motions():
    """A picture that moves right by 2, then by 1, in a shot without holes but what enters the screen."""
    first = random_image(1, H, W, 3, high=1.0)
    images = jnp.stack([first, jnp.roll(first, 2, axis=1), jnp.roll(first, 3, axis=1)])
    motion = jnp.stack([jnp.broadcast_to(jnp.array([x, 0.0]), (H, W, 2)) for x in (0.0, -2.0, -1.0)])
    holes = jnp.zeros((3, H, W, 1)).at[1, :, :2].set(1.0).at[2, :, :1].set(1.0)
    score = lambda motion: score_rollout(images, images, scored=[2], kinds=EVERY[:3], holes=holes, motion=motion)[2]
    assert score(motion)["warped_error"] == pytest.approx(0.0, abs=1e-6)
    assert score(motion.at[1].set(0.0))["warped_error"] > 0.05


def test_first_frame_and_missing_masks(rollout):
    first = score_rollout(**rollout, scored=[0], kinds=KINDS)[0]
    assert first["tpsnr"] is None and first["warped_error"] is None and first["psnr"] > 0
    bare = score_rollout(rollout["images"], rollout["targets"], scored=[2], kinds=KINDS)[2]
    assert set(bare) == {"kind", *METRICS, "non_finite"} and bare["non_finite"] == 0
    assert bare["tpsnr"] > 0
    assert all(bare[name] is None for name in ("psnr_holes", "hole_share", "warped_error", "warped_error_reference"))
    assert score_rollout(**rollout, scored=[], kinds=KINDS) == {}


def test_scores_do_not_depend_on_the_unit(rollout):
    """Nor do they where no exposure is recorded: it is then 0.18 over the log-mean of the targets."""
    score = lambda unit, exposure: score_rollout(
        **{**rollout, "images": unit * rollout["images"], "targets": unit * rollout["targets"], "exposure": exposure},
        scored=[3], kinds=EVERY,
    )[3]  # fmt: skip
    for one, others in ((score(1.0, 0.5), [score(1e-3, 500.0), score(1e4, 5e-5)]),
                        (score(1.0, None), [score(1e-3, None), score(1e4, None)])):  # fmt: skip
        for other in others:
            for name in METRICS:
                assert other[name] == pytest.approx(one[name], rel=1e-3), name
    by_hand = score(1.0, clip_exposure(rollout["targets"]))
    assert score(1.0, None) == by_hand and by_hand["psnr"] != pytest.approx(score(1.0, 1.0)["psnr"], abs=0.1)


def test_a_frame_is_compared_at_its_own_exposure(rollout):
    """Exposure that changes is no flicker: frame 2 is shown at frame 4's where they are compared."""
    exposure = np.array([9.0, 9.0, 3.0, 1.0, 0.7])
    rows = score_rollout(**{**rollout, "exposure": exposure}, scored=[2, 4], kinds=EVERY)
    for n in (2, 4):
        constant = score_rollout(**{**rollout, "exposure": exposure[n]}, scored=[n], kinds=EVERY)[n]
        assert set(rows[n]) == set(constant)
        for name, value in constant.items():  # one frame and two are different programs
            assert rows[n][name] == (pytest.approx(value, rel=1e-6) if isinstance(value, float) else value), name


def test_aggregate_is_the_mean_of_what_is_there():
    mean = aggregate([{"psnr": 20.0, "psnr_holes": None}, {"psnr": 30.0, "psnr_holes": 12.0, "kind": "ss"}])
    assert mean["psnr"] == 25.0 and mean["psnr_holes"] == 12.0 and mean["ssim"] is None and mean["frame_count"] == 2
    assert set(mean) == {*METRICS, "frame_count", "non_finite"} and mean["non_finite"] == 0
    assert aggregate([])["psnr"] is None


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_image_that_is_not_finite_cannot_improve_a_mean(rollout, value):
    """The bad frame would be left out of a mean of numbers: 1 of 2 frames, the better one."""
    images = rollout["images"].at[2, 3, 4, 0].set(value)
    rows = score_rollout(**{**rollout, "images": images}, scored=[1, 2, 3, 4], kinds=KINDS)
    assert [row["non_finite"] for row in rows.values()] == [0, 1, 0, 1]  # frame 4's temporal metrics read frame 2
    assert rows[2]["psnr"] is None and rows[4]["psnr"] > 0 and rows[4]["tpsnr"] is None
    mean = aggregate(rows.values())
    assert mean["psnr"] is None and mean["ssim"] is None and mean["tpsnr"] is None
    assert mean["non_finite"] == 2 and mean["frame_count"] == 4
    followed = aggregate([rows[1], rows[3], rows[4]])
    assert followed["psnr"] > 0 and followed["tpsnr"] is None and followed["non_finite"] == 1
    over_sequences = aggregate([mean, aggregate([rows[1], rows[3]])])
    assert over_sequences["psnr"] is None and over_sequences["non_finite"] == 2
    bad_target = score_rollout(**{**rollout, "targets": images}, scored=[2], kinds=KINDS)
    assert bad_target[2]["non_finite"] == 1


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_sixteen_bit_frames_score_as_the_same_numbers_in_float32(rollout, dtype):
    short = {**rollout, "images": rollout["images"].astype(dtype), "targets": rollout["targets"].astype(dtype)}
    wide = {name: value.astype(jnp.float32) for name, value in short.items()}
    assert score_rollout(**short, scored=[2], kinds=KINDS) == score_rollout(**wide, scored=[2], kinds=KINDS)
    pictures = [0.1 * short["images"][n] for n in range(4)]
    expected = tpsnr(*(picture.astype(jnp.float32) for picture in pictures))
    assert float(tpsnr(*pictures)) == pytest.approx(float(expected), rel=1e-6)


def test_messages(rollout):
    with pytest.raises(ValueError, match="kinds: expected one per frame, 5, got 2"):
        score_rollout(**rollout, scored=[1], kinds=("ss", "ess"))
    with pytest.raises(ValueError, match="cuts: expected one per frame, 5, got 1"):
        score_rollout(**rollout, scored=[1], kinds=KINDS, cuts=[True])
    with pytest.raises(ValueError, match=r"scored: expected frames from 0 to 4, got \[5\]"):
        score_rollout(**rollout, scored=[2, 5], kinds=KINDS)
    with pytest.raises(ValueError, match=r"holes: expected \(5, 13, 18\) as the images, got \(5, 6, 9\)"):
        score_rollout(**{**rollout, "holes": jnp.zeros((5, 6, 9, 1))}, scored=[2], kinds=KINDS)
    whole = rollout["images"].astype(jnp.uint8)
    with pytest.raises(ValueError, match="images: expected floating-point values, got uint8"):
        score_rollout(whole, whole, scored=[2], kinds=KINDS)
    with pytest.raises(ValueError, match="images and targets: expected the same shape"):
        score_rollout(rollout["images"][:3], rollout["targets"], scored=[2], kinds=KINDS)
