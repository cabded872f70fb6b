"""Render a clip for ``essjax import SRC OUT --preset blender``: jittered LR images with G-buffers, and references.

In Blender:  blender -b scene.blend -P tools/blender/render_essjax.py -- --out clip --size 480x270 --frames 1:64
With bpy:    python tools/blender/render_essjax.py --scene scene.glb --out clip --size 480x270 --frames 1:64
To try it:   python tools/blender/render_essjax.py --demo --out clip --size 96x54 --frames 1:8

Interrupted renders are resumed: frames that are there are kept. See README.md beside this file.
"""

import argparse
import math
import os
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
import clip  # noqa: E402
import demo  # noqa: E402
import materials  # noqa: E402

LR_FILTER = 0.01
"""Pixels: Cycles' smallest. All samples of a pixel lie at one position."""
CIRCLE = 720
"""Frames that the camera takes around a glTF scene that has none."""


def parse_args() -> argparse.Namespace:
    """Parse what stands after ``--`` in Blender, all arguments with bpy."""
    in_blender = bool(bpy.app.binary_path)  # empty with bpy
    argv = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else ([] if in_blender else sys.argv[1:])
    parser = argparse.ArgumentParser(prog="render_essjax.py", description=__doc__.split("\n", 1)[0])
    parser.add_argument("--out", required=True, type=Path, help="folder of the clip")
    parser.add_argument("--scene", type=Path, help=".blend, .glb or .gltf; without it the file that Blender has open")
    parser.add_argument("--demo", action="store_true", help="render a built-in scene instead")
    parser.add_argument("--size", default="480x270", help="WIDTHxHEIGHT of the LR images")
    parser.add_argument("--scale", type=clip.ratio, default=2, help="size of the reference / LR size")
    parser.add_argument("--frames", help="FIRST:LAST, both included; without it the scene's")
    parser.add_argument("--camera", help="name of the camera; without it the scene's")
    parser.add_argument(
        "--lr-samples", type=clip.positive, default=8, help="shading samples of a LR pixel, at one position"
    )
    parser.add_argument(
        "--hr-samples", type=clip.positive, default=64, help="samples of a reference pixel, all over it"
    )
    parser.add_argument("--cycles-device", help="CPU, CUDA, OPTIX, HIP, ONEAPI or METAL; Cycles itself reads this")
    return parser.parse_args(argv)


def open_scene(args: argparse.Namespace) -> str:
    """Load what was asked for; returns its name."""
    if args.demo:
        demo.make_scene()
        return "demo"
    if args.scene is None:
        if not bpy.data.filepath:
            raise ValueError("no scene: give --scene FILE, or --demo, or open a .blend with blender -b FILE -P ...")
        return Path(bpy.data.filepath).name
    if not args.scene.is_file():
        raise ValueError(f"{args.scene}: expected a .blend, .glb or .gltf file, found nothing.")
    if args.scene.suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(args.scene.resolve()))
    elif args.scene.suffix in (".glb", ".gltf"):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.import_scene.gltf(filepath=str(args.scene.resolve()))
        add_what_gltf_lacks()
    else:
        raise ValueError(f"{args.scene}: expected a .blend, .glb or .gltf file.")
    return args.scene.name


def add_what_gltf_lacks() -> None:
    """Add a sky if there is no light, and a camera that circles the scene if there is none."""
    scene = bpy.context.scene
    kinds = {thing.type for thing in scene.objects}
    if "LIGHT" not in kinds:
        scene.world = bpy.data.worlds.new("sky")
        scene.world.use_nodes = True
        scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        print("essjax: no light in the file: added a white sky")
    if "CAMERA" not in kinds:
        add_circling_camera([thing for thing in scene.objects if thing.type == "MESH"])
        print("essjax: no camera in the file: added one that circles the scene, half a degree per frame")


def add_circling_camera(objects: list) -> None:
    """Around the objects' bounding box, looking at its centre from a little above."""
    from mathutils import Vector

    corners = [thing.matrix_world @ Vector(corner) for thing in objects for corner in thing.bound_box]
    low, high = (Vector(pick(c[i] for c in corners) for i in range(3)) for pick in (min, max))
    pivot = bpy.data.objects.new("essjax pivot", None)
    camera = bpy.data.objects.new("essjax camera", bpy.data.cameras.new("essjax camera"))
    for thing in (pivot, camera):
        bpy.context.scene.collection.objects.link(thing)
    radius = (high - low).length / 2
    camera.parent, pivot.location = pivot, (low + high) / 2
    camera.location, camera.rotation_euler = (0.0, -2.6 * radius, 0.8 * radius), (math.radians(73), 0.0, 0.0)
    camera.data.clip_start, camera.data.clip_end = 0.01 * radius, 100 * radius
    demo.animate(pivot, "rotation_euler", (0.0, 0.0, 0.0), (0.0, 0.0, math.radians(CIRCLE / 2)), CIRCLE)
    bpy.context.scene.camera = camera


def choose_camera(name: str | None):
    """Choose the camera, checked to be one that meta.json can describe."""
    scene = bpy.context.scene
    cameras = {thing.name: thing for thing in scene.objects if thing.type == "CAMERA"}
    default = scene.camera or (next(iter(cameras.values())) if len(cameras) == 1 else None)
    camera = cameras.get(name) if name else default
    if camera is None:
        names = ", ".join(sorted(cameras)) or "none"
        raise ValueError(f"--camera: expected one of the scene's ({names}), got {name or 'no active camera'}.")
    if camera.data.type != "PERSP":
        raise ValueError(f"camera {camera.name}: expected a perspective camera, got {camera.data.type}.")
    scene.camera = camera
    for marker in scene.timeline_markers:
        marker.camera = None  # a marker would switch cameras in the middle of the clip
    return camera


def prepare(scene, layer) -> None:
    """Set both renders up: nothing that moves samples, blurs, or works on the finished picture."""
    render = scene.render
    render.engine, render.resolution_percentage = "CYCLES", 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    render.frame_map_old = render.frame_map_new = 100
    for name in ("use_border", "use_motion_blur", "use_compositing", "use_sequencer", "use_multiview", "use_freestyle"):
        setattr(render, name, False)
    render.film_transparent = False
    render.use_persistent_data = True  # else Cycles prepares the scene anew for every image, which takes seconds
    cycles = scene.cycles
    cycles.use_denoising = cycles.use_adaptive_sampling = cycles.use_sample_subset = cycles.use_animated_seed = False
    for other in scene.view_layers:
        other.use = other == layer
    layer.samples = 0  # those of the scene
    settings = render.image_settings
    if hasattr(settings, "media_type"):  # since Blender 5
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.exr_codec = "OPEN_EXR_MULTILAYER", "ZIP"
    for thing in bpy.data.cameras:
        thing.dof.use_dof = False


def number_objects(objects: list) -> None:
    """Object indices 1, 2, ... by name."""
    for index, thing in enumerate(sorted(objects, key=lambda thing: thing.name)):
        thing.pass_index = index + 1


def render_to(path: Path, scene, layer, *, size: tuple[int, int], samples: int, guides: bool) -> None:
    """Render the current frame; the file appears when it is complete."""
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.cycles.samples, scene.cycles.seed = samples, 2 * scene.frame_current + guides
    # Cycles takes a width of 1 pixel for BOX whatever is asked, so the LR images need another filter.
    scene.cycles.pixel_filter_type = "GAUSSIAN" if guides else "BOX"
    scene.cycles.filter_width = LR_FILTER
    scene.render.image_settings.color_depth = "32" if guides else "16"
    for name in ("z", "position", "normal", "vector", "object_index"):
        setattr(layer, f"use_pass_{name}", guides)
    temporary = path.with_name(f".{path.stem}.partial.exr")
    temporary.unlink(missing_ok=True)
    scene.render.filepath = str(temporary.resolve())
    bpy.ops.render.render(write_still=True, layer=layer.name, scene=scene.name)
    if not temporary.is_file():
        raise ValueError(f"{path}: Blender wrote no image. Is the disk full?")
    os.replace(temporary, path)


def describe(camera, size: tuple[int, int], jitter: tuple[float, float]) -> dict:
    """Describe the frame for meta.json."""
    data = camera.data
    sensor = clip.sensor_width(*size, data.sensor_fit, (data.sensor_width, data.sensor_height))
    matrix = camera.matrix_world.normalized()  # as Blender renders: without scale
    return {
        "jitter": list(jitter),
        "camera_to_world": [list(row) for row in matrix],
        "lens_mm": data.lens,
        "sensor_width_mm": sensor,
    }


def render_frame(folder: Path, frame: int, camera, layer, args: argparse.Namespace, size: tuple[int, int]) -> dict:
    """Both images of a frame, and its entry in meta.json."""
    scene = bpy.context.scene
    lr, hr = clip.image_paths(folder, frame)
    scene.frame_set(frame)
    if camera.data.shift_x or camera.data.shift_y:  # the scene's own, perhaps animated
        raise ValueError(f"camera {camera.name}: expected no lens shift, got one. Set Shift X and Y to 0.")
    jitter = clip.jitter(frame)
    # Set by hand, not animated: Cycles evaluates the neighbouring frames for the motion, and must find the same shift.
    camera.data.shift_x, camera.data.shift_y = clip.camera_shift(jitter, *size, camera.data.sensor_fit)
    render_to(lr, scene, layer, size=size, samples=args.lr_samples, guides=True)
    camera.data.shift_x = camera.data.shift_y = 0.0
    large = clip.enlarged(size, args.scale)
    render_to(hr, scene, layer, size=large, samples=args.hr_samples, guides=False)
    return describe(camera, size, jitter)


def main() -> None:
    """Command line."""
    args = parse_args()
    size, frames = clip.parse_size(args.size), clip.parse_frames(args.frames) if args.frames else None
    name = open_scene(args)
    scene, layer = bpy.context.scene, next(layer for layer in bpy.context.scene.view_layers if layer.use)
    frames = frames or range(scene.frame_start, scene.frame_end + 1)
    camera = choose_camera(args.camera)
    prepare(scene, layer)
    objects = [thing for thing in bpy.data.objects if thing.type in {"MESH", "CURVE", "SURFACE", "META", "FONT"}]
    number_objects(objects)
    guessed = materials.add_aovs(layer, objects)
    if guessed:
        print(f"essjax: no shader to take base colour from, used the viewport's colour: {', '.join(guessed)}")
    args.out.mkdir(parents=True, exist_ok=True)
    source = {"scene": name, "camera": camera.name, "lr_samples": args.lr_samples, "hr_samples": args.hr_samples}
    meta = clip.open_meta(args.out / "meta.json", size, args.scale, source)
    for done, frame in enumerate(frames):
        start = time.monotonic()
        kept = clip.is_done(args.out, meta, frame)
        if not kept:
            clip.add_frame(
                args.out / "meta.json", meta, frame, render_frame(args.out, frame, camera, layer, args, size)
            )
        seconds = "was there" if kept else f"{time.monotonic() - start:.1f} s"
        print(f"essjax: frame {frame} ({done + 1}/{len(frames)}) {seconds}", flush=True)
    print(f"essjax: done. Next: essjax import {args.out} DATASET --preset blender")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, RuntimeError, OSError) as error:  # Blender would go on, and exit with 0
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
