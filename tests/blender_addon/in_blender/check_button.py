# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of the button, the panel and the compositor."""

import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
from support import BLENDER_5, WORK, fake_fuse, module, sentence, snapshot


def check_button(scene):
    """Check that the button shows the fused file in the compositor and leaves the scene unchanged."""
    before = snapshot(scene)
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert snapshot(scene) == before
    tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
    node = tree.nodes["MSSPL Fused"]
    passes = {output.name for output in node.outputs}
    wanted = {"Combined", "Alpha", "Normal", "Denoising Albedo"}
    assert passes >= wanted | {"Mist", "CryptoObject00", "Matte", "Combined_key"}, passes
    output = module("compositor")._output(tree)
    assert output.inputs[0].links[0].from_node == node

    # A second frame goes into the same node. Its links stay, and so does a link that the user made to the output.
    blur = tree.nodes.new("CompositorNodeBlur")
    tree.links.new(node.outputs["Mist"], blur.inputs[0])
    tree.links.new(blur.outputs[0], output.inputs[0])
    scene.frame_set(12)
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert [node.name for node in tree.nodes if node.bl_idname == "CompositorNodeImage"] == ["MSSPL Fused"]
    assert blur.inputs[0].links[0].from_node == node
    assert output.inputs[0].links[0].from_node == blur
    assert node.image.filepath == "//fused_ViewLayer_012.exr"
    if not BLENDER_5:  # Nodes that are turned off still belong to the user.
        scene.use_nodes = False
        module("compositor").show(scene, "ViewLayer", "//fused_ViewLayer_012.exr", False)
        assert output.inputs[0].links[0].from_node == blur
    scene.msspl.connect = True
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    assert output.inputs[0].links[0].from_node == node
    for name in ("Combined", "Mist", "Normal"):
        tree.links.new(node.outputs[name], output.inputs[0])
        composite(scene, WORK / f"composited_{name}.exr")


def check_colour_space(scene):
    """Both renders are written in the linear space that the scene's output has. The compositor converts it back.

    test_in_blender.py compares the files that are left here.
    """
    settings, override = module("render_settings"), module("overrides").override
    options, image = module("options").Options(renders=2, scale=4, view_layer="ViewLayer"), "render.image_settings"
    scene.msspl.connect = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0.9, 0.2, 0.1, 1)
    for name, kept in (("ACEScg", True), ("sRGB", False)):
        output = {
            **({f"{image}.media_type": "MULTI_LAYER_IMAGE"} if BLENDER_5 else {}),
            f"{image}.file_format": "OPEN_EXR_MULTILAYER",
            f"{image}.color_depth": "32",
            f"{image}.color_management": "OVERRIDE",
            f"{image}.linear_colorspace_settings.name": name,
        }
        with override(scene, output):
            before = snapshot(scene)
            for values in (settings.lrhs(scene, options), settings.hrls(scene, options)):
                with override(scene, values):
                    found = scene.render.image_settings.color_management
                    assert found == ("OVERRIDE" if kept else "FOLLOW_SCENE"), name
            assert bpy.ops.msspl.fuse() == {"FINISHED"}
            assert snapshot(scene) == before
            assert scene.render.image_settings.linear_colorspace_settings.name == name
        shutil.copy(WORK / "fused_ViewLayer_001.exr", WORK / f"space_{name}.exr")
        tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
        node = tree.nodes["MSSPL Fused"]
        node.image.filepath = f"//space_{name}.exr"
        for wanted in ("Combined", "Normal"):
            tree.links.new(node.outputs[wanted], module("compositor")._output(tree).inputs[0])
            composite(scene, WORK / f"space_{name}_{wanted}.exr")


def check_animation_button(scene):
    """Frames of the saved file are rendered, averaged, fused and shown; those that exist are left alone."""
    for name in ("shot.exr", "shot_##_v2.exr", "take2##.exr"):
        assert "with #### as the last number" in sentence(
            "fuse_animation", **{"msspl.output": f"//{{view_layer}}/{name}"}
        )
    assert "turn Render Region off" in sentence("fuse_animation", **{"render.use_border": True})
    scene.frame_start, scene.frame_end, scene.frame_step = 11, 13, 1
    scene.msspl.output = "//{view_layer}_##.exr"
    bpy.context.window.scene = bpy.data.scenes.new("Other")
    bpy.ops.wm.save_mainfile()
    bpy.context.window.scene = scene  # the window shows another scene than the file
    files = [WORK / f"ViewLayer_{number}.exr" for number in (11, 12, 13)]
    before = snapshot(scene), scene.frame_current
    assert bpy.ops.msspl.fuse_animation() == {"FINISHED"}
    assert (snapshot(scene), scene.frame_current) == before
    written = [file.stat().st_mtime_ns for file in files]
    assert not [path for path in WORK.iterdir() if path.name.startswith(".msspl")]

    tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
    node = tree.nodes["MSSPL Fused"]
    assert node.image.source == "SEQUENCE"
    output = module("compositor")._output(tree)
    tree.links.new(node.outputs["Combined"], output.inputs[0])
    scene.frame_set(13)
    composite(scene, WORK / "composited_shot.exr")

    files[1].unlink()
    scene.render.use_overwrite = False
    bpy.ops.wm.save_mainfile()
    assert bpy.ops.msspl.fuse_animation() == {"FINISHED"}
    assert [files[i].stat().st_mtime_ns == written[i] for i in range(3)] == [True, False, True]


def composite(scene, path):
    image = scene.render.image_settings
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    scene.view_settings.exposure = 2.0  # The exposure of the view must not change the file.
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def check_panel():
    layout = MagicMock()
    module("panel").MSSPL_PT_fuse.draw(SimpleNamespace(layout=layout), bpy.context)
    layout.label.assert_called_once_with(text="26x19 at 16 spp, 101x75 at 1 spp")
    assert [call.args[0] for call in layout.operator.call_args_list] == ["msspl.fuse", "msspl.fuse_animation"]


def check_modes(scene):
    """Check that a script waits for its render, and a window does not. A render without a file was cancelled, or
    failed if Blender has no window."""
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

    def fail(*_, window, **__):
        modes.append(window)
        raise errors.Failure("no more")

    module("frame").render_frame, real = fail, module("frame").render_frame
    assert "no more" in sentence()
    module("frame").render_frame = real
    assert modes[3:] == [False]


def check_cancel(scene):
    """Esc in a window ends msspl-fuse and leaves the scene and the old file unchanged."""
    program = os.environ["MSSPL_FUSE"]
    pid = WORK / "pid"
    waiting = (
        f"open({str(pid)!r}, 'w').write(str(os.getpid())); print('INFO: step 1 of 4', file=sys.stderr, flush=True)"
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
    while status.fraction != 2.25 / 3:  # One tile of four is done in the last of three steps.
        assert operator.modal(context, timer) == operator.modal(context, report) == {"PASS_THROUGH"}
        assert operator.modal(context, other) == {"RUNNING_MODAL"}  # No other operator sees the key.
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

    # Cancelling during the first render and a failure before it clean up as well.
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
