# SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

import pytest

from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
from oiio_msspl.errors import InputError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("albedo = 5", "5 is neither a layer's name nor a table"),
        ('albedo = ["a", "b"]', "is neither a layer's name nor a table"),
        ('albedo = { channels = ["a.R", "a.G"] }', "has 2 channels, not 3"),
        ('albedo = { channels = "R" }', "channels must be a list of names"),
        ('variance = { layer = "v", of = "pixels" }', "of 'pixels': only a variance may be of 'samples'"),
        ('albedo = { layer = "a", of = "samples" }', "of 'samples': only a variance"),
        ('normal = { layer = "n", encoding = "foo" }', "encoding 'foo': only a normal has an encoding, one of signed"),
        ('albedo = { lay = "a" }', "has lay; give one of layer, sum"),
        ('rgb = { sum = ["a", "b"] }', "must be a single layer"),
        ("albedo =", "can't be read as a mapping"),
    ],
)
def test_mistakes_in_a_mapping_file_are_named(tmp_path, text, message):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError, match=rf"map\.toml: .*{re.escape(message)}"):
        read_map_file(tmp_path / "map.toml")


def test_a_mapping_file_may_begin_with_a_byte_order_mark(tmp_path):
    """Editors on Windows write it."""
    (tmp_path / "map.toml").write_text('albedo = "paint"', encoding="utf-8-sig")
    assert read_map_file(tmp_path / "map.toml") == {"albedo": "paint"}


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
        (["albedo=light_*"], r"albedo: 'light_\*' is a pattern; name one layer"),
        (["albedo=a", "albedo=b"], "albedo is mapped twice"),
    ],
)
def test_a_wrong_mapping_option_is_explained(options, message):
    with pytest.raises(InputError, match=message):
        parse_map_options(options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("albedo = " + "[" * 10**5 + "]" * 10**5, "nested too deeply"),
        ("albedo = " + "1" * 5000, "can't be read as a mapping"),
        ("albedo = " + "{ layer = " * 3000 + "'a'" + " }" * 3000, "."),
        ("albedo = [" + "1, " * 10**5 + "]", "is neither a layer's name nor a table"),
        ("normal = { layer = 'N', note = 1979-05-27 }", "note must be a text"),
        ("albedo = 1979-05-27", "is neither a layer's name"),
        ("albedo = 'a\x00b'", "can't be read as a mapping"),
    ],
)
def test_a_forged_mapping_file_is_refused_by_a_short_sentence(tmp_path, text, message):
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_map_file(path)
    assert len(str(caught.value)) < 1000


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device that never ends")
@pytest.mark.parametrize(
    ("path", "problem"),
    [("/dev/zero", "is no ordinary file"), ("/dev", "is a folder"), ("nothing.toml", "no such file")],
)
def test_what_is_no_file_is_no_mapping(path, problem):
    with pytest.raises(InputError, match=f"{problem}; name a TOML file"):
        read_map_file(path)
