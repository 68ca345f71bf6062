# SPDX-License-Identifier: Apache-2.0
import numpy as np
import OpenEXR
import pytest

from oiio_msspl.aovs.mapped_render import ROWS_PER_LOAD
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.model.encoding import luminance_variance
from tests.aovs.renders import H, W, layer, mapped, plane, sources
from tests.conftest import EXAMPLES, SHARED, needs_shared, picture, rgb, write_exr


@pytest.mark.parametrize("entry", ["v", {"channels": ["v.R", "v.G", "v.B"]}])
def test_a_variance_of_colours_stays_one_and_has_one_of_luminance(tmp_path, entry):
    channels = layer("", 1) | {"v.R": plane(0.04), "v.G": plane(0.09), "v.B": plane(0.16)}
    render = mapped(tmp_path, channels, {"variance": entry})
    variance = render.read(render.data_window)["variance"]
    np.testing.assert_allclose(variance[0, 0], [0.04, 0.09, 0.16], rtol=1e-3)
    expected = (0.2126 * 0.2 + 0.7152 * 0.3 + 0.0722 * 0.4) ** 2
    np.testing.assert_allclose(luminance_variance(variance), expected, rtol=1e-3)


def test_a_luminance_variance_is_taken_as_it_is(tmp_path):
    render = mapped(tmp_path, layer("", 1) | {"variance.Y": plane(0.25)})
    assert render.read(render.data_window)["variance"].shape == (H, W, 1)
    assert render.read(render.data_window)["variance"][0, 0, 0] == 0.25


def test_the_variance_of_samples_is_divided_by_their_number(tmp_path):
    """pbrt writes it, and the samples per pixel into the header; the user's number comes first."""
    channels = layer("", 1) | {f"Variance.{c}": plane(0.5) for c in "RGB"} | layer("Ns", 0)
    known = mapped(tmp_path, channels, attributes={"samplesPerPixel": 16})
    assert (known.renderer, sources(known)["variance"]) == ("pbrt-v4", "Variance / 16 spp")
    np.testing.assert_allclose(known.read(known.data_window)["variance"], 0.5 / 16, rtol=1e-3)
    by_user = map_render(known.file, spp=8)
    np.testing.assert_allclose(by_user.load().layers["variance"], 0.5 / 8, rtol=1e-3)
    unknown = mapped(tmp_path, channels, stem="unknown")
    assert "variance" not in unknown.features
    assert "variance: Variance is that of samples, and no header tells the spp; give --hr-spp" in unknown.notes
    with pytest.raises(InputError, match="give --hr-spp"):
        map_render(unknown.file, {"variance": {"layer": "Variance", "of": "samples"}})


@needs_shared("exr")
def test_cycles_layers_add_up_to_the_beauty():
    """The paper's equations: diffuse + gloss + transmission + emission + environment is the beauty."""
    render = map_render(
        open_exr(SHARED / "exr/cycles-5.0/cycles_viewlayer_zip32.exr"),
        {
            "albedo": {"sum": ["Transmission Direct", "Transmission Indirect"], "times": "Transmission Color"},
            "normal": {"sum": ["Emission", "Environment"]},
        },
    )
    values = render.read(render.data_window)
    total = values["diffuse"] + values["specular"] + values["albedo"] + values["normal"]
    np.testing.assert_allclose(total, values["rgb"], atol=1e-4)


def test_the_table_says_what_each_feature_is_read_from(tmp_path):
    channels = layer("", 1, "RGBA") | layer("denoise_albedo", 2) | layer("diffuse_direct", 3)
    render = mapped(tmp_path, channels | layer("diffuse_indirect", 4))
    rows = {
        row["feature"]: (row["status"], row["source"])
        for row in render.table({"rgb", "albedo", "normal", "diffuse", "specular"})
    }
    assert rows == {
        "rgb": ("found", "R G B"),
        "albedo": ("found", "denoise_albedo"),
        "normal": ("default", ""),
        "diffuse": ("computed", "diffuse_direct + diffuse_indirect"),
        "specular": ("default", ""),
        "alpha": ("found", "A"),
    }


def test_layers_of_another_view_are_told_apart(tmp_path):
    """In a stereo file, the albedo of the left eye is read and that of the right eye is passed through."""
    channels = layer("", 1) | layer("albedo", 2) | layer("right", 3) | layer("albedo.right", 4)
    render = mapped(tmp_path, channels, attributes={"multiView": ["left", "right"]})
    assert (render.view, sources(render)["albedo"]) == ("left", "albedo")


def test_each_view_has_the_attributes_of_its_own_part(tmp_path):
    """Such as its camera's matrix; what only another part says holds for all."""

    def part(view, **attributes):
        header = {"type": OpenEXR.scanlineimage, "view": view, "eye": view, **attributes}
        return OpenEXR.Part(header, layer("", 1), view)

    path = tmp_path / "stereo.exr"
    with OpenEXR.File([part("left", scene="shared"), part("right")]) as file:
        file.write(str(path))
    for view in ("left", "right"):
        metadata = map_render(open_exr(path), view=view).metadata
        assert (metadata["eye"], metadata["scene"]) == (view, "shared")


def test_the_beauty_channels_are_those_that_a_fused_frame_replaces(tmp_path):
    with_alpha = mapped(tmp_path, layer("C", 1, "ARGB") | layer("albedo", 2))
    assert [c.name for c in with_alpha.beauty_channels] == ["C.R", "C.G", "C.B", "C.A"]
    without = mapped(tmp_path, layer("", 1) | layer("albedo", 2))
    assert [c.name for c in without.beauty_channels] == ["R", "G", "B"]


def test_a_loaded_render_has_the_same_pixels_as_the_file(tmp_path):
    """A file taller than what is loaded at a time, over its whole data window."""
    values = picture(ROWS_PER_LOAD + 30, 20)
    path = write_exr(tmp_path / "hr.exr", [("", rgb(values) | rgb(values * 2, "albedo."), (-3, -40))])
    render = map_render(open_exr(path))
    loaded = render.load()
    assert loaded.data_window == render.data_window
    window = Window(0, -10, 12, 240)
    for name, pixels in render.read(window).items():
        np.testing.assert_array_equal(loaded.read(window)[name], pixels)
    np.testing.assert_array_equal(loaded.layers["rgb"], values)


def test_only_the_features_that_are_asked_for_are_loaded(tmp_path):
    values = picture(30, 20)
    path = write_exr(tmp_path / "hr.exr", rgb(values) | rgb(values, "albedo.") | rgb(values, "specular."))
    render = map_render(open_exr(path))
    assert {"albedo", "specular"} <= render.features.keys()
    assert render.load(["rgb", "albedo", "normal"]).layers.keys() == {"rgb", "albedo"}


def test_a_render_is_loaded_with_further_channels_as_they_are_stored(tmp_path):
    """A channel may be one that a feature is read from."""
    values = picture(ROWS_PER_LOAD + 30, 20)
    path = write_exr(tmp_path / "hr.exr", rgb(values) | rgb(values * 2, "albedo.") | {"Z": values[..., 0] - 7})
    render = map_render(open_exr(path))
    channels = {channel.name: channel for part in render.file.parts for channel in part.channels}
    loaded, stored = render.load_with([channels["Z"], channels["G"]])
    np.testing.assert_array_equal(loaded.layers["rgb"], values)
    np.testing.assert_array_equal(stored, np.stack([values[..., 0] - 7, values[..., 1]], axis=-1))


def test_features_of_neighbouring_channels_are_not_copied(tmp_path):
    """Each channel is contiguous, as the network wants it, whatever the order of the file."""
    values = picture(H, W)
    path = write_exr(tmp_path / "hr.exr", rgb(values) | rgb(values * 2, "albedo.") | {"Z": values[..., 0]})
    features = map_render(open_exr(path)).read(Window(0, 0, W, H), ["albedo", "rgb"])
    assert features["rgb"].base is features["albedo"].base is not None
    for feature, factor in (("rgb", 1), ("albedo", 2)):
        assert features[feature].transpose(2, 0, 1).flags.c_contiguous
        np.testing.assert_array_equal(features[feature], values * factor)


def test_a_mapped_render_and_a_loaded_one_can_be_read_with_cached_strips(tmp_path):
    """Whoever reads tiles asks both kinds of render in the same way."""
    render = mapped(tmp_path, layer("", 1))
    for readable in (render, render.load()):
        with readable.cache_strips(10**6):
            first, second = (readable.read(Window(x, 0, x + 4, H), ["rgb"])["rgb"] for x in (0, 4))
        np.testing.assert_array_equal(first, second)


def test_no_features_are_read_if_none_is_asked_for(tmp_path):
    render = mapped(tmp_path, layer("", 1) | layer("albedo", 2))
    assert render.read(render.data_window, []) == render.load([]).layers == {}


@pytest.mark.parametrize(("view_layer", "spp"), [("View", 1), ("View Layer", 64), ("View Layer.001", 4)])
def test_each_view_layer_has_its_own_spp(tmp_path, view_layer, spp):
    """Also where its name is a part of another one's."""
    counts = {"View Layer.001": 4, "View Layer": 64, "View": 1}
    channels = {k: v for name in counts for k, v in layer(f"{name}.Combined", 1).items()}
    attributes = {f"cycles.{name}.samples": str(count) for name, count in counts.items()}
    assert mapped(tmp_path, channels, attributes=attributes, view=view_layer).spp == spp


def test_the_users_spp_win_over_the_headers():
    file = open_exr(EXAMPLES / "hr.exr")
    assert map_render(file).spp == 1
    assert map_render(file, spp=7).spp == 7
