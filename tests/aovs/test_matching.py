# SPDX-License-Identifier: Apache-2.0
import numpy as np
import OpenEXR
import pytest

from oiio_msspl.aovs.mapping import parse_map_options, read_map_file
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from tests.aovs.renders import H, W, layer, mapped, plane, sources
from tests.conftest import SHARED, needs_shared, rgb, write_exr
from tests.exr.sources import behind_a_deep_part


def test_integers_are_no_light(tmp_path):
    ids = {c: np.full((H, W), 4000, np.uint32) for c in "RGB"}
    with pytest.raises(InputError, match="no layer with R, G, B among"):
        mapped(tmp_path, ids)


def test_an_aov_of_integers_does_not_refuse_the_frame(tmp_path):
    """Another layer is read in its place, if there is one."""
    channels = layer("", 1) | {f"albedo.{c}": np.full((H, W), 4000, np.uint32) for c in "RGB"}
    render = mapped(tmp_path, channels)
    assert sources(render) == {"rgb": "R G B"}
    assert render.notes == [
        "albedo: layer 'albedo' has channels R, G, B of integers (ids, not light), not R, G, B (or X, Y, Z)"
    ]
    assert sources(mapped(tmp_path, channels | layer("basecolor", 2)))["albedo"] == "basecolor"


def test_an_alpha_of_integers_is_none(tmp_path):
    render = mapped(tmp_path, layer("", 1) | {"A": np.ones((H, W), np.uint32)})
    assert render.alpha is None and [c.name for c in render.beauty_channels] == ["R", "G", "B"]
    assert not render.notes


def test_a_beauty_of_the_wrong_channel_count_is_not_said_to_be_missing(tmp_path):
    with pytest.raises(InputError, match=r"rgb: layer 'key' has channels Y, not R, G, B"):
        mapped(tmp_path, layer("", 1) | layer("key", 2, "Y"), {"rgb": "key"})


def test_integers_are_said_of_the_file_that_holds_them(tmp_path):
    ids = {f"ids.{c}": np.full((H, W), 4000, np.uint32) for c in "RGB"}
    with pytest.raises(InputError, match=r"albedo: layer 'other\.exr: ids' has channels R, G, B of integers"):
        beside(tmp_path, ids, ["albedo={}:ids"])


def test_a_single_unnamed_view_is_the_one_that_is_meant(tmp_path):
    """--view-layer goes to both files; an LRHS rendered alone may have no view name."""
    assert mapped(tmp_path, layer("", 1), view="left").view == ""


def test_karmas_layers_come_from_part_names_alone(tmp_path):
    parts = [
        ("C", layer("", 1, "RGBA"), (0, 0)),
        ("albedo", layer("", 2), (0, 0)),
        ("N", {"x": plane(0), "y": plane(0), "z": plane(1)}, (0, 0)),
        ("combineddiffuse", layer("", 3), (0, 0)),
    ]
    render = mapped(tmp_path, parts)
    assert render.renderer == "Karma"
    assert sources(render) == {
        "rgb": "C",
        "albedo": "albedo",
        "normal": "N",
        "diffuse": "combineddiffuse",
        "alpha": "A",
    }


def test_blender_5_writes_the_layer_in_part_and_channel(tmp_path):
    names = ["Combined", "Diffuse Direct", "Diffuse Indirect", "Diffuse Color"]
    parts = [(f"ViewLayer.{n}", layer(f"ViewLayer.{n}", i + 1), (0, 0)) for i, n in enumerate(names)]
    render = mapped(tmp_path, parts, attributes={"cycles.ViewLayer.samples": "16"})
    assert render.spp == 16
    values = render.read(render.data_window)
    np.testing.assert_allclose(values["diffuse"][0, 0], np.array([5, 5.2, 5.4]) * np.array([4, 4.1, 4.2]), rtol=1e-6)


def test_arnolds_header_says_which_aov_a_layer_holds(tmp_path):
    """An AOV of N may have any name; of several layers that hold an AOV, none is the whole."""
    channels = layer("", 1) | layer("normals", 0, "XYZ") | layer("key_diffuse", 2) | layer("fill_diffuse", 3)
    aov_of = {"normals": "N", "key_diffuse": "diffuse", "fill_diffuse": "diffuse"}
    attributes = {f"arnold/aovs/{name}/source": source for name, source in aov_of.items()}
    assert sources(mapped(tmp_path, channels, attributes=attributes)) == {"rgb": "R G B", "normal": "normals"}
    more = channels | layer("N", 0, "XYZ")
    assert sources(mapped(tmp_path, more, attributes=attributes))["normal"] == "N"


def test_luxcores_files_are_layers_of_one_frame(tmp_path):
    """One file an AOV: the others are found beside the RGB, and each alone is explained."""
    for stem, value in (("ALBEDO", 2), ("DIRECT_DIFFUSE", 3), ("INDIRECT_DIFFUSE", 4)):
        write_exr(tmp_path / f"{stem}.exr", layer("", value))
    render = mapped(tmp_path, layer("", 1), stem="RGB_IMAGEPIPELINE")
    assert render.renderer == "LuxCore"
    values = render.read(render.data_window)
    assert values["albedo"][0, 0, 0] == 2
    assert values["diffuse"][0, 0, 0] == 7
    with pytest.raises(InputError, match="LuxCore's ALBEDO alone"):
        map_render(open_exr(tmp_path / "ALBEDO.exr"))


def test_files_of_a_frame_may_have_its_name(tmp_path):
    """Those of other frames do not belong to it."""
    for stem, value in (("one.ALBEDO", 2), ("one.SHADING_NORMAL", 0), ("two.DEPTH", 3)):
        write_exr(tmp_path / f"{stem}.exr", layer("", value))
    render = mapped(tmp_path, layer("", 1), stem="one")
    assert (render.renderer, render.read(render.data_window)["albedo"][0, 0, 0]) == ("LuxCore", 2)
    assert sources(mapped(tmp_path, layer("", 1), stem="two")) == {"rgb": "R G B"}
    with pytest.raises(InputError, match=r"LuxCore's one\.ALBEDO alone"):
        map_render(open_exr(tmp_path / "one.ALBEDO.exr"))


def test_view_layers_are_told_apart(tmp_path):
    """Names with dots and spaces; the first view layer by default, another on request, never layers of two mixed."""
    channels = {}
    for i, name in enumerate(("Main.Beauty v1.2", "fg.chars")):
        channels |= layer(f"{name}.Combined", 10 * (i + 1)) | layer(f"{name}.Denoising Albedo", 10 * (i + 1) + 1)
    first = mapped(tmp_path, channels)
    assert (first.view, first.other_views) == ("Main.Beauty v1.2", ["fg.chars"])
    second = mapped(tmp_path, channels, view="fg.chars")
    values = second.read(second.data_window)
    assert values["rgb"][0, 0, 0] == 20
    assert values["albedo"][0, 0, 0] == 21
    with pytest.raises(InputError, match=r"no view or view layer 'bg'; the file has Main.Beauty v1.2, fg.chars"):
        mapped(tmp_path, channels, view="bg")


def test_stereo_views_of_one_part(tmp_path):
    channels = layer("", 1, "RGBA") | layer("left", 2, "RGBA") | {"forward.left.u": plane(0)}
    attributes = {"multiView": ["right", "left"]}
    assert mapped(tmp_path, channels, attributes=attributes).view == "right"
    left = mapped(tmp_path, channels, attributes=attributes, view="left")
    assert left.read(left.data_window)["rgb"][0, 0, 0] == 2


@pytest.mark.parametrize("views", [("left", "right"), ("right", "left")])
@pytest.mark.parametrize("layers", [("fg", "bg"), ("bg", "fg")])
@pytest.mark.parametrize("stored", ["one part", "one part, all named", "part by view", "part by layer"])
def test_the_first_view_layer_is_the_same_however_views_are_stored(tmp_path, stored, layers, views):
    """The first by name, as one part keeps no other order, in the default view."""
    pairs = [(name, view) for name in layers for view in views]
    path = tmp_path / "stereo.exr"
    if stored.startswith("one part"):
        default = "" if stored == "one part" else f".{views[0]}"
        infix = {view: default if view == views[0] else f".{view}" for view in views}
        channels = {}
        for name, view in pairs:
            channels |= layer(f"{name}.Combined{infix[view]}", 1)
        write_exr(path, channels, multiView=list(views))
    else:
        if stored == "part by view":
            pairs.sort(key=lambda pair: views.index(pair[1]))
        header = {"type": OpenEXR.scanlineimage}
        parts = [
            OpenEXR.Part(header | {"view": view}, layer(f"{name}.Combined", 1), f"{name}.Combined.{view}")
            for name, view in pairs
        ]
        with OpenEXR.File(parts) as file:
            file.write(str(path))
    render = map_render(open_exr(path))
    first, second = views
    assert render.view == f"{first}/bg"
    assert render.other_views == [f"{second}/bg", f"{first}/fg", f"{second}/fg"]


@pytest.mark.parametrize("samples", ["inf", "nan", "0", "-4", "1e999", "many"])
def test_a_header_without_a_number_of_samples_says_nothing(tmp_path, samples):
    attributes = {"cycles.ViewLayer.samples": samples}
    render = mapped(tmp_path, layer("ViewLayer.Combined", 1), attributes=attributes)
    assert (render.renderer, render.spp) == ("Cycles", None)


def test_encoded_normals_are_recognised_by_their_pixels(tmp_path):
    """n * 0.5 + 0.5 comes back as n; signed normals are left alone."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(H, W, 3))
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    for stored in (normal, normal * 0.5 + 0.5):
        render = mapped(tmp_path, layer("", 1) | rgb(stored, "normal."))
        np.testing.assert_allclose(render.read(render.data_window)["normal"], normal, atol=1e-6)


def test_signed_normals_that_all_point_one_way_are_left_alone(tmp_path):
    """Such as those of a camera above the ground: no component is negative."""
    normal = np.abs(np.random.default_rng(0).normal(size=(H, W, 3)))
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    render = mapped(tmp_path, layer("", 1) | rgb(normal, "normal."))
    np.testing.assert_array_equal(render.read(render.data_window)["normal"], normal)


def test_encoded_normals_are_recognised_wherever_there_is_a_surface(tmp_path):
    """The sky fills the middle of the frame, where the normal is black."""
    stored = np.zeros((400, W, 3), np.float32)
    stored[300:] = 0.5, 0.5, 1
    light = {c: np.ones((400, W), np.float32) for c in "RGB"}
    render = mapped(tmp_path, light | rgb(stored, "normal."))
    np.testing.assert_array_equal(render.read(render.data_window)["normal"][-1, 0], [0, 0, 1])
    assert not render.read(render.data_window)["normal"][H].any()


def test_the_users_mapping_wins(tmp_path):
    channels = layer("", 1) | layer("albedo", 2) | layer("my_albedo", 3)
    render = mapped(tmp_path, channels, parse_map_options(["albedo=my_albedo"]))
    assert render.read(render.data_window)["albedo"][0, 0, 0] == 3


def test_a_mapping_may_add_layers_or_name_another_file(tmp_path):
    path = write_exr(tmp_path / "other.exr", layer("", 7))
    mapping = parse_map_options(["diffuse=direct+indirect", f"albedo={path}"])
    render = mapped(tmp_path, layer("", 1) | layer("direct", 2) | layer("indirect", 3), mapping)
    values = render.read(render.data_window)
    assert values["diffuse"][0, 0, 0] == 5
    assert values["albedo"][0, 0, 0] == 7


def beside(tmp_path, channels, mapping, stem="other", **options):
    """A plain render whose features are mapped to another EXR with these channels."""
    path = write_exr(tmp_path / f"{stem}.exr", channels)
    return mapped(tmp_path, layer("", 1), parse_map_options([text.format(path) for text in mapping]), **options)


@pytest.mark.parametrize("name", ["", "N"])
def test_encoded_normals_of_another_exr_are_recognised(tmp_path, name):
    stored = np.full((H, W, 3), (0.5, 0.5, 1), np.float32)
    render = beside(tmp_path, rgb(stored, f"{name}." if name else ""), ["normal={}"])
    np.testing.assert_array_equal(render.read(render.data_window)["normal"][0, 0], [0, 0, 1])


def test_another_exr_must_show_the_same_frame(tmp_path):
    """Of the same size is not enough: its pixels are read by their places."""
    path = write_exr(tmp_path / "albedo.exr", [("", layer("albedo", 3), (10, 20))])
    with pytest.raises(InputError, match=r"albedo\.exr: its display window is 8x8\+10\+20, but that of .* 8x8\+0\+0"):
        mapped(tmp_path, layer("", 1), {"albedo": f"file:{path}"})


@pytest.mark.parametrize("name", ["", ":albedo"])
def test_a_deep_part_of_another_exr_is_not_read(tmp_path, name):
    albedo = layer("albedo", 3)
    path = behind_a_deep_part(tmp_path / "albedo.exr", albedo, deep=albedo)
    render = mapped(tmp_path, layer("", 1), {"albedo": f"file:{path}{name}"})
    np.testing.assert_array_equal(render.load().layers["albedo"][..., 0], plane(3))


def test_a_layer_of_another_exr_can_be_named(tmp_path):
    """Case and view layer need not be typed, as in --map without a file."""
    channels = layer("v.Combined", 5) | layer("v.Denoising Albedo", 7) | layer("v.Paint", 8)
    for name in ("paint", "v.Paint", "V.PAINT"):
        render = beside(tmp_path, channels, [f"albedo={{}}:{name}"])
        assert render.read(render.data_window)["albedo"][0, 0, 0] == 8
        assert sources(render)["albedo"] == "other.exr: v.Paint"
    with pytest.raises(InputError, match=r"other.exr: has no layer 'Pint'; name one, as --map 'albedo=other.exr:v"):
        beside(tmp_path, channels, ["albedo={}:Pint"])


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        (layer("Combined", 5), "holds Combined, and not the albedo alone; name one"),
        (layer("", 5) | layer("paint", 7), "holds R G B, paint, and not the albedo alone; .*'albedo=other.exr:paint"),
        ({"Z": plane(1)}, "holds no layer of three channels, .*; name one, as --map 'albedo=other.exr:LAYER'"),
    ],
    ids=["only a beauty", "several", "no colour"],
)
def test_another_exr_that_is_not_the_albedo_alone_is_refused(tmp_path, channels, message):
    with pytest.raises(InputError, match=f"other.exr: {message}"):
        beside(tmp_path, channels, ["albedo={}"])


def test_of_two_view_layers_of_another_exr_that_of_the_render_is_read(tmp_path):
    names = [f"{view}.{name}" for view in "ab" for name in ("Combined", "Denoising Albedo")]
    channels = {c: p for i, name in enumerate(names) for c, p in layer(name, i).items()}
    path = write_exr(tmp_path / "other.exr", channels)
    render = mapped(tmp_path, channels, parse_map_options([f"albedo={path}:Denoising Albedo"]), view="b")
    assert render.read(render.data_window)["albedo"][0, 0, 0] == 3


def test_a_mapping_file_takes_what_the_table_takes(tmp_path):
    (tmp_path / "map.toml").write_text('diffuse = { sum = ["a", "b"], times = "c" }\n')
    channels = layer("", 1) | layer("a", 2) | layer("b", 3) | layer("c", 4)
    render = mapped(tmp_path, channels, read_map_file(tmp_path / "map.toml"))
    assert render.read(render.data_window)["diffuse"][0, 0, 0] == 20


def test_listed_channels_can_be_multiplied_by_a_layer(tmp_path):
    channels = layer("", 1) | {name: plane(4) for name in "uvw"} | layer("colour", 5)
    render = mapped(tmp_path, channels, {"diffuse": {"channels": ["u", "v", "w"], "times": "colour"}})
    assert render.read(render.data_window)["diffuse"][0, 0, 0] == 20
    assert sources(render)["diffuse"] == "u v w * colour"


def test_listed_channels_are_those_of_the_view(tmp_path):
    """Each eye has its own part, and both name the channels alike."""
    names = ["albedo.u", "albedo.v", "albedo.w"]

    def part(view, light, albedo):
        channels = layer("", light) | {name: plane(albedo) for name in names}
        header = {"type": OpenEXR.scanlineimage, "view": view}
        return OpenEXR.Part(header, channels, view)

    path = tmp_path / "stereo.exr"
    with OpenEXR.File([part("left", 1, 2), part("right", 3, 4)]) as file:
        file.write(str(path))
    for view, albedo in (("left", 2), ("right", 4)):
        render = map_render(open_exr(path), {"albedo": {"channels": names}}, view=view)
        assert render.read(render.data_window)["albedo"][0, 0, 0] == albedo


@pytest.mark.parametrize(
    ("feature", "candidate", "text"),
    [
        ("variance", {"layer": "v", "note": "of the mean"}, "v"),
        ("diffuse", {"sum": ["a", "b"], "times": "c"}, r"\(a \+ b\) \* c"),
        ("normal", {"channels": ["n.u", "n.v", "n.w"], "encoding": "auto"}, "n.u n.v n.w"),
    ],
)
def test_of_a_candidate_that_is_missing_the_layers_are_named(tmp_path, feature, candidate, text):
    with pytest.raises(InputError, match=f"{feature} is mapped to {text}, which is not there$"):
        mapped(tmp_path, layer("", 1), {feature: candidate})


def test_a_channel_that_is_mapped_is_no_layer(tmp_path):
    channels = layer("", 1) | {"Z": plane(1)}
    with pytest.raises(InputError, match="albedo is mapped to Z, which is a channel, not a layer; msspl inspect"):
        mapped(tmp_path, channels, {"albedo": "Z"})


def test_a_wrong_mapping_is_answered_with_what_is_there(tmp_path):
    channels = layer("", 1) | layer("paint", 2) | layer("facing", 0, "XYZ") | {"mask.A": plane(1)}
    with pytest.raises(InputError, match=r"albedo is mapped to pant, which is not there \(layers: facing, paint\)"):
        mapped(tmp_path, channels, {"albedo": "pant"})
    with pytest.raises(InputError, match=r"layer 'mask' has channels A, not R, G, B"):
        mapped(tmp_path, channels, {"albedo": "mask"})


def test_a_grayscale_file_has_no_beauty(tmp_path):
    with pytest.raises(InputError, match="no layer with R, G, B among: Y; write the beauty as RGB"):
        mapped(tmp_path, {"Y": plane(1)})


def test_an_aov_of_the_wrong_channel_count_is_not_used_silently(tmp_path):
    render = mapped(tmp_path, layer("", 1) | {"albedo.R": plane(1), "albedo.G": plane(1)})
    assert "albedo" not in sources(render)
    assert "albedo: layer 'albedo' has channels R, G" in render.notes[0]


def test_no_beauty_names_what_is_there(tmp_path):
    with pytest.raises(InputError, match=r"no beauty \(R, G, B\) found among: crypto00, depth"):
        mapped(tmp_path, layer("crypto00", 1, "RGBA") | {"depth.Z": plane(1)})


def test_beauty_spread_over_parts_with_odd_names(tmp_path):
    parts = [("part0", {"R": plane(1)}, (0, 0)), ("part1", {"G": plane(2)}, (0, 0)), ("part2", {"B": plane(3)}, (0, 0))]
    render = mapped(tmp_path, parts)
    np.testing.assert_array_equal(render.read(render.data_window)["rgb"][0, 0], [1, 2, 3])


REAL = {
    "arnold/rgba_N_P_diffuse_direct_specular": ("Arnold", {"rgb", "normal", "diffuse", "specular", "alpha"}),
    "cycles-4.2/cycles_border_region": ("Cycles", {"rgb", "albedo", "normal", "diffuse", "specular", "alpha"}),
    "cycles-4.2/cycles_viewlayer_dwaa16": ("Cycles", {"rgb", "albedo", "normal", "diffuse", "specular", "alpha"}),
    "cycles-4.2/cycles_viewlayer_zip32": ("Cycles", {"rgb", "albedo", "normal", "diffuse", "specular", "alpha"}),
    "cycles-5.0/cycles_two_dotted_viewlayers_piz16": (
        "Cycles",
        {"rgb", "albedo", "normal", "diffuse", "specular", "alpha"},
    ),
    "cycles-5.0/cycles_viewlayer_zip32": ("Cycles", {"rgb", "albedo", "normal", "diffuse", "specular", "alpha"}),
    "gaffer/channelTestNukePartPerLayer": ("unknown", {"rgb", "alpha"}),
    "gaffer/channelTestSinglePart": ("unknown", {"rgb", "alpha"}),
    "gaffer/multipartDefaultChannels": ("unknown", {"rgb", "alpha"}),
    "gaffer/unsupportedMultipart": ("unknown", {"rgb", "alpha"}),
    "gaffer/weirdPartNames": ("unknown", {"rgb", "alpha"}),
    "karma/rgba_crypto": ("Karma", {"rgb", "alpha"}),
    "luxcore/RGB": ("LuxCore", {"rgb", "albedo", "normal"}),
    "oiio-images/grid-overscan": ("unknown", {"rgb", "alpha"}),
    "openexr-images/BrightRingsNanInf": ("unknown", {"rgb"}),
    "openexr-images/beachball_multipart": ("unknown", {"rgb", "alpha"}),
    "openexr-images/beachball_singlepart": ("unknown", {"rgb", "alpha"}),
    "openexr-images/displaywindow_t02": ("unknown", {"rgb"}),
    "openexr-images/displaywindow_t04": ("unknown", {"rgb"}),
    "openexr-images/displaywindow_t15": ("unknown", {"rgb"}),
    "openexr-rs/negative_window": ("unknown", {"rgb", "alpha"}),
    "seesharp/rgb_variance_Y": ("unknown", {"rgb", "variance"}),
    "vray/rgba_z_crypto_diffuse_normals": ("V-Ray", {"rgb", "albedo", "normal", "alpha"}),
}


UNUSABLE = {
    "arnold/crypto_only": "no beauty",
    "arnold/deep": "deep data only",
    **{
        f"luxcore/{n}": "alone, no beauty"
        for n in ("ALBEDO", "AVG_SHADING_NORMAL", "DEPTH", "DIRECT_DIFFUSE", "INDIRECT_GLOSSY", "NOISE")
    },
}


@needs_shared("exr")
def test_every_real_file_is_expected_here():
    names = {p.relative_to(SHARED / "exr").with_suffix("").as_posix() for p in SHARED.glob("exr/**/*.exr")}
    assert names == REAL.keys() | UNUSABLE.keys()


@needs_shared("exr")
@pytest.mark.parametrize("name", REAL)
def test_real_files_are_mapped(name):
    renderer, features = REAL[name]
    render = map_render(open_exr(SHARED / "exr" / f"{name}.exr"))
    assert render.renderer == renderer
    assert sources(render).keys() == features


@needs_shared("exr")
@pytest.mark.parametrize("name", UNUSABLE)
def test_real_files_that_cannot_be_used_are_explained(name):
    with pytest.raises(InputError, match=UNUSABLE[name]):
        map_render(open_exr(SHARED / "exr" / f"{name}.exr"))
