# SPDX-License-Identifier: Apache-2.0
"""The button that rebuilds the beauty from fused passes. Its nodes are evaluated on the pixels of the fused file."""

import json

import numpy as np
import pytest
from msspl_bridge import FuseError
from msspl_bridge.passes import fused_sets

from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import open_exr
from tests.conftest import rgb, write_exr

HEIGHT, WIDTH = 64, 96


def write_pair(folder):
    """Write a x4 pair with light groups, and with a product and an emission, as Blender names them."""
    for name, scale, spp in (("lr", 4, 64), ("hr", 1, 4)):
        random = np.random.default_rng(scale)
        shape = (HEIGHT // scale, WIDTH // scale, 3)
        light, emission = (random.gamma(spp, 1 / spp, shape).astype(np.float32) * x for x in (1.0, 0.2))
        colour = np.full(shape, (0.8, 0.5, 0.2), np.float32)
        beauty = light * colour + emission
        layers = {"Combined": beauty, "Combined_key": 0.25 * beauty, "Combined_fill": 0.75 * beauty}
        layers |= {"Diffuse Direct": light, "Diffuse Color": colour, "Emission": emission}
        channels = {}
        for layer, values in layers.items():
            channels |= rgb(values, f"View.{layer}.")
        write_exr(folder / f"{name}.1002.exr", channels, **{"cycles.View.samples": str(spp)})


def evaluate(node, layers, group):
    """Compute the rgb of a node's output, where the input of the group has these layers."""
    kind, inputs = node.Class(), [evaluate(source, layers, group) for source in node._inputs]
    if kind == "Input":
        return layers["rgba"]
    if kind == "Shuffle":
        assert node.input(0).Class() == "Input"
        return layers[node["in"].value()]
    if kind == "Merge2":
        (b, a), operation = inputs, node["operation"].value()
        assert node["output"].value() == "rgb"
        return {"plus": a + b, "multiply": a * b, "difference": abs(a - b)}[operation]
    if kind == "Switch":
        assert node["which"].value() == "{parent.show}"
        return inputs[group["show"].values().index(group["show"].value())]
    if kind == "Copy":
        assert (node["from0"].value(), node["to0"].value(), node.input(1).Class()) == ("rgba.alpha",) * 2 + ("Input",)
    assert kind in ("Copy", "Output")
    return inputs[0]


def test_the_rebuild_of_each_set_is_the_fused_beauty(host, tmp_path):
    write_pair(tmp_path)
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    host.press(host.gizmo, "rebuild")
    assert host.messages == []
    groups = [node for node in host.everything if node.Class() == "Group"]
    assert [group.name() for group in groups] == ["Rebuild_light_groups", "Rebuild_components"]
    (read,) = {group.input(0) for group in groups}
    assert [(g.xpos() - read.xpos(), g.ypos() - read.ypos()) for g in groups] == [(0, 100), (120, 100)]

    file = open_exr(tmp_path / "hr_fused.1002.exr")
    layers = {
        layer.name.replace(" ", "_") or "rgba": file.read(layer.triple(), file.parts[0].data_window)
        for layer in layers_of(file)
    }
    for group, shuffled in zip(groups, (["key", "fill"], ["Direct", "Color", "Emission"]), strict=True):
        inside = host.nodes_of(group)
        names = [node["in"].value() for node in inside if node.Class() == "Shuffle"]
        assert sorted(name.rpartition("_")[2] for name in names) == sorted(shuffled)
        output = next(node for node in inside if node.Class() == "Output")
        np.testing.assert_allclose(evaluate(output, layers, group), layers["rgba"], rtol=1e-5, atol=1e-6)
        # A pass that is changed is seen in the difference.
        changed = layers | {names[0]: layers[names[0]] * 2}
        group["show"].setValue("difference")
        assert evaluate(output, layers, group).max() < 1e-5
        assert evaluate(output, changed, group).mean() > 0.05
    host.press(host.gizmo, "rebuild")
    assert host.everything[-1]._parent.name() == "Rebuild_components1"


def test_what_is_missing_is_said_in_one_sentence(host):
    host.gizmo["passes"].setValue("none")
    host.press(host.gizmo, "rebuild")
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    host.press(host.gizmo, "rebuild")
    assert host.messages == [
        "MSSPLFuse1: nothing is fused yet; fuse a frame first",
        "MSSPLFuse1: the file has no fused passes; fuse it again with passes that sum to the beauty",
    ]


def test_layers_are_found_by_the_names_that_nuke_gives_them():
    stored = json.dumps([{"name": "components", "layers": [["View.1.Diffuse Direct", "View.1.Tint"], ["View.1.Emit"]]}])
    channels = [
        "rgba.red",
        "View_1_Diffuse_Direct.red",
        "View_1_Diffuse_Direct.blue",
        "view_1_tint.red",
        "View_1_Emit.red",
    ]
    terms = [["View_1_Diffuse_Direct", "view_1_tint"], ["View_1_Emit"]]
    assert fused_sets(stored, channels) == {"components": terms}
    with pytest.raises(FuseError, match=r"the file has no layer View\.1\.Emit; fuse it again with all layers"):
        fused_sets(stored, channels[:-1])
    for nothing in (None, "[]"):
        with pytest.raises(FuseError, match="no fused passes"):
            fused_sets(nothing, channels)


def test_a_set_that_lacks_a_layer_is_left_out_and_named_if_it_is_the_only_one():
    names = {"light groups": ["light_1", "light_2"], "components": ["diffuse", "specular"]}
    stored = json.dumps([{"name": name, "layers": [[layer] for layer in layers]} for name, layers in names.items()])
    lights, parts = ({name: [[layer] for layer in layers]} for name, layers in names.items())
    channels = [f"{layer}.red" for layers in names.values() for layer in layers]
    assert fused_sets(stored, channels) == lights | parts
    assert fused_sets(stored, channels[:-1]) == lights
    assert fused_sets(stored, channels[1:]) == parts
    with pytest.raises(FuseError, match="has no layer light_2; fuse it again with all layers of light groups"):
        fused_sets(stored, ["light_1.red", "diffuse.red"])
    alone = json.dumps(json.loads(stored)[1:])
    with pytest.raises(FuseError, match="has no layer specular; fuse it again with all layers of components"):
        fused_sets(alone, channels[:-1])
