# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the tiny scene that the checks render, and holds their common functions."""

import importlib
import sys
from pathlib import Path

import bpy

#: The folder for all files.
WORK = Path(sys.argv[1]).resolve()
#: The add-on, installed as an extension.
MODULE = "bl_ext.user_default.msspl"
BLENDER_5 = bpy.app.version >= (5, 0, 0)


def module(name):
    """Import a module of the installed add-on."""
    return importlib.import_module(f"{MODULE}.{name}")


def build_scene():
    """Save and return a scene: a lit cube on a plane. Every setting that the add-on overrides has another value."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=12, location=(0, 0, -1))
    bpy.context.object.data.materials.append(bpy.data.materials["Material"])
    scene.camera.data.shift_x = 0.1
    render, cycles, layer = scene.render, scene.cycles, scene.view_layers[0]
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = 203, 150, 50
    render.filepath, render.threads_mode, render.threads = "//elsewhere_", "FIXED", 2
    render.use_single_layer, render.film_transparent = True, True
    render.image_settings.file_format = "JPEG"
    render.image_settings.color_mode = "BW"
    cycles.samples, cycles.seed, cycles.time_limit = 300, 7, 9.0
    cycles.sampling_pattern = "BLUE_NOISE"
    cycles.use_auto_tile, cycles.auto_scrambling_distance, cycles.scrambling_distance = False, True, 0.7
    cycles.sample_clamp_direct = 3.0
    layer.samples = 5
    layer.use_pass_mist = layer.use_pass_cryptomatte_object = True
    layer.aovs.add().name = "Matte"
    layer.lightgroups.add(name="key")
    scene.view_layers.new("Other.1")
    bpy.context.window.view_layer = layer
    scene.msspl.output, scene.msspl.renders = "//fused_{view_layer}_###.exr", "SIZES"
    bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "scene.blend"))
    return scene


def snapshot(scene):
    """Every simple value of the settings of the scene, as text."""
    owners = [scene.render, scene.render.image_settings, scene.cycles]
    owners += [owner for layer in scene.view_layers for owner in (layer, layer.cycles)]
    kinds = ("BOOLEAN", "INT", "FLOAT", "STRING", "ENUM")
    return [
        {p.identifier: repr(getattr(owner, p.identifier)) for p in owner.bl_rna.properties if p.type in kinds}
        for owner in owners
    ]


def sentence(operator="fuse", **values):
    """Return the error of an operator while ``{data path: value}`` is set, and check that it changes nothing."""
    scene = bpy.context.scene
    with module("overrides").override(scene, values):
        before = snapshot(scene)
        try:
            getattr(bpy.ops.msspl, operator)()
        except RuntimeError as error:
            assert snapshot(scene) == before
            return str(error)
    raise AssertionError(f"no error with {values}")


def fake_fuse(code):
    """Make a program in place of msspl-fuse that runs this Python code."""
    path = WORK / "fake-fuse"
    path.write_text(f"#!{sys.executable}\nimport os, sys, time\n{code}\n")
    path.chmod(0o755)
    return path
