# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on inside Blender: ``MSSPL_FUSE=... BLENDER_USER_RESOURCES=folder python in_blender.py FOLDER``.

Installs the extension, renders tiny scenes and leaves files in FOLDER, which tests/test_blender.py compares.
"""

import importlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy

ADDON = Path(__file__).resolve().parents[1]
WORK = Path(sys.argv[1]).resolve()
MODULE = "bl_ext.user_default.msspl"
V5 = bpy.app.version >= (5, 0, 0)


def install():
    """As a user does it: a package built by Blender's own tool, installed from disk."""
    tool = Path(bpy.utils.system_resource("SCRIPTS"), "addons_core", "bl_pkg", "cli", "blender_ext.py")
    package = WORK / "msspl.zip"
    arguments = ["build", "--source-dir", str(ADDON), "--output-filepath", str(package)]
    subprocess.run([sys.executable, str(tool), *arguments], check=True)
    bpy.ops.extensions.package_install_files(filepath=str(package), repo="user_default", enable_on_install=True)
    assert MODULE in bpy.context.preferences.addons


def module(name):
    return importlib.import_module(f"{MODULE}.{name}")


def build_scene():
    """A lit cube on a plane, saved; every setting that the add-on changes is at another value."""
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
    scene.msspl.output = "//fused_###.exr"
    bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "scene.blend"))
    return scene


def snapshot(scene):
    """Every simple value of the scene's settings."""
    owners = [scene.render, scene.render.image_settings, scene.cycles]
    owners += [each for layer in scene.view_layers for each in (layer, layer.cycles)]
    kinds = ("BOOLEAN", "INT", "FLOAT", "STRING", "ENUM")
    return [
        {p.identifier: repr(getattr(owner, p.identifier)) for p in owner.bl_rna.properties if p.type in kinds}
        for owner in owners
    ]


def sentence(**values):
    """What the operator says when these data paths of the scene are set; they are set back."""
    scene = bpy.context.scene
    with module("render").settings(scene, values):
        before = snapshot(scene)
        try:
            bpy.ops.msspl.fuse()
        except RuntimeError as error:
            assert snapshot(scene) == before
            return str(error)
    raise AssertionError(f"no error with {values}")


def check_button(scene):
    """The button: a fused file in a node of the compositor, which renders as the file is; the scene unchanged."""
    before = snapshot(scene)
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert snapshot(scene) == before
    tree = scene.compositing_node_group if V5 else scene.node_tree
    node = tree.nodes["MSSPL Fused"]
    passes = {output.name for output in node.outputs}
    wanted = {"Combined", "Alpha", "Normal", "Denoising Albedo"}
    assert passes >= wanted | {"Mist", "CryptoObject00", "Matte", "Combined_key"}, passes
    output = module("compositor")._output(tree)
    assert output.inputs[0].links[0].from_node == node

    # Again, to another file: the node and its links stay, a foreign output link is not taken over.
    blur = tree.nodes.new("CompositorNodeBlur")
    tree.links.new(node.outputs["Mist"], blur.inputs[0])
    tree.links.new(blur.outputs[0], output.inputs[0])
    scene.frame_set(12)
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert [each.name for each in tree.nodes if each.bl_idname == "CompositorNodeImage"] == ["MSSPL Fused"]
    assert blur.inputs[0].links[0].from_node == node
    assert output.inputs[0].links[0].from_node == blur
    assert node.image.filepath == "//fused_012.exr"
    if not V5:  # nodes that are turned off are still the user's
        scene.use_nodes = False
        module("compositor").show(scene, "//fused_012.exr", False)
        assert output.inputs[0].links[0].from_node == blur
    scene.msspl.connect = True
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert output.inputs[0].links[0].from_node == node
    for name in ("Combined", "Mist", "Normal"):
        tree.links.new(node.outputs[name], output.inputs[0])
        composite(scene, WORK / f"composited_{name}.exr")


def composite(scene, path):
    image = scene.render.image_settings
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    scene.view_settings.exposure = 2.0  # of the view, not of the file
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def check_panel():
    layout = MagicMock()
    module("panel").MSSPL_PT_fuse.draw(SimpleNamespace(layout=layout), bpy.context)
    layout.label.assert_called_once_with(text="26x19 at 16 spp, 101x75 at 1 spp")
    layout.operator.assert_called_once_with("msspl.fuse", icon="RENDER_STILL")


def check_sentences(scene):
    """Each mistake is one sentence, and leaves the scene as it was."""
    render = module("render")
    assert "set the render engine to Cycles" in sentence(**{"render.engine": "BLENDER_WORKBENCH"})
    assert "turn Render Region off" in sentence(**{"render.use_border": True})
    assert "turn Stereoscopy off" in sentence(**{"render.use_multiview": True})
    assert "turn Freestyle off" in sentence(**{"render.use_freestyle": True})
    assert "101x9 is too small for x4" in sentence(**{"render.resolution_y": 18})
    assert "nowhere#1 does not exist" in sentence(**{"msspl.output": "//nowhere#1/fused_#.exr"})
    assert "name it .exr" in sentence(**{"msspl.output": "//fused.png"})
    assert "exists; allow overwriting" in sentence(**{"render.use_overwrite": False})
    camera, scene.camera = scene.camera, None
    assert "has no camera" in sentence()
    scene.camera = camera
    try:
        render.layer(scene, render.Options())
        raise AssertionError("two view layers are on")
    except module("errors").Failure as error:
        assert "2 view layers are on (ViewLayer, Other.1); name the one" in str(error)
    program = os.environ["MSSPL_FUSE"]
    os.environ["MSSPL_FUSE"] = "/nothing/msspl-fuse"
    assert "/nothing/msspl-fuse: no such program; correct it in MSSPL_FUSE" in sentence()
    preferences = bpy.context.preferences.addons[MODULE].preferences
    preferences.program = "/nothing/else"
    assert "/nothing/else: no such program; correct it in the add-on's preferences" in sentence()
    preferences.program = program
    assert bpy.ops.msspl.fuse() == {"FINISHED"}  # the preference wins
    preferences.program = ""
    said = "print('error: é differs', file=sys.stderr); print('more', file=sys.stderr); sys.exit(2)"
    os.environ["MSSPL_FUSE"] = str(fake_fuse(f"assert os.environ['PYTHONUTF8'] == '1'; {said}"))
    assert "msspl-fuse: é differs" in sentence()
    (WORK / "fake-fuse").write_text("no program")
    assert "can't be started" in sentence()
    os.environ["MSSPL_FUSE"] = program


def check_animated(scene):
    """A setting of ours that the scene's keyframes or a driver would win over is named."""
    before = snapshot(scene)
    scene.driver_add("cycles.seed").driver.expression = "frame"
    scene.frame_set(1)
    assert "cycles.seed is animated; remove its keyframes or driver" in sentence()
    scene.driver_remove("cycles.seed")
    scene.cycles.seed = 7
    scene.view_layers[0].keyframe_insert("samples")  # nothing that we set
    scene.keyframe_insert("cycles.samples")
    assert "cycles.samples is animated" in sentence()
    scene.keyframe_delete("cycles.samples")
    assert snapshot(scene) == before


def check_changes(scene):
    """What a user may do while a frame is rendered, in another window."""
    frame, render, failure = module("frame"), module("render"), module("errors").Failure
    options = render.Options(view_layer="ViewLayer")

    def said(scene, meanwhile):
        steps = frame.make(scene, options, WORK / "new.exr", WORK, "msspl-fuse")
        next(steps)
        meanwhile()
        try:
            next(steps)
        except failure as error:
            return str(error)

    before = snapshot(scene)
    assert "frame 1 was left for 2" in said(scene, lambda: scene.frame_set(2))
    scene.frame_set(1)
    assert snapshot(scene) == before
    copy = scene.copy()
    assert "was removed while it was rendered" in said(copy, lambda: bpy.data.scenes.remove(copy))

    # A file that is saved has the user's settings; the render goes on with ours.
    with render.settings(scene, render.low(scene, options)):
        ours = snapshot(scene)
        bpy.ops.wm.save_as_mainfile(filepath=str(WORK / "saved.blend"), copy=True)
        assert snapshot(scene) == ours != before
    with bpy.data.libraries.load(str(WORK / "saved.blend")) as (there, here):
        here.scenes = there.scenes
    assert repr(snapshot(here.scenes[0])).replace(here.scenes[0].name, scene.name) == repr(before)
    bpy.data.scenes.remove(here.scenes[0])
    (WORK / "saved.blend").unlink()


def check_modes(scene):
    """A script waits for its render, and a window does not; a render that wrote nothing was cancelled in a window."""
    render, errors = module("render"), module("errors")
    modes = []
    fake = SimpleNamespace(
        app=SimpleNamespace(background=False, is_job_running=lambda kind: False),
        ops=SimpleNamespace(render=SimpleNamespace(render=lambda mode, **_: modes.append(mode))),
    )
    render.bpy = fake
    for window, fake.app.background, error in (
        (True, False, errors.Cancelled),
        (False, False, errors.Cancelled),
        (False, True, errors.Failure),
    ):
        try:
            list(render.render(scene, "/nothing.exr", window=window))
            raise AssertionError("there is no file")
        except error:
            pass
    render.bpy = bpy
    assert modes == ["INVOKE_DEFAULT", "EXEC_DEFAULT", "EXEC_DEFAULT"]

    def make(*_, window, **__):
        modes.append(window)
        raise errors.Failure("no more")

    module("frame").make, real = make, module("frame").make
    assert "no more" in sentence()
    module("frame").make = real
    assert modes[3:] == [False]


def fake_fuse(code):
    path = WORK / "fake-fuse"
    path.write_text(f"#!{sys.executable}\nimport os, sys, time\n{code}\n")
    path.chmod(0o755)
    return path


def check_cancel(scene):
    """A window's events, one by one: Esc ends msspl-fuse and leaves the scene and the old file as they were."""
    program = os.environ["MSSPL_FUSE"]
    pid = WORK / "pid"
    waiting = (
        f"open({str(pid)!r}, 'w').write(str(os.getpid())); print('INFO: tile 1 of 4', file=sys.stderr, flush=True)"
    )
    os.environ["MSSPL_FUSE"] = str(fake_fuse(f"{waiting}\ntime.sleep(60)"))
    before, folder = snapshot(scene), sorted(WORK.iterdir())
    button = module("operators").MSSPL_OT_fuse
    context = SimpleNamespace(
        scene=scene,
        view_layer=scene.view_layers[0],
        preferences=bpy.context.preferences,
        screen=SimpleNamespace(areas=[]),
        window=None,
        workspace=SimpleNamespace(status_text_set=lambda text: said.append(text)),
        window_manager=SimpleNamespace(
            event_timer_add=lambda *_, **__: "timer",
            event_timer_remove=lambda timer: said.append(f"{timer} removed"),
            modal_handler_add=lambda operator: None,
        ),
    )
    said = []
    methods = {name: getattr(button, name) for name in ("modal", "cancel", "invoke", "_end", "_job", "_step")}
    operator = type("Operator", (), {**methods, "report": lambda self, kind, text: said.append(text)})()
    timer, escape, other, report = (SimpleNamespace(type=kind) for kind in ("TIMER", "ESC", "Z", "TIMER_REPORT"))

    status, fractions = module("panel").status, []
    assert button.poll(context)
    assert operator.invoke(context, None) == {"RUNNING_MODAL"}
    assert not button.poll(context)
    deadline = time.monotonic() + 60
    while status.fraction != 2.25 / 3:  # a tile of four in the last of three steps
        assert operator.modal(context, timer) == operator.modal(context, report) == {"PASS_THROUGH"}
        assert operator.modal(context, other) == {"RUNNING_MODAL"}  # nothing else sees it
        fractions.append(status.fraction)
        assert time.monotonic() < deadline, said
        time.sleep(0.02)
    assert fractions == sorted(fractions)
    assert [text for text in said if "LRHS 26x19, 16 spp" in text]
    assert [text for text in said if "HRLS 101x75, 1 spp" in text]
    assert operator.modal(context, escape) == {"CANCELLED"}
    assert said[-2:] == ["timer removed", None]
    assert status.text == ""
    assert not Path(f"/proc/{pid.read_text()}").exists()
    pid.unlink()

    # While the first render goes on, and when it fails.
    operator.invoke(context, None)
    operator.modal(context, timer)
    operator.cancel(context)
    scene.render.use_border = True
    operator.invoke(context, None)
    assert operator.modal(context, timer) == {"CANCELLED"}
    assert said[-3].endswith("turn Render Region off")
    scene.render.use_border = False
    assert (snapshot(scene), sorted(WORK.iterdir())) == (before, folder)
    os.environ["MSSPL_FUSE"] = program


def check_framing():
    """Of an odd size, both renders show the same picture from edge to edge: a ramp has the same values there."""
    render = module("render")
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
    options = render.Options(scale=8, hr_spp=64, lr_spp=256)
    for name, size, aspect in (
        ("wide", (205, 99), (1, 1)),
        ("tall", (99, 205), (1, 1)),
        ("squeezed", (205, 99), (1, 2)),
    ):
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
        for kind, values in (("lr", render.low(scene, options)), ("hr", render.high(scene, options))):
            file = str(WORK / f"{name}_{kind}.exr")
            with render.settings(scene, values | {"render.filepath": file}):
                list(render.render(scene, file))


if __name__ == "__main__":
    install()
    scene = build_scene()
    check_panel()
    check_button(scene)
    scene = build_scene()
    check_sentences(scene)
    check_animated(scene)
    check_changes(scene)
    check_modes(scene)
    check_cancel(scene)
    check_framing()
    bpy.ops.preferences.addon_disable(module=MODULE)
    assert not hasattr(bpy.types.Scene, "msspl")
    print("all is well", flush=True)
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(0)  # bpy 4.5 can hang in its destructors
