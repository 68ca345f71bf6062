# SPDX-License-Identifier: Apache-2.0
"""Which layers hold motion vectors and position, by name."""

from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.aovs import motion
from oiio_msspl.aovs.motion import MOST_GUESSES, MotionFormat, find_motion_layers, read_format
from oiio_msspl.aovs.renderers import renderers, view_layer_of
from oiio_msspl.aovs.views import Beauty
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import Channel, open_exr
from tests.aovs.renders import H, W, layer, mapped
from tests.conftest import write_exr

ENTRIES = [(renderer, entry) for renderer in renderers() for entry in renderer.get("motion", ())]


@pytest.mark.parametrize(("renderer", "entry"), ENTRIES, ids=lambda v: v.get("name") or v["layer"])
def test_every_entry_of_the_table_finds_its_layer(tmp_path, renderer, entry):
    letters = entry.get("channels") or ["R", "G"]
    file = open_exr(write_exr(tmp_path / "in.exr", layer(f"View.{entry['layer']}", 1, letters)))
    found = find_motion_layers(renderer, layers_of(file), Beauty("", "View", Layer("View.Combined", "")))
    wanted = MotionFormat(**{key: value for key, value in entry.items() if key not in ("layer", "channels")})
    assert [(each.layer, each.components, each.format) for each in found.fields] == [
        (entry["layer"], tuple(letters), wanted)
    ]


def test_vectors_have_two_three_or_four_channels_by_several_names(tmp_path):
    channels = layer("", 1) | layer("motionBack", 1, "RGBA") | layer("forward", 1, "uv") | layer("velocity", 1, "xyz")
    found = mapped(tmp_path, channels).motion.fields
    assert [each.name for each in found] == ["motionBack.RG", "forward.uv", "velocity.XY"]


def test_integers_and_single_channels_are_no_vectors(tmp_path):
    ids = {f"velocity.{c}": np.ones((H, W), np.uint32) for c in "RG"}
    assert not mapped(tmp_path, layer("", 1) | ids | layer("forward", 1, "R")).motion.fields


def test_vectors_of_the_chosen_view_layer_are_taken(tmp_path):
    names = [f"{view}.{name}" for view in ("one", "two") for name in ("Combined", "Vector")]
    channels = {c: v for name in names for c, v in layer(name, 1, "RGB" if "Comb" in name else "XYZW").items()}
    found = mapped(tmp_path, channels, view="two", attributes={"BlenderMultiChannel": "Blender"}).motion
    assert [each.channels[0].name for each in found.fields] == ["two.Vector.X", "two.Vector.Z"]


@pytest.mark.parametrize(
    ("channels", "position"),
    [
        (layer("P", 1, "XYZ") | layer("", 1) | layer("N_denoise", 1) | layer("denoise_albedo", 1), "P.X"),
        (layer("", 1) | layer("position", 1, "XYZ"), "position.X"),
        (layer("", 1) | layer("P", 1, "XYZ"), None),
    ],
)
def test_positions_are_found(tmp_path, channels, position):
    """P is in world space for some renderers and in camera space for others: only known ones are asked."""
    found = mapped(tmp_path, channels).motion
    assert (found.position and found.position[0].name) == position


def test_layers_of_unknown_names_are_guesses_and_not_too_many(tmp_path):
    """What is known or read is none, and layers of two channels come first."""
    channels = layer("", 1) | layer("albedo", 1) | layer("light_key", 1) | layer("Crypto00", 1, "RGBA")
    channels |= {c: p for i in range(20) for c, p in layer(f"paint{i}", 1).items()} | layer("shift", 1, "uv")
    guesses = [field.name for field in mapped(tmp_path, channels).motion.guesses]
    assert len(guesses) == MOST_GUESSES
    assert guesses[0] == "shift.uv" and all(name.startswith("paint") for name in guesses[1:])


def test_the_work_grows_with_the_number_of_layers_and_not_with_its_square(monkeypatch):
    lamps = [Layer(f"lamp {i}", "", {c: Channel(Path(), 0, 3 * i, c, "half") for c in "RGB"}) for i in range(500)]
    calls = []
    monkeypatch.setattr(motion, "view_layer_of", lambda *names: calls.append(names) or view_layer_of(*names))
    find_motion_layers(renderers()[-1], lamps, Beauty("", "", Layer("", "")))
    assert 0 < len(calls) < 100 * len(lamps)


@pytest.mark.parametrize(
    ("unit", "pixels"), [("pixels", (1, 1)), ("ndc", (200, 100)), ("screen", (100, 50)), ("width", (200, 200))]
)
def test_a_vector_of_1_is_that_many_pixels(unit, pixels):
    """On a screen from -1 to 1, a vector of 1 crosses half of the frame."""
    assert MotionFormat(unit=unit, x="right", y="down").pixels_per_unit(200, 100) == pixels
    x, y = pixels
    assert MotionFormat(unit=unit, x="left", y="up", scale=2).pixels_per_unit(200, 100) == (-2 * x, -2 * y)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("layer=v,scale=0", "scale is a number, but not 0"),
        ("layer=v,offset=nan", "offset is a number"),
        ("layer=v,channels=X", "channels are two letters"),
        ("layer=v,premultiplied=1", "premultiplied stands alone"),
        ("layer=v,to=next,to=next", "to is given twice"),
        ("layer=v,speed=1", "'speed' is none of layer, channels, to"),
        ("to=next", "starts with layer=NAME"),
    ],
)
def test_a_format_that_can_t_be_read_is_explained(text, problem):
    assert read_format("layer=v,offset=0,scale=2+layer=w") == [{"layer": "v", "offset": 0, "scale": 2}, {"layer": "w"}]
    with pytest.raises(InputError, match=problem):
        read_format(text)
