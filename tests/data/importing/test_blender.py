"""Import of Blender clips: a tiny dump with known answers, and a real clip where there is one."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from essjax import warp
from essjax.data import import_dataset, read_dataset, read_segment, read_sequence
from essjax.data.importing.splits import default_splits
from essjax.frames import select_time, validate_sequence

W, H, FIRST, LAST = 20, 12, 8, 13
LENS, SENSOR = 30.0, 36.0
FOCAL = LENS / SENSOR * W
OWN_MOTION = np.array([1.5, -0.5])  # (x right, y down) of object 7, besides the camera's
CHESS = Path(__file__).parents[4] / "shared" / "data" / "chess_blender"


def camera_to_world(number):
    """Turns about y and moves along x."""
    angle = 0.01 * number
    matrix = np.eye(4)
    matrix[0, 0], matrix[0, 2], matrix[2, 0], matrix[2, 2] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    matrix[0, 3] = 0.05 * number
    return matrix


def jitter(number):
    return [0.25, -0.4] if (number // 2) % 2 else [-0.125, 0.3]


def pixels(number):
    y, x = np.mgrid[:H, :W] + 0.5
    return x + jitter(number)[0], y + jitter(number)[1]


def rays(number):
    """World directions through the samples, -Z = 1, written out by hand."""
    x, y = pixels(number)
    local = np.stack([(x - W / 2) / FOCAL, -(y - H / 2) / FOCAL, -np.ones_like(x)], -1)
    return local @ camera_to_world(number)[:3, :3].T


def project(number, world):
    local = (world - camera_to_world(number)[:3, 3]) @ camera_to_world(number)[:3, :3]
    return np.stack(
        [W / 2 + FOCAL * local[..., 0] / -local[..., 2], H / 2 - FOCAL * local[..., 1] / -local[..., 2]], -1
    )


def wall(number):
    """Where the rays meet the plane z = -5, and the depth of that."""
    origin, direction = camera_to_world(number)[:3, 3], rays(number)
    t = (-5.0 - origin[2]) / direction[..., 2]
    return origin + direction * t[..., None], t


def regions():
    """Background: the top three rows. Object 7, moving: a block. Object 3, static: a block. Else no index."""
    background = np.zeros((H, W), bool)
    background[:3] = True
    index = np.zeros((H, W))
    index[5:10, 4:10] = 7
    index[5:10, 12:17] = 3
    return background, index


def raw_frame(number):
    """Channels as Blender writes them: y up, 1e10, averaged passes."""
    background, index = regions()
    position, depth = wall(number)
    motion = project(number - 1, position) - np.stack(pixels(number), -1)
    motion[index == 7] += OWN_MOTION
    normal = np.tile([0.0, 0.6, 0.8], (H, W, 1))
    motion[background] = (9.0, 9.0)  # garbage from silhouettes
    normal[background] = (0.1, 0.0, 0.0)
    normal[4, 10] *= 0.5  # a mixed silhouette pixel of the wall
    motion[4, 10] *= 0.5
    base = np.full((H, W, 3), (0.2, 0.4, 1.0001))
    base[11, 19] = -0.25
    color = np.tile([1.0, 2.0, 3.0], (H, W, 1))
    color[6, 6, 1] = -0.01
    index = np.where(background, 5, index)  # a stray index on the sky
    return {
        "Combined.RGBA": np.concatenate([color, np.ones((H, W, 1))], -1),
        "Depth.Z": np.where(background, 1e10, depth)[..., None],
        "Position.XYZ": np.where(background[..., None], 3.0, position),
        "Normal.XYZ": normal,
        "Vector.XYZW": np.stack([motion[..., 0], -motion[..., 1], 5 + motion[..., 0], 6 + motion[..., 1]], -1),
        "Object Index.X": index[..., None],
        "basecolor.RGB": base,
        "roughness.X": np.full((H, W, 1), 0.7),
        "metallic.X": np.full((H, W, 1), 1.000001),
    }


def write_parts(path, passes):
    """One part per pass, as Blender does."""
    parts = []
    for key, image in passes.items():
        name, suffixes = key.rsplit(".", 1)
        channels = {
            f"ViewLayer.{name}.{suffix}": np.ascontiguousarray(image[..., i], np.float32)
            for i, suffix in enumerate(suffixes)
        }
        parts.append(OpenEXR.Part({}, channels, f"ViewLayer.{name}"))
    OpenEXR.File(parts).write(str(path))


def write_dump(folder, numbers=range(FIRST, LAST + 1), leave_out=()):
    folder.mkdir()
    for number in numbers:
        passes = {key: image for key, image in raw_frame(number).items() if key not in leave_out}
        write_parts(folder / f"lr.{number:04d}.exr", passes)
        write_parts(folder / f"hr.{number:04d}.exr", {"Combined.RGB": np.full((2 * H, 2 * W, 3), 0.1 * number)})
    frames = {
        str(n): {
            "jitter": jitter(n),
            "camera_to_world": camera_to_world(n).tolist(),
            "lens_mm": LENS,
            "sensor_width_mm": SENSOR,
        }
        for n in numbers
    }
    meta = {"render_size": [W, H], "display_size": [2 * W, 2 * H], "frames": frames}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.fixture
def dump(tmp_path):
    return write_dump(tmp_path / "clip")


def test_everything_is_converted(dump, tmp_path):
    report = import_dataset(dump, tmp_path / "out", "blender")
    sequence = read_sequence(report.dataset, "clip")
    validate_sequence(sequence, "clip", ("world_position", "stencil", "roughness", "metallic", "n_dot_v"))
    frames, buffers = sequence.frames, sequence.frames.gbuffers
    background, index = regions()
    assert report.sequence.numbers == tuple(range(FIRST, LAST + 1)) and sequence.scale == 2
    np.testing.assert_array_equal(np.isinf(buffers.depth[..., 0]), np.tile(background, (6, 1, 1)))
    np.testing.assert_array_equal(frames.jitter, np.float32([jitter(n) for n in range(FIRST, LAST + 1)]))
    np.testing.assert_array_equal(frames.cut, [True] + 5 * [False])
    for image in (buffers.base_color, buffers.normal, buffers.world_position, buffers.roughness, buffers.n_dot_v):
        assert not image[:, background].any()
    np.testing.assert_array_equal(buffers.stencil[..., 0], np.tile(np.where(index == 7, 7, 0), (6, 1, 1)))
    np.testing.assert_allclose(buffers.normal[:, 3:], np.broadcast_to([0, 0.6, 0.8], (6, 9, W, 3)), atol=5e-4)
    np.testing.assert_allclose(buffers.base_color[0, 5, 5], [0.2, 0.4, 1.0], atol=5e-4)
    assert (buffers.base_color[:, 11, 19] == 0).all() and buffers.metallic.max() == 1
    np.testing.assert_array_equal(frames.color[0, 6, 6], [1, 0, 3])
    np.testing.assert_allclose(sequence.reference[2], np.full((2 * H, 2 * W, 3), 1.0), atol=5e-4)
    assert frames.exposure is None  # Blender's files do not say it
    assert report.dynamic == (7,)
    assert report.totals == {"pixels": 6 * W * H, "background": 6 * 3 * W, "mixed": 6, "negative": 6, "clamped": 0}


def test_motion_is_previous_minus_current_with_y_down(dump, tmp_path):
    """Oracles: the plane projected by hand for surfaces, directions turned by hand for the sky."""
    sequence = read_sequence(import_dataset(dump, tmp_path / "out", "blender").dataset, "clip")
    background, index = regions()
    for t, number in enumerate(range(FIRST, LAST + 1)):
        if t == 0:
            continue  # its predecessor is not in the clip: no camera, no sky motion
        here = np.stack(pixels(number), -1)
        expected = project(number - 1, wall(number)[0]) - here
        expected[index == 7] += OWN_MOTION
        far = camera_to_world(number - 1)[:3, 3] + rays(number)
        expected[background] = (project(number - 1, far) - here)[background]
        np.testing.assert_allclose(sequence.frames.motion[t], expected, atol=2e-4)


def test_cameras_see_positions_at_the_jittered_samples(dump, tmp_path):
    sequence = read_sequence(import_dataset(dump, tmp_path / "out", "blender").dataset, "clip")
    camera = sequence.frames.camera
    np.testing.assert_allclose(camera.focal, np.full((6, 2), FOCAL), rtol=1e-6)
    np.testing.assert_array_equal(camera.center, np.tile([W / 2, H / 2], (6, 1)))
    np.testing.assert_allclose(camera.camera_to_world[3], camera_to_world(FIRST + 3), atol=1e-6)
    position, _ = wall(FIRST + 3)
    np.testing.assert_allclose(sequence.frames.gbuffers.world_position[3, 3:], position[3:], atol=1e-5)
    to_camera = camera_to_world(FIRST + 3)[:3, 3] - position
    cosine = (to_camera @ [0.0, 0.6, 0.8]) / np.linalg.norm(to_camera, axis=-1)
    np.testing.assert_allclose(sequence.frames.gbuffers.n_dot_v[3, 3:, :, 0], cosine[3:].clip(0, 1), atol=1e-3)


def test_optional_passes(dump, tmp_path):
    """Without Position it follows from depth; without Object Index there is no stencil."""
    missing = ("Position.XYZ", "Object Index.X", "roughness.X", "metallic.X")
    bare = write_dump(tmp_path / "bare", leave_out=missing)
    sequence = read_sequence(import_dataset(bare, tmp_path / "out", "blender").dataset, "bare")
    buffers = sequence.frames.gbuffers
    assert buffers.stencil is None and buffers.roughness is None and buffers.metallic is None
    np.testing.assert_allclose(buffers.world_position[2, 3:], wall(FIRST + 2)[0][3:], atol=1e-5)


def test_moving_objects_without_an_index_get_a_new_id(dump, tmp_path):
    for number in range(FIRST, LAST + 1):
        passes = raw_frame(number)
        passes["Object Index.X"] = np.where(passes["Object Index.X"] == 7, 0.0, 3.0)
        write_parts(dump / f"lr.{number:04d}.exr", passes)
    report = import_dataset(dump, tmp_path / "out", "blender")
    stencil = read_sequence(report.dataset, "clip").frames.gbuffers.stencil
    assert report.dynamic == (0,)
    np.testing.assert_array_equal(stencil[0, ..., 0], np.where(regions()[1] == 7, 1, 0))


def test_splits(dump, tmp_path):
    assert default_splits(8, 27) == {"train": (8, 19), "validation": (20, 21), "test": (22, 27)}
    assert default_splits(0, 9) == {"train": (0, 5), "validation": (6, 6), "test": (7, 9)}
    assert default_splits(3, 7) == {"test": (3, 7)}
    ranges = {"train": (8, 10), "validation": (11, 11), "test": (12, 13)}
    report = import_dataset(dump, tmp_path / "out", "blender", splits=ranges, name="board")
    assert read_dataset(tmp_path / "out").splits == report.dataset.splits
    assert report.dataset.splits == {
        "train": (("board", 8, 10, 8),),
        "validation": (("board", 8, 11, 11),),
        "test": (("board", 8, 13, 12),),
    }
    assert read_segment(report.dataset, report.dataset.splits["test"][0]).frames.motion.shape[0] == 6


def test_an_interrupted_import_resumes_to_the_same_report(dump, tmp_path):
    def stop_after_two(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_dataset(dump, tmp_path / "out", "blender", on_frame=stop_after_two)
    with pytest.raises(ValueError, match=r"dataset\.json: not found"):
        read_dataset(tmp_path / "out")
    before = (tmp_path / "out" / "clip" / "lr.0009.exr").stat().st_mtime_ns
    resumed = import_dataset(dump, tmp_path / "out", "blender")
    assert (tmp_path / "out" / "clip" / "lr.0009.exr").stat().st_mtime_ns == before
    assert resumed.totals == import_dataset(dump, tmp_path / "fresh", "blender").totals


def test_a_gap_in_the_numbers_is_a_cut(tmp_path):
    folder = write_dump(tmp_path / "clip", numbers=[8, 9, 12, 13])
    with pytest.raises(ValueError, match=r"sequence clip: the frames 10\.\.11 are missing \(gaps in all: 1\)\. Render"):
        import_dataset(folder, tmp_path / "out", "blender")
    assert not (tmp_path / "out").exists()
    report = import_dataset(folder, tmp_path / "out", "blender", skip_broken=True)
    np.testing.assert_array_equal(read_sequence(report.dataset, "clip").frames.cut, [True, False, True, False])
    assert report.skipped == {"clip": {10: "the frames 10..11 are missing"}}
    every_tenth = write_dump(tmp_path / "sparse", numbers=[0, 10, 20])
    with pytest.raises(ValueError, match=r"sparse: expected frames that follow each other, got 0, 10, 20: every one"):
        import_dataset(every_tenth, tmp_path / "out", "blender", skip_broken=True)


def test_errors_name_the_file_and_what_to_do(dump, tmp_path):
    run = lambda: import_dataset(dump, tmp_path / "out", "blender")
    with pytest.raises(
        ValueError,
        match="preset: expected one of blender, unreal, extranet, arm-nss, arm-gym, stssnet, generic, got 'maya'",
    ):
        import_dataset(dump, tmp_path / "out", "maya")
    (dump / "hr.0010.exr").rename(dump / "gone.exr")
    with pytest.raises(
        ValueError, match=r"1 of the 12 images that meta\.json lists are missing, the first is hr\.0010"
    ):
        run()
    (dump / "gone.exr").rename(dump / "hr.0010.exr")
    write_parts(dump / "lr.0010.exr", {k: v for k, v in raw_frame(10).items() if not k.startswith("basecolor")})
    with pytest.raises(
        ValueError, match=r"lr\.0010\.exr: expected the channels basecolor\.R.*has the passes ViewLayer"
    ):
        run()
    write_parts(dump / "lr.0010.exr", {k: v[1:] for k, v in raw_frame(10).items()})
    with pytest.raises(ValueError, match=r"lr\.0010\.exr, channel .*: expected 20x12 as meta\.json says, got 20x11"):
        run()
    with pytest.raises(ValueError, match=r"test: expected first <= last within the frames 8\.\.13, got 12\.\.14"):
        import_dataset(
            dump, tmp_path / "out", "blender", splits={"train": (8, 10), "validation": (11, 11), "test": (12, 14)}
        )
    meta = json.loads((dump / "meta.json").read_text())
    (dump / "meta.json").write_text(json.dumps({**meta, "display_size": [10, 24]}))
    with pytest.raises(ValueError, match="expected display_size to be at least render_size, got 10x24 and 20x12"):
        run()
    for size in ([0, 0], [20.5, 12], [-20, 12]):
        (dump / "meta.json").write_text(json.dumps({**meta, "render_size": size}))
        with pytest.raises(ValueError, match=r"meta\.json: render_size: expected two whole numbers of pixels, above 0"):
            run()
    del meta["frames"]["9"]["lens_mm"]
    (dump / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(ValueError, match=r"meta\.json, frame 9: the field lens_mm is missing"):
        run()
    (dump / "meta.json").write_text(json.dumps({**meta, "frames": {}}))
    with pytest.raises(ValueError, match=r"meta\.json: expected at least one frame"):
        run()
    (dump / "meta.json").unlink()
    with pytest.raises(ValueError, match=r"meta\.json: not found\. The blender preset expects"):
        run()


def test_ambiguous_view_layers_are_refused(dump, tmp_path):
    passes = {**raw_frame(8), "Other.Depth.Z": np.ones((H, W, 1))}
    write_parts(dump / "lr.0008.exr", passes)
    with pytest.raises(ValueError, match=r"Depth\.Z is ambiguous: ViewLayer\.Depth\.Z, ViewLayer\.Other\.Depth\.Z"):
        import_dataset(dump, tmp_path / "out", "blender")


def psnr(a, b, mask):
    squared = (a / (1 + a) - b / (1 + b)) ** 2
    return -10 * np.log10((squared * mask).sum() / (3 * mask.sum()))


def inner(region, radius=2):
    """Pixels whose neighbourhood is of one kind: at silhouettes the reference's pixels mix surface and sky."""
    offsets = range(-radius, radius + 1)
    result = np.min([np.roll(region, (i, j), (0, 1)) for i in offsets for j in offsets], axis=0)
    result[:radius] = result[-radius:] = result[:, :radius] = result[:, -radius:] = False
    return result


def quality_by_motion(sequence, t):
    """PSNR of reference t-1 warped to t, for wrong and right signs of the motion, on valid surface and sky."""
    now, before = (select_time(sequence.frames, i) for i in (t, t - 1))
    jitters = {"jitter": now.jitter, "jitter_previous": before.jitter}
    valid = np.asarray(warp.hole_mask(now.gbuffers, before.gbuffers, now.motion, **jitters))
    surface = np.isfinite(now.gbuffers.depth)
    upsampled = warp.upsample_motion(now.motion, sequence.size, jitter=now.jitter)
    result = {}
    for name, sign in {"right": (1, 1), "none": (0, 0), "y flipped": (1, -1), "x flipped": (-1, 1)}.items():
        moved = np.asarray(warp.backward_warp(sequence.reference[t - 1], upsampled * np.float32(sign)))
        for region, kind in {"surface": surface, "sky": ~surface}.items():
            where = (valid * inner(kind)).repeat(2, 0).repeat(2, 1)
            result[region, name] = psnr(moved, sequence.reference[t], where)
    return result


@pytest.mark.skipif(not CHESS.is_dir(), reason="the path-traced chess clip is not here")
def test_a_real_clip(tmp_path):
    """Oracle: measured when the clip was made, surface 33.5 dB (no motion 26.7, y flipped 28.0), sky 42.9 (27.1)."""
    report = import_dataset(CHESS, tmp_path / "out", "blender")
    assert report.dynamic == (14,)  # the knight
    assert report.dataset.splits == {
        "train": (("chess_blender", 8, 19, 8),),
        "validation": (("chess_blender", 8, 21, 20),),
        "test": (("chess_blender", 8, 27, 22),),
    }
    sequence = read_sequence(report.dataset, "chess_blender", (14, 19))
    validate_sequence(sequence, "chess", ("world_position", "stencil", "roughness", "metallic", "n_dot_v"))
    assert sequence.reference.shape == (6, 272, 480, 3) and sequence.frames.motion.shape == (6, 136, 240, 2)
    measured = [quality_by_motion(sequence, t) for t in (2, 5)]
    mean = {key: np.mean([m[key] for m in measured]) for key in measured[0]}
    assert mean["surface", "right"] > 32.5 and mean["sky", "right"] > 40
    for region, margin in {"surface": 4, "sky": 1}.items():  # the sky moves sideways mostly
        assert mean[region, "right"] > 6 + mean[region, "none"]
        assert mean[region, "right"] > margin + mean[region, "y flipped"]
        assert mean[region, "right"] > 6 + mean[region, "x flipped"]
