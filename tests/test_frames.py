"""The vocabulary and its errors: each names where, which channel, what was expected, what came, what to do."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from essjax import frames as fr
from essjax.interfaces import expand_flag, no_variables, reset_at_cut
from tests.helpers import make_frames, make_sequence


def one_frame(**changes) -> fr.Frame:
    frame = jax.tree.map(lambda leaf: np.asarray(leaf)[1, 0], make_frames(0, T=2, B=1, H=5, W=7))
    return dataclasses.replace(frame, **changes)


def with_gbuffer(frame, **changes) -> fr.Frame:
    return dataclasses.replace(frame, gbuffers=dataclasses.replace(frame.gbuffers, **changes))


def spoil(image, at, value):
    image = np.array(image)
    image[at] = value
    return image


def test_random_frames_are_valid():
    fr.validate_frame(one_frame(), requires=("color", *fr.OPTIONAL_GBUFFERS))
    fr.validate_sequence(make_sequence(3, T=2, B=1, H=4, W=6, native=True, ranges=True))


def test_frames_are_pytrees_with_none_for_absent():
    frame = one_frame()
    assert len(jax.tree.leaves(fr.without_color(frame))) == len(jax.tree.leaves(frame)) - 1
    assert fr.without_color(frame).color is None and frame.color is not None
    assert "color" not in fr.frame_images(fr.without_color(frame))
    with pytest.raises(dataclasses.FrozenInstanceError):
        frame.color = None
    assert jax.jit(lambda f: f.motion.sum())(frame).shape == ()


def test_require_names_what_is_missing():
    frame = with_gbuffer(fr.without_color(one_frame()), roughness=None)
    with pytest.raises(ValueError, match="extranet needs the buffers color, roughness, which these frames do not have"):
        fr.require(frame, ("color", "normal", "roughness"), "extranet")
    with pytest.raises(ValueError, match="Render or import them, or choose another method"):
        fr.validate_frame(frame, requires=("color",))


def test_wrong_size_and_channels():
    with pytest.raises(ValueError, match=r"shot 2, channel normal: expected \[\.\.\., 5, 7, 3\].*got \(5, 6, 3\)"):
        fr.check_shapes(with_gbuffer(one_frame(), normal=np.zeros((5, 6, 3))), "shot 2")
    with pytest.raises(ValueError, match=r"channel depth: expected \[\.\.\., 5, 7, 1\].*got \(5, 7, 3\)"):
        fr.check_shapes(with_gbuffer(one_frame(), depth=np.zeros((5, 7, 3))))
    with pytest.raises(ValueError, match=r"jitter: expected \[\.\.\., 2\] \(x, y\) in pixels, got \(3,\)"):
        fr.check_shapes(one_frame(jitter=np.zeros(3)))


@pytest.mark.parametrize(
    ("changes", "name", "shape"),
    [
        ({"normal": np.zeros((5, 7, 3), "f")}, "channel normal", (5, 7, 3)),
        ({"jitter": np.zeros((5, 2), "f")}, "jitter", (5, 2)),
        ({"cut": np.array(False)}, "cut", ()),
        ({"exposure": np.ones((1, 1), "f")}, "exposure", (1, 1)),
        ({"camera": make_frames(T=1, B=2).camera}, "camera.camera_to_world", (1, 2, 4, 4)),
    ],
)
def test_leading_axes_must_agree(changes, name, shape):
    frame = jax.tree.map(lambda leaf: leaf[None], one_frame())
    change = with_gbuffer if "normal" in changes else dataclasses.replace
    message = f"frame 3, {name}: expected the leading axes (1,) of motion, got the shape {shape}. Broadcast it first."
    with pytest.raises(ValueError, match=re.escape(message)):
        fr.validate_frame(change(frame, **changes), "frame 3")


@pytest.mark.parametrize(
    ("name", "dtype", "message"),
    [
        ("color", np.uint8, "color: expected float32, got uint8. Cast it to float32 and bring it to its range."),
        ("motion", jnp.bfloat16, "motion: expected float32, got bfloat16. Cast it to float32."),
        ("jitter", np.float16, "jitter: expected float32, got float16. Cast it to float32."),
        ("exposure", np.int32, "exposure: expected float32, got int32. Cast it to float32"),
        ("cut", np.float32, "cut: expected bool, got float32. Compare it with 0."),
    ],
)
def test_types(name, dtype, message):
    frame = one_frame()
    with pytest.raises(ValueError, match=re.escape(f"frame 3, {message}")):
        fr.validate_frame(dataclasses.replace(frame, **{name: getattr(frame, name).astype(dtype)}), "frame 3")


def test_types_of_buffers_and_cameras():
    frame = one_frame()
    with pytest.raises(ValueError, match="channel stencil: expected integer ids, got float32"):
        fr.validate_frame(with_gbuffer(frame, stencil=frame.gbuffers.stencil + np.float32(0.5)))
    with pytest.raises(ValueError, match="depth: expected float32, got float16"):
        fr.validate_frame(with_gbuffer(frame, depth=frame.gbuffers.depth.astype(np.float16)))
    camera = dataclasses.replace(frame.camera, focal=frame.camera.focal.astype(np.float16))
    with pytest.raises(ValueError, match=r"camera.focal: expected float32, got float16"):
        fr.validate_frame(dataclasses.replace(frame, camera=camera))
    fr.validate_frame(with_gbuffer(frame, stencil=frame.gbuffers.stencil.astype(np.uint16)))


def test_normals_are_no_longer_than_one():
    frame = one_frame()
    with pytest.raises(
        ValueError, match=r"channel normal: expected unit length, got .*Decode or normalise it at import"
    ):
        fr.validate_frame(with_gbuffer(frame, normal=1.1 * frame.gbuffers.normal))
    fr.validate_frame(with_gbuffer(frame, normal=0.7 * frame.gbuffers.normal))


@pytest.mark.parametrize("name", ["color", "motion"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_not_finite(name, value):
    frame = one_frame()
    frame = dataclasses.replace(frame, **{name: spoil(getattr(frame, name), (3, 2, 1), value)})
    with pytest.raises(
        ValueError, match=rf"frame 4, channel {name}: expected finite values, got {value} at \(3, 2, 1\)"
    ):
        fr.validate_frame(frame, "frame 4")


def test_negative_color():
    frame = one_frame()
    with pytest.raises(ValueError, match=r"channel color: expected radiance >= 0, got -0.5 at \(1, 2, 0\).*Clamp it"):
        fr.validate_frame(dataclasses.replace(frame, color=spoil(frame.color, (1, 2, 0), -0.5)))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_depth_must_be_positive(value):
    frame = one_frame()
    frame = with_gbuffer(frame, depth=spoil(frame.gbuffers.depth, (0, 6, 0), value))
    with pytest.raises(
        ValueError, match=r"channel depth: expected positive view-space z, \+inf on the background, got"
    ):
        fr.validate_frame(frame)


@pytest.mark.parametrize("name", ["base_color", "roughness", "metallic", "specular", "n_dot_v"])
def test_unit_range(name):
    frame = one_frame()
    frame = with_gbuffer(frame, **{name: spoil(getattr(frame.gbuffers, name), (2, 2, 0), 1.5)})
    with pytest.raises(
        ValueError, match=rf"channel {name}: expected values in \[0, 1\], got 1.5 at \(2, 2, 0\) \(and 0"
    ):
        fr.validate_frame(frame)


def test_ids_and_reactive():
    frame = one_frame()
    with pytest.raises(ValueError, match="channel stencil: expected ids >= 0, got -1"):
        fr.validate_frame(with_gbuffer(frame, stencil=spoil(frame.gbuffers.stencil, (0, 0, 0), -1)))
    with pytest.raises(ValueError, match="channel reactive: expected values in"):
        fr.validate_frame(dataclasses.replace(frame, reactive=np.full((5, 7, 1), 2.0, np.float32)))
    fr.validate_frame(dataclasses.replace(frame, reactive=np.full((5, 7, 1), 0.5, np.float32)))


@pytest.mark.parametrize("jitter", [(0.7, 0.0), (0.0, -0.6), (np.nan, 0.0)])
def test_jitter_out_of_range(jitter):
    with pytest.raises(ValueError, match=r"jitter: expected pixels in \[-0.5, 0.5\).*Divide it by the image size"):
        fr.validate_frame(one_frame(jitter=np.array(jitter)))


@pytest.mark.parametrize("exposure", [0.0, -1.0, np.inf, np.nan])
def test_exposure_must_be_positive(exposure):
    with pytest.raises(ValueError, match="exposure: expected a positive number, got"):
        fr.validate_frame(one_frame(exposure=np.array(exposure)))


def test_sequence_errors_name_sequence_and_frame():
    sequence = make_sequence(1, T=3, B=1, H=4, W=6)
    bad = dataclasses.replace(sequence.frames, color=sequence.frames.color.at[2, 0, 1, 3, 0].set(jnp.nan))
    with pytest.raises(ValueError, match="market, frame 2, channel color: expected finite values"):
        fr.validate_sequence(dataclasses.replace(sequence, frames=bad), "market")
    with pytest.raises(ValueError, match="market, reference: expected 3 frames, got 2"):
        fr.validate_sequence(dataclasses.replace(sequence, reference=sequence.reference[:2]), "market")
    with pytest.raises(ValueError, match="reference: expected at least the frames' 6x4, got 12x3"):
        fr.validate_sequence(dataclasses.replace(sequence, reference=sequence.reference[:, :, :3]), "market")
    with pytest.raises(ValueError, match=r"valid: expected \[\.\.\., 4, 6, 1\], got \(3, 1, 4, 6\)"):
        fr.validate_sequence(dataclasses.replace(sequence, valid=sequence.valid[..., 0]), "market")
    with pytest.raises(ValueError, match="native frames: expected 12x8 as the reference, got 6x4"):
        fr.validate_sequence(dataclasses.replace(sequence, native=sequence.frames), "market")
    with pytest.raises(ValueError, match="market, frame 1, channel reference: expected finite radiance >= 0, got -1"):
        reference = sequence.reference.at[1, 0, 0, 0, 0].set(-1.0)
        fr.validate_sequence(dataclasses.replace(sequence, reference=reference), "market")


def test_scale():
    assert make_sequence(0, T=1, B=1, H=4, W=6, scale=4).scale == 4


def test_network_depth_by_hand():
    depth = jnp.array([[[2.0], [4.0], [jnp.inf]], [[6.0], [jnp.inf], [8.0]]])  # finite: 2 4 6 8, median 5
    gbuffers = fr.GBuffers(base_color=jnp.zeros((2, 3, 3)), normal=jnp.zeros((2, 3, 3)), depth=depth)
    assert float(fr.depth_scale(gbuffers)) == 5.0
    expected = [[0.4, 0.8, 0.0], [1.2, 0.0, 1.6]]
    np.testing.assert_allclose(fr.network_depth(gbuffers, fr.depth_scale(gbuffers))[..., 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(fr.background(gbuffers)[..., 0], [[False, False, True], [False, True, False]])
    nothing = dataclasses.replace(gbuffers, depth=jnp.full((2, 3, 1), jnp.inf))
    with np.errstate(all="raise"):
        assert float(fr.depth_scale(nothing)) == 1.0


def test_depth_scale_of_a_large_image_takes_every_kth_row_and_column():
    """75 x 100: rows 0, 2, 4 ..., columns 0, 3, 6 ...; the others are wrong here and must not count."""
    depth = np.full((75, 100, 1), 1e6, np.float32)
    depth[::2, ::3] = np.random.default_rng(0).uniform(1, 9, (38, 34, 1))
    gbuffers = fr.GBuffers(base_color=None, normal=None, depth=depth)
    np.testing.assert_allclose(fr.depth_scale(gbuffers), np.median(depth[::2, ::3]), rtol=1e-6)


def test_depth_scale_is_per_image():
    frames = make_frames(2, T=2, B=3)
    each = fr.depth_scale(frames.gbuffers)
    assert each.shape == (2, 3)
    np.testing.assert_allclose(each[1, 2], fr.depth_scale(jax.tree.map(lambda leaf: leaf[1, 2], frames.gbuffers)))


def test_select_time():
    frames = make_frames(0, T=4)
    np.testing.assert_array_equal(fr.select_time(frames, 2).color, frames.color[2])
    assert fr.select_time(frames, slice(1, 3)).motion.shape[0] == 2


def test_reset_at_cut_is_per_batch_element():
    fresh, old = {"a": jnp.ones((3, 2, 2, 1)), "n": jnp.ones(3)}, {"a": jnp.zeros((3, 2, 2, 1)), "n": jnp.zeros(3)}
    history = reset_at_cut(jnp.array([False, True, False]), fresh, old)
    np.testing.assert_array_equal(history["a"][:, 0, 0, 0], [0, 1, 0])
    np.testing.assert_array_equal(history["n"], [0, 1, 0])
    assert expand_flag(jnp.zeros((4, 3), bool), 5).shape == (4, 3, 1, 1, 1)
    assert no_variables(jax.random.key(0), one_frame()) == {}


def test_ranges_are_checked():
    sequence = make_sequence(3, T=2, B=1, H=4, W=6, ranges=True)
    ranges = sequence.ranges

    def complaint(**changes):
        changed = dataclasses.replace(ranges, **changes)
        with pytest.raises(ValueError) as error:
            fr.validate_sequence(dataclasses.replace(sequence, ranges=changed), "market")
        return str(error.value)

    text = complaint(normal_spread=ranges.normal_spread[..., :4, :, :])
    assert text.startswith("market, ranges, normal_spread: expected [..., 8, 12, 1] (the reference's size), got (2, 1,")
    text = complaint(color_max=ranges.color_min - 0.5)
    assert "market, ranges, channel color_min: expected at most color_max, got" in text
    text = complaint(motion=ranges.motion.at[1, 0, 3, 2, 1].set(jnp.nan))
    assert "market, ranges, channel motion: expected numbers, got nan at (1, 0, 3, 2, 1)" in text
    text = complaint(depth_min=ranges.depth_min.at[:].set(jnp.inf))
    assert "channel depth_min: expected at most depth_max, got inf" in text
