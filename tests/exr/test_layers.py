# SPDX-License-Identifier: Apache-2.0
"""Channels are grouped into layers by OpenEXR's naming rule, by part names and by views."""

import numpy as np
import pytest

from oiio_msspl.exr.layers import layers_of, matches_layer
from oiio_msspl.exr.reader import open_exr
from tests.conftest import write_exr
from tests.exr.sources import behind_a_deep_part


def grouped(tmp_path, parts, **attributes):
    """{(view, layer): components} of a file with these parts, ``{part name: channel names}``."""
    plane = np.zeros((4, 4), np.float16)
    made = [(name, dict.fromkeys(channels, plane), (0, 0)) for name, channels in parts.items()]
    layers = layers_of(open_exr(write_exr(tmp_path / "a.exr", made, **attributes)))
    return {(layer.view, layer.name): sorted(layer.channels) for layer in layers}


def test_the_prefix_of_a_channel_names_its_layer(tmp_path):
    channels = ["R", "G", "B", "diffuse.R", "diffuse.G", "diffuse.B", "scene.01.light.r"]
    assert grouped(tmp_path, {"": channels}) == {
        ("", ""): ["B", "G", "R"],
        ("", "diffuse"): ["B", "G", "R"],
        ("", "scene.01.light"): ["R"],
    }


def test_the_parts_name_names_the_layer_of_plain_channels(tmp_path):
    parts = {"albedo": ["R", "G", "B"], "N": ["x", "y", "z"], "ViewLayer.Mist": ["ViewLayer.Mist.Z"]}
    assert grouped(tmp_path, parts) == {
        ("", "albedo"): ["B", "G", "R"],
        ("", "N"): ["X", "Y", "Z"],
        ("", "ViewLayer.Mist"): ["Z"],
    }


@pytest.mark.parametrize("name", ["rgba", "RGB", "main", "part 2", "Subimage0"])
def test_some_part_names_name_no_layer(tmp_path, name):
    assert grouped(tmp_path, {name: ["R", "G", "B"]}) == {("", ""): ["B", "G", "R"]}


def test_a_short_name_of_a_view_is_no_end_of_a_layers_name(tmp_path):
    plane = np.zeros((2, 2), np.float32)
    names = {"rgba": "RGB", "normal": "XYZ", "depth.l": "Z"}
    parts = [(name, dict.fromkeys(channels, plane), (0, 0), {"view": "l"}) for name, channels in names.items()]
    file = open_exr(write_exr(tmp_path / "a.exr", parts))
    assert [(layer.view, layer.name) for layer in layers_of(file)] == [("l", ""), ("l", "normal"), ("l", "depth")]


def test_a_layer_may_lie_in_several_parts(tmp_path):
    assert grouped(tmp_path, {"part0": ["R"], "part1": ["G"], "part2": ["B"]}) == {("", ""): ["B", "G", "R"]}


def test_views_stand_between_layer_and_component(tmp_path):
    """OpenEXR's multiView convention; channels without a view belong to the first."""
    channels = ["R", "left.R", "diffuse.left.R", "diffuse.right.R"]
    assert grouped(tmp_path, {"": channels}, multiView=["right", "left"]) == {
        ("right", ""): ["R"],
        ("left", ""): ["R"],
        ("left", "diffuse"): ["R"],
        ("right", "diffuse"): ["R"],
    }


def test_of_two_channels_with_one_meaning_the_layer_holds_the_first(tmp_path):
    plane = np.zeros((4, 4), np.float16)
    file = open_exr(write_exr(tmp_path / "a.exr", {"foo.R": plane, "foo.red": plane}))
    (layer,) = layers_of(file)
    assert [channel.name for channel in layer.channels.values()] == ["foo.R"]


def test_colours_and_vectors_are_triples_and_a_single_channel_is_a_scalar(tmp_path):
    plane = np.zeros((4, 4), np.float16)
    names = ["c.R", "c.G", "c.B", "c.A", "v.X", "v.Y", "v.Z", "d.Y", "two.R", "two.G"]
    layers = {
        layer.name: layer for layer in layers_of(open_exr(write_exr(tmp_path / "a.exr", dict.fromkeys(names, plane))))
    }
    assert [c.name for c in layers["c"].triple()] == ["c.R", "c.G", "c.B"]
    assert [c.name for c in layers["v"].triple()] == ["v.X", "v.Y", "v.Z"]
    assert [c.name for c in layers["d"].scalar()] == ["d.Y"]
    assert layers["two"].triple() is layers["two"].scalar() is None


@pytest.mark.parametrize("name", ["rgba_main", "rgba.main", "rgb_main", "main", "RGBA_MAIN", "part1.main"])
def test_plain_parts_are_known_by_name(tmp_path, name):
    plane = np.zeros((2, 2), np.float32)
    parts = [(name, dict.fromkeys("RGB", plane), (0, 0)), ("albedo", dict.fromkeys("RGB", plane), (0, 0))]
    assert [layer.name for layer in layers_of(open_exr(write_exr(tmp_path / "a.exr", parts)))] == ["", "albedo"]


def test_the_only_part_names_no_layer(tmp_path):
    plane = np.zeros((2, 2), np.float32)
    channels = dict.fromkeys([*"RGB", "albedo.R"], plane)
    file = open_exr(write_exr(tmp_path / "a.exr", [("shot_010 beauty v3", channels, (0, 0))]))
    assert [layer.name for layer in layers_of(file)] == ["", "albedo"]


@pytest.mark.parametrize(
    ("pattern", "matches"),
    [
        ("crypto*", True),
        ("CryptoObject00", True),
        ("crypto object 00", True),
        ("ViewLayer.crypto*", True),
        ("crypto*.R", True),
        ("*Layer.crypto*", True),
        ("R", False),
        ("object*", False),
        ("Other.crypto*", False),
        ("crypto*.G", False),
    ],
)
def test_a_pattern_means_a_layer_whatever_the_case_and_without_the_view_layer(pattern, matches):
    assert matches_layer(pattern, "ViewLayer.CryptoObject00", "R") == matches


def test_a_bracket_in_a_pattern_is_one():
    assert matches_layer("lights[0]", "lights[0]") and matches_layer("lights[*", "lights[1]")
    assert not matches_layer("lights[01]", "lights0")


def test_a_deep_part_takes_no_layer_from_a_flat_one(tmp_path):
    """Even if its name means the same layer."""
    file = open_exr(behind_a_deep_part(tmp_path / "a.exr", dict.fromkeys("RGBA", np.ones((4, 4), np.float32))))
    (layer,) = layers_of(file)
    assert sorted(layer.channels) == ["A", "B", "G", "R"]
    assert all(not file.parts[channel.part].deep for channel in layer.channels.values())
