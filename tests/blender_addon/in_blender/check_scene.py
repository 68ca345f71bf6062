# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of the scene: what is refused, what is put back, and what the two renders show."""

import os

import bpy
from support import MODULE, WORK, fake_fuse, module, sentence, snapshot


def check_sentences(scene):
    """Each mistake is told in one sentence and leaves the scene unchanged."""
    options = module("options")
    assert "set the render engine to Cycles" in sentence(**{"render.engine": "BLENDER_WORKBENCH"})
    assert "turn Render Region off" in sentence(**{"render.use_border": True})
    assert "turn Stereoscopy off" in sentence(**{"render.use_multiview": True})
    assert "turn Freestyle off" in sentence(**{"render.use_freestyle": True})
    assert "101x9 is too small for x4" in sentence(**{"render.resolution_y": 18})
    assert "nowhere#1 does not exist" in sentence(**{"msspl.output": "//nowhere#1/{view_layer}_#.exr"})
    assert "name it .exr" in sentence(**{"msspl.output": "//{view_layer}.png"})
    assert "exists; allow overwriting" in sentence(**{"render.use_overwrite": False})
    camera, scene.camera = scene.camera, None
    assert "has no camera" in sentence()
    scene.camera = camera
    try:
        options.find_view_layer(scene, options.Options())
        raise AssertionError("no error with two view layers on")
    except module("errors").Failure as error:
        assert "2 view layers are on (ViewLayer, Other.1); choose one with --view-layer NAME" in str(error)
    program = os.environ["MSSPL_FUSE"]
    os.environ["MSSPL_FUSE"] = "/nothing/msspl-fuse"
    assert "/nothing/msspl-fuse: no such program; correct the path in MSSPL_FUSE" in sentence()
    preferences = bpy.context.preferences.addons[MODULE].preferences
    preferences.program = "/nothing/else"
    assert "/nothing/else: no such program; correct the path in the add-on's preferences" in sentence()
    preferences.program = program
    assert bpy.ops.msspl.fuse() == {"FINISHED"}  # The preference wins over the variable.
    preferences.program = ""
    said = "print('error: é differs', file=sys.stderr); print('more', file=sys.stderr); sys.exit(2)"
    os.environ["MSSPL_FUSE"] = str(fake_fuse(f"assert os.environ['PYTHONUTF8'] == '1'; {said}"))
    assert "msspl-fuse: é differs" in sentence()
    (WORK / "fake-fuse").write_text("no program")
    assert "can't be started" in sentence()
    os.environ["MSSPL_FUSE"] = program


def check_samples():
    """Check that the LRHS gets the samples of the table in docs/guide/render.md, always more than the HRLS has."""
    options = module("options").Options
    assert [(options(n, s).lrhs_spp, options(n, s).hrls_spp) for n, s in ((1, 1), (2, 1), (2, 4))] == [
        (8, 8),
        (4, 4),
        (16, 1),
    ]
    table = {1: (4, 16, 64), 3: (4, 16, 64), 4: (6, 22, 86), 6: (8, 32, 128), 8: (11, 43, 171)}
    for hr_spp, expected in table.items():
        assert tuple(options(renders=2, scale=scale, hr_spp=hr_spp).lrhs_spp for scale in (2, 4, 8)) == expected, hr_spp
    assert all(options(renders=2, scale=2, hr_spp=spp).lrhs_spp > spp for spp in range(1, 65))


def check_animated(scene):
    """Check that a keyframe or a driver on an overridden setting is refused, by a message that names the setting."""
    before = snapshot(scene)
    scene.driver_add("cycles.seed").driver.expression = "frame"
    scene.frame_set(1)
    assert "cycles.seed is animated; remove its keyframes or driver" in sentence()
    scene.driver_remove("cycles.seed")
    scene.cycles.seed = 7
    scene.view_layers[0].keyframe_insert("samples")  # This setting is not overridden.
    scene.keyframe_insert("cycles.samples")
    assert "cycles.samples is animated" in sentence()
    scene.keyframe_delete("cycles.samples")
    assert snapshot(scene) == before


def check_changes(scene):
    """During a render, the user may change the frame, remove the scene or save the file in another window."""
    frame, overrides, failure = module("frame"), module("overrides"), module("errors").Failure
    options = module("options").Options(renders=2, scale=4, view_layer="ViewLayer")

    def said(scene, meanwhile):
        with frame.loaded_once(scene):
            steps = frame.render_frame(scene, options, WORK)
            next(steps)
            meanwhile()
            try:
                next(steps)
            except failure as error:
                return str(error)

    before = snapshot(scene)
    assert "went from frame 1 to 2" in said(scene, lambda: scene.frame_set(2))
    scene.frame_set(1)
    assert snapshot(scene) == before
    copy = scene.copy()
    assert "was removed while it was rendered" in said(copy, lambda: bpy.data.scenes.remove(copy))

    # A file that is saved contains the user's settings. Afterwards the overriding settings are set again.
    with overrides.override(scene, module("render_settings").lrhs(scene, options)):
        overridden = snapshot(scene)
        bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "saved.blend"), copy=True)
        assert snapshot(scene) == overridden != before
    with bpy.data.libraries.load(str(WORK / "saved.blend")) as (there, here):
        here.scenes = there.scenes
    assert repr(snapshot(here.scenes[0])).replace(here.scenes[0].name, scene.name) == repr(before)
    bpy.data.scenes.remove(here.scenes[0])
    (WORK / "saved.blend").unlink()


def render_ramps():
    """Render a ramp at odd sizes. test_in_blender.py compares its values at the edges of both renders."""
    overrides, render, settings = module("overrides"), module("render"), module("render_settings")
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=4)
    material = bpy.data.materials.new("Ramp")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    coordinates, emission = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeEmission")
    shift = nodes.new("ShaderNodeVectorMath")
    shift.inputs[1].default_value = (2, 2, 2)
    links.new(coordinates.outputs["Position"], shift.inputs[0])
    links.new(shift.outputs[0], emission.inputs["Color"])
    links.new(emission.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    bpy.context.object.data.materials.append(material)
    camera = bpy.data.cameras.new("Camera")
    camera.type, camera.ortho_scale, camera.shift_y = "ORTHO", 3, 0.1
    scene.camera = bpy.data.objects.new("Camera", camera)
    scene.camera.location.z = 2
    scene.collection.objects.link(scene.camera)
    scene.render.engine = "CYCLES"
    options = module("options").Options(renders=2, scale=8, hr_spp=64, lr_spp=256)
    for name, size, aspect in (
        ("wide", (205, 99), (1, 1)),
        ("tall", (99, 205), (1, 1)),
        ("squeezed", (205, 99), (1, 2)),
    ):
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
        for kind, values in (("lr", settings.lrhs(scene, options)), ("hr", settings.hrls(scene, options))):
            file = str(WORK / f"{name}_{kind}.exr")
            with overrides.override(scene, values | {"render.filepath": file}):
                list(render.render(scene, file))
