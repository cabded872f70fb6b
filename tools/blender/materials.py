"""Base colour, roughness and metallic of every material as AOVs: shader outputs that Cycles writes as passes."""

import bpy

AOVS = {"basecolor": "COLOR", "roughness": "VALUE", "metallic": "VALUE"}
INPUTS = {"basecolor": "Base Color", "roughness": "Roughness", "metallic": "Metallic"}
OTHERS = {
    "BSDF_DIFFUSE": ("Color", "Roughness", 0.0),
    "BSDF_GLOSSY": ("Color", "Roughness", 1.0),
    "BSDF_METALLIC": ("Base Color", "Roughness", 1.0),
}
"""Other shaders: the inputs for base colour and roughness, and how metallic they are."""


def _shader_inputs(node):
    return [socket for socket in node.inputs if socket.type == "SHADER" and socket.is_linked]


def find_shader(tree, socket):
    """Find the first Principled (or a shader of OTHERS) that feeds a socket, and its tree, or None; also in groups."""
    for link in socket.links:
        node = link.from_node
        if node.type == "BSDF_PRINCIPLED" or node.type in OTHERS:
            return tree, node
        if node.type == "GROUP" and node.node_tree:
            ends = [n for n in node.node_tree.nodes if n.type == "GROUP_OUTPUT" and n.is_active_output]
            inner = [s for end in ends for s in end.inputs if s.name == link.from_socket.name]
            found = [find_shader(node.node_tree, s) for s in inner]
        else:
            found = [find_shader(tree, s) for s in _shader_inputs(node)]
        found = [f for f in found if f]
        if found:
            return next((f for f in found if f[1].type == "BSDF_PRINCIPLED"), found[0])
    return None


def _values(material, node):
    """Per AOV, the shader's input socket, or a plain value where it has none."""
    if node is None:  # the colours that the viewport shows
        return {
            "basecolor": tuple(material.diffuse_color),
            "roughness": material.roughness,
            "metallic": material.metallic,
        }
    if node.type == "BSDF_PRINCIPLED":
        return {name: node.inputs[key] for name, key in INPUTS.items()}
    color, roughness, metallic = OTHERS[node.type]
    return {"basecolor": node.inputs[color], "roughness": node.inputs[roughness], "metallic": metallic}


def _is_emitter(tree, socket):
    return any(link.from_node.type == "EMISSION" for link in socket.links)


def _add_aov(tree, name, kind, value):
    node = tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = name
    socket = node.inputs["Color" if kind == "COLOR" else "Value"]
    if not isinstance(value, bpy.types.NodeSocket):
        socket.default_value = value
    elif value.is_linked:
        tree.links.new(value.links[0].from_socket, socket)
    else:
        socket.default_value = value.default_value


def add_aovs_to(material) -> bool:
    """Add the AOV outputs to a material; False if it had no shader to take them from."""
    if not material.node_tree:
        material.use_nodes = True  # before Blender 5
    tree = material.node_tree
    output = tree.get_output_node("CYCLES")
    surface = output.inputs["Surface"] if output else None
    found = find_shader(tree, surface) if surface else None
    target, node = found or (tree, None)
    values = _values(material, node)
    if node is None and surface and _is_emitter(tree, surface):
        values = {"basecolor": (0.0, 0.0, 0.0, 1.0), "roughness": 1.0, "metallic": 0.0}  # a light reflects nothing
        node = surface
    if not any(n.type == "OUTPUT_AOV" and n.aov_name in AOVS for n in target.nodes):  # a group may be shared
        for name, kind in AOVS.items():
            _add_aov(target, name, kind, values[name])
    return node is not None


def _give_material_to_bare(objects):
    """Cycles draws objects without a material as grey; the AOVs need a material that says so."""
    bare = bpy.data.materials.new("essjax default")
    bare.use_nodes = True
    for thing in objects:
        if not thing.material_slots and thing.data and hasattr(thing.data, "materials"):
            thing.data.materials.append(bare)
        for slot in thing.material_slots:
            if slot.material is None:
                slot.material = bare


def add_aovs(layer, objects) -> list[str]:
    """Add the AOVs to the view layer and to all materials; returns names of materials that had to be guessed."""
    for name, kind in AOVS.items():
        aov = layer.aovs.get(name) or layer.aovs.add()
        aov.name, aov.type = name, kind
    _give_material_to_bare(objects)
    used = {slot.material for thing in objects for slot in thing.material_slots if slot.material}
    return sorted(material.name for material in used if not add_aovs_to(material))
