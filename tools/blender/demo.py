"""A small scene to try the renderer on: objects and camera move over a textured ground; all kinds of materials."""

import math

import bpy

LAST = 64


def _material(name, color, roughness=0.5, metallic=0.0):
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    return material


def _textured(name, kind, scale, first, second, output="Color"):
    """Make a Principled material whose base colour is a procedural texture of the object's coordinates."""
    material = _material(name, first)
    tree = material.node_tree
    coordinates, texture = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new(kind)
    texture.inputs["Scale"].default_value = scale
    if kind == "ShaderNodeTexChecker":
        texture.inputs["Color1"].default_value = (*first, 1.0)
        texture.inputs["Color2"].default_value = (*second, 1.0)
    tree.links.new(coordinates.outputs["Object"], texture.inputs["Vector"])
    tree.links.new(texture.outputs[output], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return material


def _mixed(name):
    """Two shaders mixed: the AOVs take the Principled one."""
    material = _material(name, (0.1, 0.5, 0.15), 0.4)
    tree = material.node_tree
    mix, glossy = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfGlossy")
    mix.inputs["Fac"].default_value = 0.2
    tree.links.new(glossy.outputs["BSDF"], mix.inputs[2])
    tree.links.new(tree.nodes["Principled BSDF"].outputs["BSDF"], mix.inputs[1])
    tree.links.new(mix.outputs["Shader"], tree.nodes["Material Output"].inputs["Surface"])
    return material


def _lamp(name):
    material = _material(name, (0.0, 0.0, 0.0))
    tree = material.node_tree
    emission = tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value, emission.inputs["Strength"].default_value = (1.0, 0.6, 0.2, 1.0), 4.0
    tree.links.new(emission.outputs["Emission"], tree.nodes["Material Output"].inputs["Surface"])
    return material


def _add(operator, name, material, location, **options):
    operator(location=location, **options)
    thing = bpy.context.object
    thing.name = name
    if material:
        thing.data.materials.append(material)
    return thing


def animate(thing, path, first, last, frames=LAST):
    """From one value at frame 0 to another at the last, evenly. A key per frame needs no interpolation modes."""
    for frame in range(frames + 1):
        setattr(thing, path, tuple(a + (b - a) * frame / frames for a, b in zip(first, last, strict=True)))
        thing.keyframe_insert(path, frame=frame)


def _objects():
    mesh = bpy.ops.mesh
    _add(
        mesh.primitive_plane_add,
        "ground",
        _textured("tiles", "ShaderNodeTexChecker", 4.0, (0.7, 0.6, 0.45), (0.12, 0.16, 0.2)),
        (0, 0, 0),
        size=24,
    )
    _add(
        mesh.primitive_cube_add,
        "wall",
        _textured("bricks", "ShaderNodeTexChecker", 1.5, (0.5, 0.15, 0.08), (0.8, 0.5, 0.35)),
        (0, 4, 1),
        size=2,
    ).scale = (4, 0.2, 1)
    for i in range(7):
        _add(
            mesh.primitive_cylinder_add,
            f"pole {i}",
            _material(f"pole {i}", (0.8, 0.1 + 0.1 * i, 0.1)),
            (-3 + i, 2.5, 0.6),
            radius=0.04,
            depth=1.2,
        )
    torus = _add(
        mesh.primitive_torus_add,
        "torus",
        _material("copper", (0.9, 0.5, 0.3), 0.25, 1.0),
        (1.6, 0.4, 0.8),
        major_radius=0.6,
        minor_radius=0.2,
    )
    box = _add(
        mesh.primitive_cube_add,
        "box",
        _textured("stripes", "ShaderNodeTexNoise", 6.0, (0.2, 0.3, 0.8), (0, 0, 0)),
        (-1.8, 0.3, 0.5),
        size=1,
    )
    ball = _add(
        mesh.primitive_uv_sphere_add,
        "ball",
        _textured("spots", "ShaderNodeTexVoronoi", 5.0, (0.8, 0.7, 0.1), (0, 0, 0)),
        (0, -0.5, 0.5),
        radius=0.5,
        segments=48,
        ring_count=24,
    )
    _add(mesh.primitive_monkey_add, "bare", None, (0.0, 1.8, 0.8), size=1.2)
    _add(mesh.primitive_cone_add, "cone", _mixed("glossy green"), (3.0, 1.5, 0.6), radius1=0.5, depth=1.2)
    _add(mesh.primitive_ico_sphere_add, "lamp", _lamp("lamp"), (-3.2, 1.0, 1.4), radius=0.25, subdivisions=3)
    for name in ("bare", "ball", "torus"):
        for polygon in bpy.data.objects[name].data.polygons:
            polygon.use_smooth = True
    animate(ball, "location", (-2.2, -1.0, 0.5), (2.6, -0.2, 0.5))
    animate(ball, "rotation_euler", (0, 0, 0), (0, 5, 0))
    animate(box, "rotation_euler", (0, 0, 0.2), (0, 0, 3.0))
    animate(torus, "rotation_euler", (1.2, 0, 0), (1.2, 2.0, 2.0))


def _light():
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.3, 0.4))
    bpy.context.object.data.energy, bpy.context.object.data.angle = 3.0, 0.05
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    gradient, mapping = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeTexCoord")
    gradient.inputs["Scale"].default_value = 4.0
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (0.2, 0.4, 0.8, 1), (0.9, 0.95, 1.0, 1)
    tree.links.new(mapping.outputs["Generated"], gradient.inputs["Vector"])
    tree.links.new(gradient.outputs[0], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], tree.nodes["Background"].inputs["Color"])


def _camera():
    bpy.ops.object.camera_add(rotation=(math.radians(78), 0, 0))
    camera = bpy.context.object
    camera.data.lens = 28.0
    animate(camera, "location", (-2.0, -6.0, 1.7), (3.5, -5.0, 2.6))
    animate(camera, "rotation_euler", (math.radians(79), 0, -0.3), (math.radians(72), 0.1, 0.6))
    bpy.context.scene.camera = camera


def make_scene() -> None:
    """Replace what is open by the demo."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, LAST
    _objects()
    _light()
    _camera()
