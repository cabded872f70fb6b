"""Dumps written by the definition of each foreign convention, imported, compared with what was written."""

import json

import numpy as np
import pytest

from essjax.data import import_dataset
from essjax.data.importing.unreal import camera_to_world
from essjax.frames import validate_sequence
from tests.data.importing.dumps import H, W, assert_like, imported, rgb, truth, write

CM = 100.0
SIZE = np.array([W, H])


def mirrored(vectors):
    """Unreal's left-handed world has y the other way."""
    return vectors * [1.0, -1.0, 1.0]


def write_extranet(folder, known, scene="Temple", reference=None, leave_out=()):
    """Motion: current - previous, pixels, y up. Sky: depth above 100, normal (-1, -1, -1)."""
    frames, buffers = known.frames, known.frames.gbuffers
    for t in range(len(frames.cut)):
        sky = np.isinf(buffers.depth[t])
        files = {
            "PreTonemapHDRColor": frames.color[t],
            "BaseColor": np.where(sky, 0.7, buffers.base_color[t]),
            "WorldNormal": np.where(sky, -1.0, mirrored(buffers.normal[t])),
            "WorldPosition": np.where(sky, 1e5, CM * mirrored(buffers.world_position[t])),
            "SceneDepth": np.where(sky, 6e4, buffers.depth[t]).repeat(3, -1),
            "MotionVector": frames.motion[t] * [-1, 1],
            "MyStencil": buffers.stencil[t],
            "NoV": buffers.n_dot_v[t],
            "Roughness": buffers.roughness[t],
            "Metallic": buffers.metallic[t],
            "Specular": buffers.specular[t],
        }
        for name, image in files.items():
            if name not in leave_out:
                write(folder / f"{scene}{name}.{t + 1:04d}.exr", rgb(image))
        if reference:
            write(reference / f"{scene}PreTonemapHDRColor.{t + 1:04d}.exr", rgb(known.reference[t]))


def test_extranet(tmp_path):
    known = truth()
    write_extranet(tmp_path / "dump", known, reference=tmp_path / "hr")
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "extranet", reference=tmp_path / "hr")
    got = imported(report, "Temple")
    validate_sequence(got, "Temple")
    assert report.sequence.numbers == (1, 2, 3, 4) and got.scale == 2
    for name in ("color", "motion", "cut"):
        assert_like(getattr(got.frames, name), getattr(known.frames, name), name)
    for name in ("base_color", "normal", "depth", "world_position", "stencil", "n_dot_v", "roughness", "metallic"):
        tolerance = 1e-3 if name == "normal" else 1e-5
        hit = np.isfinite(known.frames.gbuffers.depth)
        expected = getattr(known.frames.gbuffers, name)
        expected = expected if name == "depth" else np.where(hit, expected, 0)
        assert_like(getattr(got.frames.gbuffers, name), expected, name, atol=tolerance)
    assert_like(got.reference, known.reference, "reference")
    assert not got.frames.jitter.any()
    assert report.sequence.source["motion"]["dilated"] is True and report.sequence.source["reference"] == "own"


def test_extranet_without_a_reference_and_with_missing_buffers(tmp_path):
    known = truth(T=2)
    write_extranet(tmp_path / "dump", known, leave_out=("BaseColor", "Specular", "WorldPosition"))
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "extranet")
    got = imported(report, "Temple")
    assert got.scale == 1 and report.sequence.source["reference"] == "color"
    np.testing.assert_array_equal(got.reference, got.frames.color)
    buffers = got.frames.gbuffers
    assert buffers.base_color is None and buffers.specular is None and buffers.world_position is None
    assert buffers.normal is not None and "base_color" not in report.sequence.channels


POSITIONS = [np.array([100.0, 250.0, 170.0]) + t * np.array([6.0, -3.0, 1.0]) for t in range(5)]
ANGLES = [np.array([-12.0, 30.0, 5.0]) + t * np.array([0.4, -0.9, 0.3]) for t in range(5)]  # pitch, yaw, roll
FOV = 70.0


def unreal_axes(pitch, yaw, roll):
    """Forward, right, up: turned about x, then y, then z, as FRotator does: pitch up, yaw right."""
    p, y, r = np.radians([pitch, yaw, roll])
    axes = np.eye(3)  # rows: forward, right, up in (x forward, y right, z up)
    axes = axes @ np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    axes = axes @ np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    return axes @ np.array([[np.cos(y), np.sin(y), 0], [-np.sin(y), np.cos(y), 0], [0, 0, 1]])


def static_motion(t, depth):
    """Where a resting point (metres; inf: sky) came from, all in Unreal's own space and centimetres."""
    focal = 0.5 * W / np.tan(np.radians(FOV) / 2)
    y, x = np.mgrid[:H, :W] + 0.5
    forward, right, up = unreal_axes(*ANGLES[t])
    ray = forward + ((x - W / 2) / focal)[..., None] * right - ((y - H / 2) / focal)[..., None] * up
    sky = np.isinf(depth)
    moved = np.where(sky, ray, ray * np.where(sky, 1.0, depth) * CM + POSITIONS[t] - POSITIONS[t - 1])
    forward, right, up = unreal_axes(*ANGLES[t - 1])
    z = moved @ forward
    previous = np.stack([W / 2 + focal * (moved @ right) / z, H / 2 - focal * (moved @ up) / z], -1)
    return previous - np.stack([x, y], -1)


def unreal_header(t):
    """What Movie Render Queue writes, as strings."""
    header = {"unreal/camera/FinalImage/fov": str(FOV)}
    for which, index in (("cur", t), ("prev", max(t - 1, 0))):
        header |= {f"unreal/camera/{which}Pos/{k}": str(v) for k, v in zip("xyz", POSITIONS[index], strict=True)}
        names = ("pitch", "yaw", "roll")
        header |= {f"unreal/camera/{which}Rot/{k}": str(v) for k, v in zip(names, ANGLES[index], strict=True)}
    return header


def write_unreal(folder, known, moving=None, *, depth=None, header=True, changes=()):
    """Velocity: (current - previous), y up: as fractions of the screen + 0.5; with ``moving`` raw, which is 0 where
    nothing but the camera moves.
    """
    frames, buffers = known.frames, known.frames.gbuffers
    for t in range(len(frames.cut)):
        ndc = -frames.motion[t] * [1, -1] * 2 / SIZE
        velocity = ndc / 2 + 0.5
        if moving is not None:
            velocity = np.where(moving[t], ndc * 0.499 * 0.5 + 32767 / 65535, 0.0)
        sky = np.isinf(buffers.depth[t])
        stored = np.where(sky, 65504.0, buffers.depth[t] * CM) if depth is None else depth[t]
        channels = {
            **rgb(frames.color[t]),
            "A": np.ones((H, W)),
            **rgb(velocity, "FinalImageMovieRenderQueue_MotionVectors."),
            **rgb(stored, "FinalImageMovieRenderQueue_WorldDepth."),
            **rgb(np.where(sky, 0, mirrored(buffers.normal[t])), "FinalImageWorldNormal."),
            **rgb(np.where(sky, 0.3, buffers.base_color[t]), "FinalImageBaseColor."),
        }
        attributes = {**unreal_header(t), **dict(changes)} if header else None
        write(folder / f"shot_010.{t:04d}.exr", channels, attributes)


@pytest.fixture
def raw(tmp_path):
    (tmp_path / "raw.toml").write_text('[motion]\nencoding = "unreal4"\n')
    return tmp_path / "raw.toml"


def test_unreal_motion_vectors_pass(tmp_path):
    known = truth(T=3)
    write_unreal(tmp_path / "lr", known)
    report = import_dataset(tmp_path / "lr", tmp_path / "out", "unreal")
    np.testing.assert_allclose(imported(report, "shot_010").frames.motion[1:], known.frames.motion[1:], atol=3e-4)
    assert report.sequence.source["motion"]["encoding"] == "unreal-mrq" and "unwritten" not in report.totals


def test_unreal_raw_velocity_is_not_taken_for_the_motion_vectors_pass(tmp_path):
    known = truth(T=2)
    write_unreal(tmp_path / "lr", known, known.valid > 0.5)
    with pytest.raises(ValueError, match=r"frame 0: motion: the MotionVectors pass holds 0\.5 where nothing moves"):
        import_dataset(tmp_path / "lr", tmp_path / "out", "unreal")


def test_unreal_far_geometry_is_no_sky(tmp_path):
    """800 m in a pass of 32 bits; in one of 16 bits the sky ends at 65504 cm."""
    known = truth(T=1)
    depth = np.where(np.isinf(known.frames.gbuffers.depth), 65504.0, 80000.0)
    write_unreal(tmp_path / "lr", known, depth=depth)
    got = imported(import_dataset(tmp_path / "lr", tmp_path / "out", "unreal"), "shot_010").frames.gbuffers.depth
    np.testing.assert_array_equal(got, np.where(depth == 65504.0, np.inf, np.float32(800.0)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unreal/camera/curPos/x": "abc"}, r"frame 0: header, unreal/camera/curPos/x: expected a number, got 'abc'"),
        ({"unreal/camera/prevRot/yaw": "nan"}, r"header, unreal/camera/prevRot/yaw: expected a number, got 'nan'"),
        ({"unreal/camera/FinalImage/fov": "0"}, r"header: expected a field of view in \(0, 180\) degrees, got 0"),
    ],
)
def test_unreal_header_that_is_no_number(tmp_path, changes, message):
    write_unreal(tmp_path / "lr", truth(T=1), changes=changes.items())
    with pytest.raises(ValueError, match=message):
        import_dataset(tmp_path / "lr", tmp_path / "out", "unreal")


def test_unreal(tmp_path, raw):
    known = truth()
    moving = known.valid > 0.5
    write_unreal(tmp_path / "lr", known, moving)
    for t in range(4):
        write(tmp_path / "hr" / f"shot_010.{t:04d}.exr", rgb(known.reference[t]))
    report = import_dataset(tmp_path / "lr", tmp_path / "out", "unreal", recipe=raw, reference=tmp_path / "hr")
    got = imported(report, "shot_010")
    validate_sequence(got, "shot_010", ("base_color", "normal"))
    for t in range(1, 4):
        expected = np.where(moving[t], known.frames.motion[t], static_motion(t, known.frames.gbuffers.depth[t]))
        np.testing.assert_allclose(got.frames.motion[t], expected, atol=3e-4)
    for name in ("base_color", "normal", "depth"):
        assert_like(getattr(got.frames.gbuffers, name), getattr(known.frames.gbuffers, name), name, atol=1e-3)
    assert_like(got.reference, known.reference, "reference")
    assert report.totals["unwritten"] == (~moving).sum() and got.frames.gbuffers.roughness is None


def test_unreal_device_depth_by_a_recipe_of_four_lines(tmp_path):
    """Reversed-Z with an infinite far plane: near / z, near = 10 cm; the sky is 0."""
    known = truth(T=2)
    device = 10.0 / (known.frames.gbuffers.depth * CM)
    write_unreal(tmp_path / "lr", known, depth=device)
    (tmp_path / "my.toml").write_text('[depth]\nkind = "reversed"\nnear = 10\n')
    report = import_dataset(tmp_path / "lr", tmp_path / "out", "unreal", recipe=tmp_path / "my.toml")
    assert_like(imported(report, "shot_010").frames.gbuffers.depth, known.frames.gbuffers.depth, "depth", rtol=1e-5)
    assert report.sequence.source["depth"]["kind"] == "reversed"


def test_unreal_without_cameras_says_what_to_do(tmp_path, raw):
    known = truth(T=2)
    write_unreal(tmp_path / "lr", known, known.valid > 0.5, header=False)
    with pytest.raises(
        ValueError, match=r"frame 1: .*shot_010\.0001\.exr: \d+ pixels have no velocity.*write velocity"
    ):
        import_dataset(tmp_path / "lr", tmp_path / "out", "unreal", recipe=raw)


def test_unreal_rotator_by_hand():
    """Yaw 90 looks along Unreal's +Y, which is essjax's -y; the position is in metres with y mirrored."""
    matrix = camera_to_world((100.0, 200.0, 50.0), 0.0, 90.0, 0.0)
    np.testing.assert_allclose(-matrix[:3, 2], [0, -1, 0], atol=1e-12)  # forward
    np.testing.assert_allclose(matrix[:3, 0], [-1, 0, 0], atol=1e-12)  # right was +Y, is -X
    np.testing.assert_allclose(matrix[:3, 3], [1, -2, 0.5])
    np.testing.assert_allclose(-camera_to_world((0, 0, 0), 90.0, 0.0, 0.0)[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(camera_to_world((0, 0, 0), 0.0, 0.0, 90.0)[:3, 0], [0, 0, -1], atol=1e-12)
    matrix = camera_to_world((1, 2, 3), 20.0, -50.0, 70.0)[:3, :3]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def write_arm(folder, known, name="0007", *, reverse=True, far=-1.0, near=0.25, cut_at=None, **changes):
    """UV, current - previous, y down; near / z, or 1 - near / z; jitter in fractions of the frame's size."""
    frames, depth = known.frames, known.frames.gbuffers.depth
    records = []
    for t in range(len(frames.cut)):
        device = near / depth[t] if far < 0 else near * (far / depth[t] - 1) / (far - near)
        device = np.where(np.isinf(depth[t]), 0.0, device)
        here = f"{name}/{t:04d}.exr"
        write(folder / "x2/color" / here, rgb(frames.color[t]))
        write(folder / "x2/depth" / here, {"R": (device if reverse else 1 - device)[..., 0]})
        write(folder / "x2/motion" / here, rgb(-frames.motion[t] / SIZE))
        write(folder / "ground_truth" / here, rgb(known.reference[t]))
        x, y = frames.jitter[t] / SIZE
        records.append(
            {
                "Frame": t, "CameraNearPlane": near, "CameraFarPlane": far, "Exposure": 1.5 + t,
                "CameraCut": t == cut_at,
                "NormalizedPerRatioJitter": [{"X": 0.4 / W, "Y": 0.4 / H}, {"X": float(x), "Y": float(y)}],
            }
        )  # fmt: skip
    content = {"ReverseZ": reverse, "UpscalingRatiosIndices": {"x1_5_index": 0, "x2_index": 1}, "Frames": records}
    content |= {"TargetResolution": {"X": 2 * W, "Y": 2 * H}, **changes}
    (folder / f"{name}.json").write_text(json.dumps(content))


@pytest.mark.parametrize(("reverse", "far"), [(True, -1.0), (False, -1.0), (True, 40.0)])
def test_arm_nss(tmp_path, reverse, far):
    known, other = truth(), truth(seed=5)
    write_arm(tmp_path / "dump", known, reverse=reverse, far=far, cut_at=2)
    write_arm(tmp_path / "dump", other, "0008", reverse=reverse, far=far)
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    assert report.sequence.channels == ("color", "depth", "motion")
    for name, expected in (("0007", known), ("0008", other)):
        got = imported(report, name)
        validate_sequence(got, name)
        assert_like(got.frames.motion, expected.frames.motion, "motion")
        assert_like(got.frames.jitter, expected.frames.jitter, "jitter")
        assert_like(got.frames.gbuffers.depth, expected.frames.gbuffers.depth, "depth", rtol=1e-3)
        assert_like(got.frames.color, expected.frames.color, "color")
        assert_like(got.reference, expected.reference, "reference")
        np.testing.assert_allclose(got.frames.exposure, [1.5, 2.5, 3.5, 4.5])
    np.testing.assert_array_equal(imported(report, "0007").frames.cut, [True, False, True, False])
    assert report.dataset.splits == {"test": (("0007", 0, 3, 0), ("0008", 0, 3, 0))}


def test_arm_without_an_exposure(tmp_path):
    write_arm(tmp_path / "dump", truth())
    path = next((tmp_path / "dump").rglob("0007.json"))
    content = json.loads(path.read_text())
    for record in content["Frames"]:
        del record["Exposure"]
    path.write_text(json.dumps(content))
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    assert imported(report, "0007").frames.exposure is None


@pytest.mark.parametrize(("ratio", "index"), [(1.5, 0), (2, 1)])
def test_arm_jitter_of_the_frames_ratio(tmp_path, ratio, index):
    """The target's width says which ratio it is; and dilated motion is recorded."""
    size = {"X": round(ratio * W), "Y": round(ratio * H)}
    known = truth(T=2)
    write_arm(tmp_path / "dump", known, TargetResolution=size, MotionVectorsDilated=True)
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    expected = known.frames.jitter if index else np.full((2, 2), 0.4)
    assert_like(imported(report, "0007").frames.jitter, expected, "jitter")
    assert report.sequence.source["motion"]["dilated"] is True


def test_arm_with_one_ratio_needs_no_index(tmp_path):
    known = truth(T=2)
    write_arm(tmp_path / "dump", known)
    path = tmp_path / "dump" / "0007.json"
    content = json.loads(path.read_text())
    del content["UpscalingRatiosIndices"]
    for record in content["Frames"]:
        record["NormalizedPerRatioJitter"] = record["NormalizedPerRatioJitter"][1:]
    path.write_text(json.dumps(content))
    report = import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    assert_like(imported(report, "0007").frames.jitter, known.frames.jitter, "jitter")
    assert report.sequence.source["motion"]["dilated"] is False


def test_arm_errors(tmp_path):
    write_arm(tmp_path / "dump", truth(T=2), GTColorSpace="sRGB")
    with pytest.raises(ValueError, match=r"0007\.json: expected GTColorSpace Linear, got 'sRGB'"):
        import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    write_arm(tmp_path / "dump", truth(T=2), UpscalingRatiosIndices={"x1_5_index": 0})
    with pytest.raises(ValueError, match=r"0007\.json: UpscalingRatiosIndices has x1_5_index, but the target is 2 "):
        import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    write_arm(tmp_path / "dump", truth(T=2), TargetResolution=None)
    with pytest.raises(ValueError, match=r"0007\.json: expected TargetResolution and UpscalingRatiosIndices"):
        import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    write_arm(tmp_path / "dump", truth(T=2), UpscalingRatiosIndices=None)
    with pytest.raises(ValueError, match=r"frame 0: .*2 entries of NormalizedPerRatioJitter, and no UpscalingRatiosIn"):
        import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
    write_arm(tmp_path / "dump", truth(T=3))
    content = json.loads((tmp_path / "dump" / "0007.json").read_text())
    (tmp_path / "dump" / "0007.json").write_text(json.dumps({**content, "Frames": content["Frames"][:2]}))
    with pytest.raises(ValueError, match=r"frame 2: .*0007\.json: frame 2 is not listed there \(2 frames are\)"):
        import_dataset(tmp_path / "dump", tmp_path / "out", "arm-nss")
