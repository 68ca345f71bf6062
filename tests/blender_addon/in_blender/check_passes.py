# SPDX-License-Identifier: GPL-3.0-or-later
"""Fused passes and light groups, and the compositor nodes that build the beauty from them again."""

import shutil

import bpy
from check_button import composite
from support import BLENDER_5, WORK, build_scene, module, snapshot

PRODUCTS = [
    (f"{kind} {part}", f"{kind} Color")
    for kind in ("Diffuse", "Glossy", "Transmission")
    for part in ("Direct", "Indirect")
]
COMPONENTS = [*PRODUCTS, "Emission", "Volume Direct", "Volume Indirect"]


def check_passes():
    """Light groups and components that the Image node shows are fused, and rebuilt in the compositor.

    test_in_blender.py compares the files that are left here.
    """
    scene = _build()
    for film, environment in (("opaque", ["Environment"]), ("transparent", [])):
        scene.render.film_transparent = film == "transparent"
        image = _fuse(scene, f"{film}.exr")
        _rebuild(scene, image, [*COMPONENTS, *environment], f"{film}_components.exr")
        _rebuild(scene, image, ["Combined_key", "Combined_rest", "Combined_world"], f"{film}_light groups.exr")

    # A lamp in no group: its light is in no layer. Without the option, only the scene's own passes are on.
    bpy.data.objects["Light"].lightgroup = ""
    scene.msspl.components = False
    _fuse(scene, "remainder.exr")


def _fuse(scene, name):
    """Press the button, keep the file under this name, and return the Image node. The scene stays as it was."""
    before = snapshot(scene)
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert snapshot(scene) == before
    tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
    node = tree.nodes["MSSPL Fused"]
    shutil.copy(bpy.path.abspath(node.image.filepath), WORK / name)
    return node


def _build():
    """Build a scene of glass, metal and paint, with two lamps and a world that have a light group each."""
    scene = build_scene()
    scene.msspl.scale, scene.msspl.hr_spp, scene.msspl.lr_spp, scene.msspl.components = "2", 2, 8, True
    scene.render.use_persistent_data = True
    bpy.ops.render.render()  # Its persistent data must not hide the groups that follow.
    layer = scene.view_layers[0]
    for name in ("rest", "world"):
        layer.lightgroups.add(name=name)
    bpy.ops.object.light_add(type="AREA", location=(-3, -2, 3))
    lamp = bpy.context.object
    lamp.data.energy, lamp.data.color, lamp.lightgroup = 300, (1.0, 0.4, 0.2), "rest"
    bpy.data.objects["Light"].lightgroup, scene.world.lightgroup = "key", "world"
    for place, inputs in (((2, 0, 0), {"Transmission Weight": 1}), ((-2, 1, 0), {"Metallic": 1, "Roughness": 0.2})):
        bpy.ops.mesh.primitive_uv_sphere_add(location=place)
        material = bpy.data.materials.new("shiny")
        material.use_nodes = True
        shader = next(node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
        for name, value in inputs.items():
            shader.inputs[name].default_value = value
        bpy.context.object.data.materials.append(material)
    return scene


def _rebuild(scene, image, terms, name):
    """Connect the sum of outputs, or of products of two, to the compositor's output, and write it."""
    tree = image.id_data
    total = None
    for term in terms:
        value = (
            image.outputs[term] if isinstance(term, str) else _mix(tree, "MULTIPLY", *(image.outputs[t] for t in term))
        )
        total = _mix(tree, "ADD", total, value) if total else value
    output = module("compositor")._output(tree)
    tree.links.new(total, output.inputs[0])
    composite(scene, WORK / name)


def _mix(tree, blend, first, second):
    """Make a node that adds or multiplies two colours."""
    node = tree.nodes.new("ShaderNodeMix" if BLENDER_5 else "CompositorNodeMixRGB")
    if BLENDER_5:
        node.data_type = "RGBA"
    node.blend_type = blend
    factor, a, b = (0, 6, 7) if BLENDER_5 else (0, 1, 2)  # the sockets of colours follow those of other types
    node.inputs[factor].default_value = 1.0
    tree.links.new(first, node.inputs[a])
    tree.links.new(second, node.inputs[b])
    return node.outputs[2 if BLENDER_5 else 0]
