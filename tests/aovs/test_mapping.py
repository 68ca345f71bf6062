# SPDX-License-Identifier: Apache-2.0
import re

import pytest

from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
from oiio_msspl.errors import InputError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("albedo = 5", "5 is neither a layer's name nor a table"),
        ('albedo = ["a", "b"]', "is neither a layer's name nor a table"),
        ('variance = { halves = ["a"] }', "the two half buffers"),
        ('albedo = { channels = ["a.R", "a.G"] }', "has 2 channels, not 3"),
        ('albedo = { channels = "R" }', "channels must be a list of names"),
        ('normal = { layer = "n", encoding = "foo" }', "encoding 'foo': only a normal has an encoding, one of signed"),
        ('albedo = { layer = "a", kind = "mean" }', "kind 'mean': only a variance has a kind"),
        ('albedo = { lay = "a" }', "has lay; give one of layer, sum"),
        ('rgb = { sum = ["a", "b"] }', "must be a single layer"),
        ("albedo =", "can't be read as a mapping"),
    ],
)
def test_mistakes_in_a_mapping_file_are_named(tmp_path, text, message):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError, match=rf"map\.toml: .*{re.escape(message)}"):
        read_map_file(tmp_path / "map.toml")


def test_files_that_a_mapping_names_do_not_depend_on_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert parse_map_options(["albedo=a/b.exr"]) == {"albedo": f"file:{tmp_path}/a/b.exr"}
    assert parse_map_options(["albedo=a/b.exr:Layer 1"]) == {"albedo": f"file:{tmp_path}/a/b.exr:Layer 1"}
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps/map.toml").write_text('albedo = "file:b.exr"\ndiffuse = { sum = ["file:DIRECT", "file:/c.exr"] }')
    assert read_map_file("maps/map.toml") == {
        "albedo": f"file:{tmp_path}/maps/b.exr",
        "diffuse": {"sum": ["file:DIRECT", "file:/c.exr"]},
    }


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["albedo"], "write it as feature=layer"),
        (["colour=x"], "'colour' is not a feature; use one of rgb, albedo"),
        (["rgb=a+b"], "must be a single layer"),
        (["rgb=other.exr"], "must be a layer of the render itself"),
        (["variance=a+b"], "variances don't add up"),
    ],
)
def test_a_wrong_mapping_option_is_explained(options, message):
    with pytest.raises(InputError, match=message):
        parse_map_options(options)
