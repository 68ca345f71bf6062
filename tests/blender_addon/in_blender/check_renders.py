# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of one render, two seeds and two sizes, of what is loaded and rendered how often, and of the output's name."""

import os
import shutil
from contextlib import contextmanager
from unittest import mock

import bpy
import cycles.engine
from check_button import composite
from support import BLENDER_5, WORK, fake_fuse, module, sentence


@contextmanager
def _told():
    """Collect what Blender says while it renders."""
    said = []

    def listen(text, *_):
        said.append(text)

    bpy.app.handlers.render_stats.append(listen)
    yield said
    bpy.app.handlers.render_stats.remove(listen)


def check_renders(scene):
    """The button renders once, twice, or two sizes. test_in_blender.py looks at the files that are left here."""
    settings = scene.msspl
    for name, samples in (("ONE", "Sample 8/8"), ("TWO", "Sample 4/4"), ("SIZES", "Sample 16/16")):
        settings.renders = name
        with _told() as said:
            assert bpy.ops.msspl.fuse() == {"FINISHED"}
        assert [text for text in said if samples in text], (name, said)
        shutil.copy(WORK / "fused_ViewLayer_001.exr", WORK / f"renders_{name}.exr")
    settings.renders = "ONE"


def check_choices(scene):
    """Quality and device reach msspl-fuse, and a program that is another one is told in a sentence."""
    program, scene.msspl.quality, scene.msspl.device = os.environ["MSSPL_FUSE"], "BEST", "OPENVINO"
    os.environ["MSSPL_FUSE"] = str(fake_fuse(f"open({str(WORK / 'arguments')!r}, 'w').write(' '.join(sys.argv))"))
    assert "fake-fuse: printed no report; check that it is msspl-fuse, of the add-on's version" in sentence()
    arguments = (WORK / "arguments").read_text().split()
    assert len([name for name in arguments if name.endswith("hr.exr")]) == 1
    assert " ".join(arguments).endswith("--quality best --device openvino --overwrite")
    os.environ["MSSPL_FUSE"], scene.msspl.quality, scene.msspl.device = program, "BALANCED", "CPU"


def check_layers(scene):
    """Each view layer has a file and a node of its own."""
    assert "2 view layers are on (ViewLayer, Other.1); put {view_layer}" in sentence(**{"msspl.output": "//one_#.exr"})
    assert "known names, which are {view_layer}, {scene" in sentence(**{"msspl.output": "//{view_layer}{frame}.exr"})
    scene.msspl.output = "//{blend_name}_{scene_name}_{camera_name}_{view_layer}_##.exr"
    tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
    for layer in (*scene.view_layers, scene.view_layers[0]):
        bpy.context.window.view_layer = layer
        assert bpy.ops.msspl.fuse() == {"FINISHED"}
    nodes = {node["view_layer"]: node for node in tree.nodes if node.bl_idname == "CompositorNodeImage"}
    assert len(nodes) == 2 == len([node for node in tree.nodes if node.name.startswith("MSSPL Fused")])
    for layer in ("ViewLayer", "Other.1"):
        name = f"scene_Scene_Camera_{layer}_01.exr"
        assert nodes[layer].image.filepath == f"//{name}"
        assert (WORK / name).is_file()


def check_compositing(scene):
    """Compositing a fused frame does not render the scene. A Render Layers node that is linked still does."""
    tree = scene.compositing_node_group if BLENDER_5 else scene.node_tree
    layers = tree.nodes.new("CompositorNodeRLayers")
    output, node = module("compositor")._output(tree), tree.nodes["MSSPL Fused"]
    for link, rendered in ((layers.outputs[0], True), (node.outputs["Combined"], False)):
        tree.links.new(link, output.inputs[0])
        module("compositor").show(scene, "ViewLayer", node.image.filepath, connect=False)
        with _told() as said:
            composite(scene, WORK / "composited.exr")
        assert bool([text for text in said if "Sample" in text]) == rendered == (not layers.mute)


def check_loaded_once(scene):
    """The renders of a job share the scene that is loaded."""
    work = WORK / "job"
    work.mkdir()
    job = {"scene": "", "scene_name": "", "work": str(work)}
    job["options"] = {"renders": 2, "scale": 2, "view_layer": "ViewLayer"}
    job["frames"] = [(number, str(WORK / f"job_{number}.exr")) for number in (1, 2, 3)]
    reports = []
    with mock.patch.object(cycles.engine, "create", wraps=cycles.engine.create) as create:
        module("batch").run_job(job, lambda **event: reports.append(event.get("report")), lambda: None)
    shutil.rmtree(work)
    scene.frame_set(1)
    assert create.call_count == 1
    assert [report["frame"] for report in reports if report] == [1, 2, 3]


def check_seed(scene):
    """A driver on the seed is refused where a second render needs another seed."""
    scene.driver_add("cycles.seed").driver.expression = "frame"
    scene.frame_set(1)
    hint = "cycles.seed is animated; remove its keyframes or driver, and turn on Animate Seed"
    for renders in ("TWO", "SIZES"):
        assert hint in sentence(**{"msspl.renders": renders})
    assert bpy.ops.msspl.fuse() == {"FINISHED"}
    scene.driver_remove("cycles.seed")
    scene.cycles.seed = 7
