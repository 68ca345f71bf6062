# SPDX-License-Identifier: Apache-2.0
"""Which layers may sum to the beauty, by name, and whether they do."""

import numpy as np
import OpenEXR
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.passes.sums import check_sum
from tests.conftest import SHARED, needs_shared, rgb, write_exr

SIZE = (8, 6)


def render(folder, layers, prefix="", sums=(), **attributes):
    """A mapped file with these layers (RGB, constant), whose beauty is the sum of the first two."""
    planes = {name: np.full((*SIZE, 3), value, np.float32) for name, value in layers.items()}
    first, second = list(planes.values())[:2]
    channels = rgb(first + second, f"{prefix}Combined." if prefix else "")
    for name, values in planes.items():
        channels |= rgb(values, f"{prefix}{name}.")
    return map_render(open_exr(write_exr(folder / "in.exr", channels, **attributes)), sums=sums)


def names(render):
    return {each.name: [layer.name for layer in each.layers] for each in render.additive_sets}


def test_light_groups_are_found_in_the_view_layer_of_the_beauty(tmp_path):
    layers = {"Combined_key": 1, "Combined_fill": 2, "AO": 3}
    found = render(tmp_path, layers, "View.", **{"cycles.View.samples": "4"})
    assert names(found) == {"light groups": ["Combined_fill", "Combined_key"]}


@pytest.mark.parametrize(
    ("attributes", "prefix"),
    [({"rman/version": "26"}, "lg_"), ({"vrayInfo/vraycore": "6"}, "VRayLightSelect_"), ({}, "RGBA_"), ({}, "Beauty_")],
)
def test_names_that_any_program_may_use_are_found_for_every_renderer(tmp_path, attributes, prefix):
    found = render(tmp_path, {f"{prefix}key": 1, f"{prefix}fill": 2}, **attributes)
    assert names(found) == {"light groups": [f"{prefix}fill", f"{prefix}key"]}
    assert check_sum(found, found.additive_sets[0]).residual < 1e-6


def test_a_sum_may_be_a_pattern(tmp_path):
    found = render(tmp_path, {"my_key": 1, "my_fill": 2, "albedo": 1}, sums=["lamps=my_*"])
    assert names(found)["lamps"] == ["my_fill", "my_key"]


def test_a_pattern_takes_underscores_as_they_are(tmp_path):
    found = render(tmp_path, {"C_key": 1, "C_fill": 2, "combineddiffuse": 3}, renderTime_s="1")
    assert names(found)["light groups"] == ["C_fill", "C_key"]


def test_products_keep_their_colour(tmp_path):
    layers = {"DiffDir": 1, "Emit": 2, "DiffCol": 1, "GlossDir": 9}
    found = render(tmp_path, layers, "View.", **{"cycles.View.samples": "4"})
    (components,) = found.additive_sets
    assert [(layer.name, layer.factor is not None) for layer in components.layers] == [
        ("DiffDir", True),
        ("Emit", False),
    ]
    assert check_sum(found, components).residual < 1e-6


@pytest.mark.parametrize(
    ("attributes", "layers", "raw", "beauty"),
    [
        (
            {"vrayInfo/vraycore": "6"},
            {"rawLight": 2, "rawReflection": 3, "diffuse": 0.5, "reflectionFilter": 0.25, "specular": 4},
            ["rawLight", "rawReflection", "specular"],
            2 * 0.5 + 3 * 0.25 + 4,
        ),
        (
            {"rs/version": "3"},
            {"DiffuseLightingRaw": 2, "GIRaw": 3, "DiffuseFilter": 0.5, "Reflections": 4, "DiffuseLighting": 1},
            ["DiffuseLightingRaw", "GIRaw", "Reflections"],
            2 * 0.5 + 3 * 0.5 + 4,
        ),
    ],
)
def test_raw_light_is_multiplied_by_its_filter(tmp_path, attributes, layers, raw, beauty):
    """V-Ray's and Redshift's raw passes leave the surface colour out."""
    channels = rgb(np.full((*SIZE, 3), beauty, np.float32))
    for name, value in layers.items():
        channels |= rgb(np.full((*SIZE, 3), value, np.float32), f"{name}.")
    found = map_render(open_exr(write_exr(tmp_path / "in.exr", channels, **attributes)))
    (components,) = (each for each in found.additive_sets if each.name == "raw components")
    assert [each.name for each in components.layers] == raw
    assert check_sum(found, components).text == "sums to the beauty (residual 0)"


def test_a_set_without_its_raw_layers_is_none(tmp_path):
    layers = {name: 1 for name in ("lighting", "GI", "specular", "SSS")}
    found = render(tmp_path, layers, **{"vrayInfo/vraycore": "6"})
    assert names(found) == {"components": list(layers)}


def test_a_single_layer_and_integers_are_no_set(tmp_path):
    assert names(render(tmp_path, {"light_key": 1, "other": 2})) == {}
    ids = rgb(np.ones((*SIZE, 3), np.uint32), "light_id.")
    file = open_exr(
        write_exr(
            tmp_path / "ids.exr",
            rgb(np.ones((*SIZE, 3), np.float32)) | ids | rgb(np.ones((*SIZE, 3), np.float32), "light_key."),
        )
    )
    assert names(map_render(file)) == {}


def test_the_user_s_sum_comes_first_and_replaces_the_same_set(tmp_path):
    found = render(tmp_path, {"light_key": 1, "light_fill": 2}, sums=("mine=light_key+light_fill",))
    assert names(found) == {"mine": ["light_key", "light_fill"]}
    assert found.additive_sets[0].by_user


@pytest.mark.parametrize(
    "text",
    [
        "mine",
        "mine=light_key",
        "=light_key+light_fill",
        "mine=light_key+none",
        "mine=light_key+light_fill*none",
        "mine=light_key+light_key",
    ],
)
def test_a_sum_that_cannot_be_read_is_refused(tmp_path, text):
    """With how to write one, or with the layers that there are."""
    said = "it has light_key, light_fill|it has light_fill, light_key" if "none" in text else "write NAME=LAYER"
    with pytest.raises(InputError, match=f"--sum .*({said})"):
        render(tmp_path, {"light_key": 1, "light_fill": 2}, sums=(text,))


@pytest.mark.parametrize(
    ("layers", "remainder", "text"),
    [
        ({"light_a": 1, "light_b": 2}, False, "sums to the beauty (residual 0)"),
        ({"light_a": 1, "other": 3, "light_b": 2}, True, "25.0% of its light, which is in no layer"),
        ({"light_a": 1, "light_b": 2, "light_c": 3}, False, "100.0% more light; without light_c they would sum to it"),
        ({f"light_{c}": 2 for c in "abcd"}, False, "they have 100.0% more light; some layers overlap"),
    ],
)
def test_the_pixels_decide(tmp_path, layers, remainder, text):
    found = render(tmp_path, layers)
    (light_groups,) = (each for each in found.additive_sets if each.name == "light groups")
    check = check_sum(found, light_groups)
    assert text in check.text and check.remainder == remainder and bool(check.problem) == ("more light" in text)


def test_broken_pixels_do_not_decide(tmp_path):
    planes = {name: np.ones((*SIZE, 3), np.float32) for name in ("light_a", "light_b")}
    planes["light_a"][2, 3] = np.nan
    channels = (
        rgb(np.full((*SIZE, 3), 2, np.float32))
        | rgb(planes["light_a"], "light_a.")
        | rgb(planes["light_b"], "light_b.")
    )
    found = map_render(open_exr(write_exr(tmp_path / "in.exr", channels)))
    assert not check_sum(found, found.additive_sets[0]).problem


@pytest.mark.parametrize(("dtype", "lossy"), [(np.float32, True), (np.float16, False)])
def test_pxr24_loses_bits_of_floats_alone(tmp_path, dtype, lossy):
    """A set that does not sum is told apart from one that lossy compression has damaged."""
    light = np.random.default_rng(2).uniform(0.2, 0.8, (32, 48, 3)).astype(dtype)
    unlike = light * np.where(np.arange(48)[:, None] % 2, dtype(1.02), dtype(0.98))
    channels = rgb(light + light) | rgb(light, "light_a.") | rgb(unlike.astype(dtype), "light_b.")
    path = write_exr(tmp_path / "in.exr", channels, compression=OpenEXR.PXR24_COMPRESSION)
    found = map_render(open_exr(path))
    text = check_sum(found, found.additive_sets[0]).text
    assert "both ways" in text and ("compression pxr24 is lossy" in text) == lossy


@needs_shared("exr")
@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("cycles-4.2/cycles_viewlayer_zip32.exr", "sums to the beauty (residual 2.7e-08"),
        ("cycles-4.2/cycles_border_region.exr", "sums to the beauty (residual 4.9e-08"),
        ("cycles-4.2/cycles_viewlayer_dwaa16.exr", "both ways; the compression dwaa is lossy"),
        ("cycles-5.0/cycles_viewlayer_zip32.exr", "sums to the beauty (residual 6.5e-08"),
        ("cycles-5.0/cycles_two_dotted_viewlayers_piz16.exr", "sums to the beauty (residual 0.00025"),
        ("arnold/rgba_N_P_diffuse_direct_specular.exr", "32.0% of its light, which is in no layer"),
    ],
)
def test_sets_of_real_files(file, text):
    found = map_render(open_exr(SHARED / "exr" / file))
    (components,) = found.additive_sets
    assert components.name == "components" and text in check_sum(found, components).text


def test_the_finest_arnold_layers_are_a_set_and_the_coarser_ones_its_sums(tmp_path):
    layers = {"diffuse_direct_key": 1, "diffuse_direct_fill": 2, "diffuse_indirect": 4, "specular": 1}
    layers |= {"diffuse_direct": 3, "diffuse_key": 9, "diffuse": 7, "diffuse_albedo": 1, "coat_direct": 1}
    found = render(tmp_path, layers, **{"arnold/AA_samples": "3"})
    finest = next(each for each in found.additive_sets if each.name == "finest components")
    fine = {"diffuse_direct_key", "diffuse_direct_fill", "diffuse_indirect", "specular", "coat_direct"}
    assert {layer.name for layer in finest.layers} == fine
    assert {layer.name for layer in finest.coarser} == {"diffuse_direct", "diffuse_key", "diffuse"}


def test_names_that_are_written_together_have_the_same_words(tmp_path):
    found = render(tmp_path, {"C_key": 1, "C_fill": 2, "combineddiffuse": 3, "coat": 1}, renderTime_s="1")
    words = {layer.name: layer.words for each in found.additive_sets for layer in each.layers}
    assert words["C_key"] == {"key"} and words["combineddiffuse"] == {"diffuse"} < {"direct", "diffuse"}
    directs = {"directdiffuse": 1, "indirectdiffuse": 2}
    found = render(tmp_path, directs, renderTime_s="1").additive_sets[0]
    assert [set(layer.words) for layer in found.layers] == [{"direct", "diffuse"}, {"indirect", "diffuse"}]
