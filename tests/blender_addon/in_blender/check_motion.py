# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of a moving camera and a moving cube, for the motion vectors that Cycles writes."""

import math

import bpy
from support import BLENDER_5, WORK


def render_motion():
    """Render two frames without and with motion blur. test_in_blender.py verifies their Vector pass."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=14)
    bpy.context.object.data.materials.append(_texture(4))
    bpy.ops.mesh.primitive_cube_add(size=1)
    cube = bpy.context.object
    cube.data.materials.append(_texture(6))
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 3, 1.5, (0.7, 0.3, 0)
    scene.collection.objects.link(sun)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    for frame, way in enumerate((0.0, 0.06, 0.15, 0.3), start=1):
        cube.location, cube.rotation_euler = (2 * way - 0.3, 0, 0.6), (0, 0, way)
        camera.location, camera.rotation_euler = (way, way - 5, 2 + way / 2), (math.radians(72), 0, way / 7)
        for moved in (cube, camera):
            moved.keyframe_insert("location", frame=frame)
            moved.keyframe_insert("rotation_euler", frame=frame)
    render, layer, image = scene.render, scene.view_layers[0], scene.render.image_settings
    render.engine, scene.cycles.samples = "CYCLES", 4
    render.resolution_x, render.resolution_y, render.resolution_percentage = 192, 128, 100
    layer.use_pass_vector = layer.use_pass_position = layer.use_pass_normal = layer.use_pass_z = True
    layer.cycles.denoising_store_passes = True
    if BLENDER_5:
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "motion.blend"))
    for name, render.use_motion_blur in (("sharp", False), ("blurred", True)):
        for frame in (2, 3):
            scene.frame_set(frame)
            scene.cycles.seed = frame
            render.filepath = str(WORK / f"{name}.{frame:04d}.exr")
            bpy.ops.render.render(write_still=True)
    render.use_motion_blur = False
    scene.cycles.samples, scene.cycles.pixel_filter_type = 512, "BOX"  # as msspl-render sets it
    for frame in (2, 3):
        scene.frame_set(frame)
        render.filepath = str(WORK / f"clean.{frame:04d}.exr")
        bpy.ops.render.render(write_still=True)
    render.use_motion_blur = True
    bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "motion_blur.blend"))


def _texture(scale):
    """Make a material with sharp spots."""
    material = bpy.data.materials.new("Spots")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    place, noise, ramp = (nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "TexNoise", "ValToRGB"))
    noise.inputs["Scale"].default_value = scale
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.4, 0.6
    ramp.color_ramp.elements[0].color = (0.1, 0.2, 0.6, 1)
    links.new(place.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs[0], ramp.inputs[0])
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    links.new(ramp.outputs[0], shader.inputs["Base Color"])
    return material
