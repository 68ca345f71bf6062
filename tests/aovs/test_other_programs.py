# SPDX-License-Identifier: Apache-2.0
"""Files as programs write them that no header, or the header of another program, describes."""

import json

import numpy as np
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from tests.aovs.renders import H, W, layer, mapped, plane, sources
from tests.conftest import write_exr

BLENDER, HUSK, VRAY = {"BlenderMultiChannel": "Blender"}, {"renderTime_s": "12"}, {"vrayInfo/vraycore": "6.10"}
ALBEDO, NORMAL = layer("albedo", 2), layer("normal", 0, "XYZ")


@pytest.mark.parametrize(
    ("channels", "attributes", "found"),
    [
        (
            layer("VL.Combined", 1) | layer("VL.DenoiseAlbedo", 2) | layer("VL.DenoiseNormal", 0, "XYZ"),
            BLENDER,
            ("VL.Combined", "VL.DenoiseAlbedo", "VL.DenoiseNormal"),
        ),
        (layer("Image", 1) | ALBEDO | NORMAL, BLENDER, ("Image", "albedo", "normal")),
        (layer("C", 1) | layer("diffuse_albedo", 2) | layer("N", 0, "XYZ"), HUSK, ("C", "diffuse_albedo", "N")),
        (layer("RGBA", 1) | layer("diffuse_albedo", 2) | layer("N", 0, "XYZ"), HUSK, ("RGBA", "diffuse_albedo", "N")),
        (layer("", 1) | ALBEDO | layer("sh_normal", 0, "XYZ"), {}, ("R G B", "albedo", "sh_normal")),
        (
            layer("beauty", 1) | ALBEDO | layer("nn", 0, "XYZ") | layer("dd", 0, "T"),
            {"Software": "Mitsuba 3"},
            ("beauty", "albedo", "nn"),
        ),
        (
            layer("", 1) | layer("VRayDiffuseFilter", 2) | layer("VRayNormals", 0),
            VRAY,
            ("R G B", "VRayDiffuseFilter", "VRayNormals"),
        ),
        (
            layer("", 1) | layer("albedo.000", 2, "rgb") | layer("N_world.000", 0, "xyz"),
            {},
            ("R G B", "albedo.000", "N_world.000"),
        ),
        (layer("Color", 1) | ALBEDO | NORMAL, {}, ("Color", "albedo", "normal")),
        (layer("RGB color", 1) | ALBEDO | NORMAL, VRAY, ("RGB color", "albedo", "normal")),
        # Of all names, the exact one counts.
        (layer("", 1) | layer("Albedo", 0) | ALBEDO | NORMAL, {}, ("R G B", "albedo", "normal")),
        # Nobody knows this name, but no other layer holds colours that may be the beauty.
        (
            layer("final_grade", 1) | ALBEDO | NORMAL | layer("Crypto00", 3, "RGBA"),
            {},
            ("final_grade", "albedo", "normal"),
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_general_names_are_tried_whatever_the_header_says(tmp_path, channels, attributes, found):
    render = mapped(tmp_path, channels, attributes=attributes)
    assert sources(render) == dict(zip(("rgb", "albedo", "normal"), found, strict=True))


def test_of_several_unknown_layers_none_is_taken_for_the_beauty(tmp_path):
    with pytest.raises(InputError, match=r"no beauty \(R, G, B\) found among: fill, key; name it with --map rgb=LAYER"):
        mapped(tmp_path, layer("key", 1) | layer("fill", 2))


def vray_header(**types):
    return {**VRAY, "vrayChannelInfo": json.dumps({name: {"alias": t, "index": 0} for name, t in types.items()})}


def test_vrays_header_tells_the_type_of_renamed_elements(tmp_path):
    channels = layer("", 1) | layer("surface", 2) | layer("facing", 0, "XYZ") | layer("direct", 3) | layer("bounce", 4)
    attributes = vray_header(surface=101, facing=123, direct=107, bounce=108, **{"RGB color": 126})
    render = mapped(tmp_path, channels, attributes=attributes)
    found = {"rgb": "R G B", "albedo": "surface", "normal": "facing", "diffuse": "direct + bounce"}
    assert sources(render) == found
    assert [(s.name, s.layer_names) for s in render.additive_sets] == [("components", "direct, bounce")]


def test_vrays_header_tells_the_beauty(tmp_path):
    channels = layer("main pass", 1) | layer("beauty", 2) | layer("diffuse", 3)
    render = mapped(tmp_path, channels, attributes=vray_header(**{"main pass": 126, "diffuse": 101}))
    assert sources(render) == {"rgb": "main pass", "albedo": "diffuse"}


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"diffuse": 101}', '{"a": {"alias": 101}, "b": {"alias": 101}}'])
def test_a_header_of_vray_that_tells_nothing_is_ignored(tmp_path, text):
    channels = layer("", 1) | layer("a", 3) | layer("b", 3) | layer("diffuse", 2)
    assert sources(mapped(tmp_path, channels, attributes={**VRAY, "vrayChannelInfo": text}))["albedo"] == "diffuse"


def test_components_of_vray_for_3ds_max_are_a_set(tmp_path):
    names = ("VRayLighting", "VRayGlobalIllumination", "VRaySelfIllumination")
    channels = layer("", 1) | {c: p for name in names for c, p in layer(name, 1).items()}
    (components,) = mapped(tmp_path, channels).additive_sets
    assert components.layer_names == ", ".join(names)


def alpha(tmp_path, parts, **options):
    channel = mapped(tmp_path, parts, **options).alpha
    return channel and (channel.name, channel.part)


def test_an_alpha_beside_the_beauty_is_found(tmp_path):
    """RenderMan's, with its filter weights, and one in a part of its own."""
    weights = {"Ci.~w": plane(1), "a.~w": plane(1)}
    assert alpha(tmp_path, layer("Ci", 1, "rgb") | {"a": plane(1)} | weights) == ("a", 0)
    colour, plate = ("rgb", layer("", 1), (0, 0)), ("plate", layer("plate", 2), (0, 0))
    assert alpha(tmp_path, [colour, ("alpha", {"A": plane(1)}, (0, 0)), plate]) == ("A", 1)
    assert alpha(tmp_path, [colour, ("alpha", {"Y": plane(1)}, (0, 0)), plate]) == ("Y", 1)
    assert alpha(tmp_path, layer("", 1) | {"Alpha.A": plane(1)}) == ("Alpha.A", 0)


def test_an_alpha_of_something_else_is_not_taken(tmp_path):
    assert alpha(tmp_path, layer("", 1) | {"Z": plane(1), "mask.A": plane(1)} | layer("plate", 2, "RGBA")) is None
    # The alpha belongs to the beauty, not to a layer that is mapped in its place.
    assert alpha(tmp_path, layer("", 1, "RGBA") | layer("key", 2), mapping={"rgb": "key"}) is None


def test_nuke_puts_the_view_in_front_of_the_layer(tmp_path):
    channels = layer("", 1) | ALBEDO | layer("right", 3) | layer("right.albedo", 4) | layer("right.normal", 0, "XYZ")
    attributes = {"multiView": ["left", "right"]}
    left = mapped(tmp_path, channels, attributes=attributes)
    assert sources(left) == {"rgb": "R G B", "albedo": "albedo"}
    right = mapped(tmp_path, channels, attributes=attributes, view="right")
    assert right.read(right.data_window)["albedo"][0, 0, 0] == 4
    assert sources(right).keys() == {"rgb", "albedo", "normal"}


def test_a_part_that_covers_less_than_the_beauty_is_said(tmp_path):
    small = {name: values[:4, :4] for name, values in ALBEDO.items()}
    render = mapped(tmp_path, [("rgb", layer("", 1), (0, 0)), ("albedo", small, (2, 2))])
    text = "albedo: its part 'albedo' covers only 4x4+2+2 of 8x8+0+0, so it counts as 0 elsewhere"
    assert render.notes == [text]
    whole = mapped(tmp_path, [("rgb", layer("", 1), (0, 0)), ("albedo", ALBEDO, (0, 0))])
    assert whole.notes == []


@pytest.mark.parametrize(
    ("beauty", "albedo"),
    [
        ("beauty/shot_beauty.1001", "albedo/shot_albedo.1001"),
        ("beauty/shot.1001", "albedo/shot.1001"),
        ("shot_beauty.1001", "shot_albedo.1001"),
        ("shot.rgba.1001", "shot.albedo.1001"),
        ("shot.1001", "shot_albedo.1001"),
        ("shot.1001", "shot.albedo.1001"),
        ("shot_v002", "shot_v002_albedo"),
        ("beauty", "albedo"),
    ],
)
def test_an_aov_in_a_file_of_its_own_is_found_beside_the_beauty(tmp_path, beauty, albedo):
    for name, value in ((beauty, 1), (albedo, 2)):
        path = tmp_path / f"{name}.exr"
        path.parent.mkdir(exist_ok=True)
        write_exr(path, layer("", value))
    render = map_render(open_exr(tmp_path / f"{beauty}.exr"))
    assert render.read(render.data_window)["albedo"][0, 0, 0] == 2
    assert sources(render)["albedo"] == f"{albedo.rpartition('/')[2]}.exr"


def test_files_of_other_frames_or_sizes_lie_there_by_chance(tmp_path):
    for name in ("albedo", "shot_albedo.1002", "other_albedo.1001"):
        write_exr(tmp_path / f"{name}.exr", layer("", 2))
    write_exr(tmp_path / "shot_normal.1001.exr", {c: np.zeros((H, 2 * W), np.float32) for c in "RGB"})
    assert sources(mapped(tmp_path, layer("", 1), stem="shot.1001")).keys() == {"rgb"}


def test_a_layer_of_the_render_wins_over_a_file_beside_it(tmp_path):
    write_exr(tmp_path / "hr_albedo.exr", layer("", 7))
    assert sources(mapped(tmp_path, layer("", 1) | ALBEDO))["albedo"] == "albedo"
