# SPDX-License-Identifier: Apache-2.0
"""What is written: reopened with OpenEXR's own reader, compared in bits."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr import part_specs
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.write_options import LAYOUTS, WriteOptions
from tests.conftest import HEADER_ONLY, picture, read_bits, rgb, same_bits, write_exr
from tests.exr.sources import SOURCES, H, W, behind_a_deep_part, everything, flat, plain, stereo, write_beside, written

#: Compressions that the OpenEXR of this machine may be too old for.
NEW = [name for name in ("htj2k256", "htj2k32", "zstd", "lj2k") if hasattr(OpenEXR, f"{name.upper()}_COMPRESSION")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layers_about_the_beauty_are_beside_it(tmp_path, layout):
    path = write_exr(tmp_path / "hr.exr", everything())
    error = np.arange(H * W, dtype=np.float32).reshape(H, W, 1)
    normal = -np.arange(H * W * 3, dtype=np.float32).reshape(H, W, 3)
    hr = map_render(open_exr(path))
    options, extra = WriteOptions(layout, pixel_type="float"), {"error": error, "denoised_normal": normal}
    write_beside(hr, options, alpha=np.ones((H, W, 1), np.float32), extra=extra)
    parts = read_bits(tmp_path / "out.exr")
    layers = flat(parts)
    assert same_bits(layers["error", "Y"], error[..., 0])
    for i, component in enumerate("XYZ"):
        assert same_bits(layers["denoised_normal", component], normal[..., i])
    if layout != "multilayer":
        assert [name for name, _ in parts[1:3]] == ["error", "denoised_normal"]
    assert len(layers) == len(everything()) + 4


@pytest.mark.parametrize("source", ["everything", "karma"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_only_the_chosen_layers_are_passed_on(tmp_path, layout, source):
    """Patterns name layers, whether the file has them in one part or in several; what they keep is whole."""
    parts, attributes = SOURCES[source]
    options = WriteOptions(layout=layout, layers=("crypto*",))
    _, _, after = written(tmp_path, parts, options, **attributes)
    before, result = flat(read_bits(tmp_path / "hr.exr")), flat(after)
    chosen = {key: plane for key, plane in before.items() if key[0] == "crypto00"}
    assert len(result) == 4 + len(chosen)
    assert all(same_bits(result[key], plane) for key, plane in chosen.items())


def test_a_file_of_one_part_with_any_name_is_read_again(tmp_path):
    """The result has more parts than one, so the name of the source's only part would name a layer."""
    parts = [("shot_010", rgb(picture(8, 8)) | rgb(picture(8, 8), "albedo."), (0, 0))]
    written(tmp_path, parts, WriteOptions())
    assert map_render(open_exr(tmp_path / "out.exr")).table()[1]["source"] == "albedo"


def test_layers_none_leaves_the_beauty_alone_and_a_misspelt_layer_is_named(tmp_path):
    _, _, after = written(tmp_path, everything(), WriteOptions(layers=("none",)))
    assert [list(channels) for _, channels in after] == [["A", "B", "G", "R"]]
    names = "Z, albedo, crypto00, id, mask"
    with pytest.raises(InputError, match=rf"--layers 'cripto': .* has no such layer; it has: {names}$"):
        written(tmp_path, everything(), WriteOptions(layers=("cripto",)))


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layers_are_passed_on_bit_for_bit(tmp_path, layout, source):
    """Half, float, uint, NaN payloads, views, doubled names: nothing but the beauty changes, nothing is lost."""
    parts, attributes = SOURCES[source]
    _, _, after = written(tmp_path, parts, WriteOptions(layout=layout), **attributes)
    hr = map_render(open_exr(tmp_path / "hr.exr"))
    replaced = {(c.part, c.name) for c in hr.beauty_channels}

    def planes(parts, leave=()):
        return sorted(
            (str(plane.dtype), plane.tobytes())
            for index, (_, channels) in enumerate(parts)
            for name, plane in channels.items()
            if (index, name) not in leave
        )

    before = planes(read_bits(tmp_path / "hr.exr"), replaced)
    result = planes(after)
    assert len(result) == len(before) + len(replaced)
    for plane in before:
        assert plane in result
        result.remove(plane)


def test_tiled_parts_of_mixed_types_are_passed_on(tmp_path):
    """A renderer's tiled multi-part file, one part of which holds half and float."""
    tile = OpenEXR.TileDescription()
    tile.xSize = tile.ySize = 16
    parts = []
    for name, channels in (
        ("rgba", rgb(picture(H, W))),
        ("mix", {"m.X": plain(1).astype(np.float16), "m.id": plain(2)}),
    ):
        header = {"type": OpenEXR.tiledimage, "tiles": tile, "compression": OpenEXR.ZIP_COMPRESSION}
        parts.append(OpenEXR.Part(header, channels, name))
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "hr.exr"))
    write_beside(map_render(open_exr(tmp_path / "hr.exr")))
    after = flat(read_bits(tmp_path / "out.exr"))
    assert same_bits(after[("m", "X")], plain(1).astype(np.float16))
    assert same_bits(after[("m", "id")], plain(2))


@pytest.mark.parametrize("stored", ["one part", "left, right", "left.rgba, right.rgba", "rgba.left, rgba.right"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_keeps_all_views(tmp_path, layout, stored):
    """They are found in the result as in the HRLS, with layers of one name in each, of several pixel types."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    views = {}
    for seed, view in enumerate(("left", "right")):
        layers = rgb(plain(seed).astype(np.float16)[..., None].repeat(3, axis=-1))
        views[view] = layers | {"N.X": plain(seed + 5), "N.Y": plain(seed + 6), "N.Z": plain(seed + 7)}
        views[view] |= {"Z": plain(seed + 9)}
    if stored == "one part":
        named = {".".join([*key.split(".")[:-1], "right", key[-1]]): v for key, v in views["right"].items()}
        parts = [OpenEXR.Part(header | {"multiView": ["left", "right"]}, views["left"] | named)]
    else:
        names = zip(stored.split(", "), views, strict=True)
        parts = [OpenEXR.Part(header | {"view": view}, views[view], name) for name, view in names]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "hr.exr"))
    hr = map_render(open_exr(tmp_path / "hr.exr"))
    fused = np.ones((H, W, 3), np.float32)
    write_beside(hr, WriteOptions(layout), fused)
    assert (hr.view, hr.other_views) == ("left", ["right"])
    for view in views:
        before, after = (map_render(open_exr(tmp_path / name), view=view) for name in ("hr.exr", "out.exr"))
        assert (after.view, after.other_views) == (view, before.other_views)
        expected, pixels = (render.read(render.data_window) for render in (before, after))
        if view == "left":
            expected["rgb"] = fused
        assert expected.keys() == pixels.keys() == {"rgb", "normal"}
        assert all(same_bits(pixels[name], expected[name]) for name in expected)
    names = [part.name for part in open_exr(tmp_path / "out.exr").parts]
    assert len(set(names)) == len(names) and not any(name.endswith("2") for name in names)


def test_nuke_layout_keeps_views_apart(tmp_path):
    _, out, _ = written(tmp_path, stereo(), WriteOptions(layout="nuke"), multiView=["right", "left"])
    views = {part.name: part.view for part in open_exr(out).parts}
    expected = ["rgba.right", "rgba.left", "diffuse.right", "diffuse.left"]
    assert views == {name: name.partition(".")[2] for name in expected}


@pytest.mark.parametrize("layout", ["spec", "nuke"])
@pytest.mark.parametrize("layers", [(), ("none",)])
def test_every_part_of_a_stereo_file_is_of_one_view(tmp_path, layout, layers):
    """The fused beauty and a layer about it, too. The attribute of a part with several views is not in the result."""
    hr = map_render(open_exr(write_exr(tmp_path / "hr.exr", stereo(), multiView=["right", "left"])), view="left")
    pixels, error = np.ones((H, W, 3), np.float32), {"error": np.ones((H, W, 1), np.float32)}
    write_beside(hr, WriteOptions(layout, layers=layers), pixels, pixels[..., :1], extra=error)
    result = open_exr(tmp_path / "out.exr")
    assert "multiView" not in result.metadata
    assert [part.view for part in result.parts[:2]] == ["left", "left"]
    assert {part.view for part in result.parts[2:]} == (set() if layers else {"left", "right"})
    assert {layer.name for layer in layers_of(result)} <= {"", "error", "diffuse", "depth"}


def test_a_damaged_layer_names_the_input(tmp_path):
    """A truncated HRLS is the input's fault, also when only a passed-on layer is hit."""
    noise = np.random.default_rng(0).random((300, 64), dtype=np.float32)
    path = write_exr(tmp_path / "hr.exr", [("rgba", rgb(picture(300, 64)), (0, 0)), ("z", {"z.Z": noise}, (0, 0))])
    path.write_bytes(path.read_bytes()[:-20000])
    with pytest.raises(InputError, match=r"hr\.exr: part 1 \(z\).* can't be read"):
        write_beside(map_render(open_exr(path)))
    assert not (tmp_path / "out.exr").exists()


def test_the_fused_beauty_comes_first(tmp_path):
    fused, _, parts = written(tmp_path, everything())
    name, channels = parts[0]
    assert name == "rgba"
    assert set(channels) == {"R", "G", "B", "A"}
    assert channels["G"].dtype == np.float16  # as the HRLS has it
    np.testing.assert_array_equal(channels["G"], fused[..., 1].astype(np.float16))
    np.testing.assert_array_equal(channels["A"], np.float16(0.25))


def test_multi_part_files_keep_their_parts(tmp_path):
    """Blender 5's parts: the beauty's moves to the front, the others stay as they were, windows and all."""
    source = [
        ("VL.Depth", {"VL.Depth.Z": picture(H, W)[..., 0]}, (0, 0)),
        ("VL.Combined", rgb(picture(H, W), "VL.Combined."), (0, 0)),
        ("VL.Mist", {"VL.Mist.Z": picture(20, 10)[..., 1]}, (5, -3)),
    ]
    _, out, parts = written(tmp_path, source)
    assert [name for name, _ in parts] == ["VL.Combined", "VL.Depth", "VL.Mist"]
    assert same_bits(parts[1][1]["VL.Depth.Z"], source[0][1]["VL.Depth.Z"])
    assert same_bits(parts[2][1]["VL.Mist.Z"], source[2][1]["VL.Mist.Z"])
    window = open_exr(out).parts[2].data_window
    assert (window.x0, window.y0, window.width, window.height) == (5, -3, 10, 20)


def test_windows_and_metadata_are_kept(tmp_path):
    display = (np.array([0, 0], np.int32), np.array([99, 79], np.int32))
    _, out, _ = written(
        tmp_path,
        [("", everything(), (-4, -6))],
        display=display,
        framesPerSecond=(24000, 1001),
        pixelAspectRatio=2.0,
        capDate="2026:01:01 00:00:00",
        screenWindowWidth=1.25,
        screenWindowCenter=np.array([0.5, 0.25], np.float32),
        shot="sq010",
    )
    with OpenEXR.File(str(out), header_only=HEADER_ONLY) as file:
        for part in file.parts:
            low, high = part.header["dataWindow"]
            assert (*low, *high) == (-4, -6, W - 5, H - 7)
            assert (*part.header["displayWindow"][0], *part.header["displayWindow"][1]) == (0, 0, 99, 79)
            assert part.header["pixelAspectRatio"] == 2
            assert part.header["capDate"] == "2026:01:01 00:00:00"
            assert (part.header["screenWindowWidth"], *part.header["screenWindowCenter"]) == (1.25, 0.5, 0.25)
        assert file.parts[0].header["shot"] == "sq010"
        assert file.parts[0].header["msspl/model"] == "test"
        assert tuple(file.parts[0].header["framesPerSecond"]) == (24000, 1001)


def test_long_metadata_is_not_multiplied(tmp_path):
    """A cryptomatte manifest of a single-part file appears once, beside the beauty, however many parts it becomes."""
    for layout in ("spec", "nuke"):
        _, out, _ = written(
            tmp_path, everything(), WriteOptions(layout=layout), **{"cryptomatte/1/manifest": "x" * 999}
        )
        with OpenEXR.File(str(out), header_only=HEADER_ONLY) as file:
            assert ["cryptomatte/1/manifest" in part.header for part in file.parts].count(True) == 1
            assert "cryptomatte/1/manifest" in file.parts[0].header


@pytest.mark.parametrize("kind", ["half", "float"])
@pytest.mark.parametrize("compression", ["none", "zips", "piz", "dwaa", *NEW])
def test_pixel_type_and_compression_of_the_beauty(tmp_path, kind, compression):
    source = everything()
    _, out, parts = written(tmp_path, source, WriteOptions(pixel_type=kind, compression=compression))
    assert parts[0][1]["R"].dtype == {"half": np.float16, "float": np.float32}[kind]
    file = open_exr(out)
    assert file.parts[0].compression == compression
    assert all(part.compression == "zip" for part in file.parts[1:])
    assert same_bits(flat(parts)[("id", "X")], source["id.X"])


def test_zip_is_fast_rather_than_small(tmp_path):
    """The zlib header of a chunk names the effort: here of the only chunk, in a file of 2 KB."""
    values = picture(16, 16)
    write_beside(map_render(open_exr(write_exr(tmp_path / "hr.exr", rgb(values.astype(np.float16))))), None, values)
    fastest, default = b"\x78\x01", b"\x78\x5e"
    assert fastest in (tmp_path / "out.exr").read_bytes()
    assert default in (tmp_path / "hr.exr").read_bytes()


def test_lossy_sources_are_not_compressed_a_second_time(tmp_path):
    """Layers decoded from DWA are stored without loss: encoding them again would change them."""
    path = write_exr(tmp_path / "hr.exr", everything(), compression=OpenEXR.DWAA_COMPRESSION)
    decoded = dict(read_bits(path)[0][1])
    write_beside(map_render(open_exr(path)), alpha=np.ones((H, W, 1), np.float32))
    after = flat(read_bits(tmp_path / "out.exr"))
    assert same_bits(after[("albedo", "G")], decoded["albedo.G"])
    assert open_exr(tmp_path / "out.exr").parts[0].compression == "zip"


def test_nuke_layout_names_layers_by_part_alone(tmp_path):
    _, _, parts = written(tmp_path, everything(), WriteOptions(layout="nuke"))
    names = {name: set(channels) for name, channels in parts}
    assert names["rgba"] == {"R", "G", "B", "A"}
    assert names["crypto00"] == {"R", "G"}
    assert names["depth"] == {"Z"}


def test_values_beyond_half_are_written_as_its_largest(tmp_path):
    hr = map_render(open_exr(write_exr(tmp_path / "hr.exr", rgb(picture(H, W).astype(np.float16)))))
    write_beside(hr, None, np.full((H, W, 3), 1e6, np.float32))
    assert (read_bits(tmp_path / "out.exr")[0][1]["R"] == 65504).all()


def test_the_aces_container_flag_is_not_passed_on(tmp_path):
    """ST 2065-4 forbids it on compressed or multi-layer files."""
    for layout in ("spec", "multilayer"):
        _, out, _ = written(tmp_path, everything(), WriteOptions(layout=layout), acesImageContainerFlag=1)
        assert "acesImageContainerFlag" not in open_exr(out).metadata


_WRITE = """
import resource, sys
import numpy as np
from pathlib import Path
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import MssplError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.contents import FileContents
from oiio_msspl.exr.writer import write_fused
limit = int(sys.argv[2])
if limit:
    import signal
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # as a full disk: write() fails
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
folder = Path(sys.argv[1])
hr = map_render(open_exr(folder / "hr.exr"))
rgb = np.random.default_rng(0).random((hr.data_window.height, hr.data_window.width, 3), dtype=np.float32)
print("writing", flush=True)
try:
    for _ in range(int(sys.argv[3])):
        contents = FileContents(hr.file, hr.beauty_channels, WriteOptions(), rgb)
        write_fused(folder / "out.exr", contents, overwrite=True)
except MssplError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits")
@pytest.mark.parametrize("limit", [1000, 100_000, 700_000])
def test_a_full_disk_leaves_the_old_file(tmp_path, limit):
    """Wherever the disk fills up - header, beauty, passed-on layers - the old file stays and no scrap is left."""
    noise = np.random.default_rng(1).random((300, 200, 3)).astype(np.float32)
    write_exr(tmp_path / "hr.exr", rgb(noise) | rgb(noise * 2, "albedo."))
    (tmp_path / "out.exr").write_text("old")
    done = subprocess.run(
        [sys.executable, "-c", _WRITE, str(tmp_path), str(limit), "1"], capture_output=True, text=True
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "the target is as it was" in done.stdout
    assert (tmp_path / "out.exr").read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["hr.exr", "out.exr"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_killed_half_way_the_old_file_is_whole(tmp_path):
    noise = np.random.default_rng(1).random((300, 200, 3)).astype(np.float32)
    write_exr(tmp_path / "hr.exr", rgb(noise) | rgb(noise * 2, "albedo."))
    (tmp_path / "out.exr").write_text("old")
    for delay in (0.0, 0.02, 0.05):
        process = subprocess.Popen([sys.executable, "-c", _WRITE, str(tmp_path), "0", "100"], stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
        content = (tmp_path / "out.exr").read_bytes()
        if content != b"old":
            file = open_exr(tmp_path / "out.exr")  # a whole frame from an earlier turn of the loop
            assert np.isfinite(file.read(file.parts[0].channels, file.parts[0].data_window)).all()


def test_an_unwritable_path_is_our_failure_not_a_traceback(tmp_path, monkeypatch):
    hr = map_render(open_exr(write_exr(tmp_path / "hr.exr", rgb(picture(H, W)))))
    monkeypatch.setattr(oiio.ImageOutput, "create", staticmethod(lambda path: None))
    with pytest.raises(MssplError, match=r"out\.exr: can't be written"):
        write_beside(hr)


@pytest.mark.parametrize("layers", [(), ("depth",)])
def test_a_flat_layer_keeps_its_name_behind_a_deep_part(tmp_path, layers):
    """The deep part's Z does not take the place of the flat one."""
    channels = rgb(picture(8, 8)) | {"Z": picture(8, 8)[..., 0]}
    hr = map_render(open_exr(behind_a_deep_part(tmp_path / "hr.exr", channels)))
    (said,) = write_beside(hr, WriteOptions(layers=layers))
    assert said == "part 0 (default) is deep and was not passed on"
    assert [name for name, _ in read_bits(tmp_path / "out.exr")] == ["rgba", "depth"]


@pytest.mark.parametrize("layers", [(), ("none",)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_all_parts_share_may_be_said_by_one_of_them(tmp_path, layout, layers):
    """OpenEXR lets the first part alone say it. The beauty, which is written first, is another one."""
    chromaticities = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    time = OpenEXR.TimeCode(1, 2, 3, 4, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    parts = [
        OpenEXR.Part(header | {"chromaticities": chromaticities, "timeCode": time}, {"Z": plain(0)}, "depth"),
        OpenEXR.Part(dict(header), {k: np.ascontiguousarray(v) for k, v in rgb(picture(H, W)).items()}, "rgba"),
        OpenEXR.Part(dict(header), {"mask.X": plain(1), "id.X": np.ones((H, W), np.uint32)}, "mask"),
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "hr.exr"))
    write_beside(map_render(open_exr(tmp_path / "hr.exr")), WriteOptions(layout, layers=layers))
    with OpenEXR.File(str(tmp_path / "out.exr"), header_only=HEADER_ONLY) as out:
        for part in out.parts:
            np.testing.assert_allclose(part.header["chromaticities"], chromaticities, rtol=1e-6)
            assert str(part.header["timeCode"]) == str(time)


@pytest.mark.parametrize("layout", ["spec", "nuke"])
def test_parts_keep_their_names_and_made_up_names_give_way(tmp_path, layout):
    """The beauty's part holds a depth and a mask, for which no part is named."""
    beauty = rgb(picture(H, W)) | {"Z": plain(0), "matte": plain(1).astype(np.float16)}
    parts = [("rgba", beauty, (0, 0)), ("other", {"X": plain(2)}, (0, 0)), ("depth", {"Y": plain(3)}, (0, 0))]
    _, _, after = written(tmp_path, parts, WriteOptions(layout))
    channels = {name: list(planes) for name, planes in after}
    assert (channels["other"], channels["depth"]) == (["X"], ["Y"])
    assert (channels["depth2"], channels["other2"]) == (["Z"], ["matte"])


@pytest.mark.parametrize("layout", ["spec", "nuke"])
def test_layers_keep_their_names_and_made_up_names_give_way(tmp_path, layout):
    """A plain depth beside a layer of that name."""
    beauty = rgb(picture(H, W)) | {"Z": plain(0), "depth.Z": plain(1)}
    _, _, after = written(tmp_path, beauty, WriteOptions(layout))
    by_name = dict(after)
    assert same_bits(next(iter(by_name["depth"].values())), plain(1))
    assert same_bits(by_name["depth2"]["Z"], plain(0))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_alpha_of_integers_is_passed_on(tmp_path, layout):
    """It is no alpha, so the fused alpha does not take its place."""
    ids = np.arange(H * W, dtype=np.uint32).reshape(H, W)
    _, _, after = written(tmp_path, rgb(picture(H, W)) | {"A": ids}, WriteOptions(layout))
    (plane,) = [planes["A"] for _, planes in after if "A" in planes]
    assert same_bits(plane, ids)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_part_keeps_the_colour_space(tmp_path, layout):
    """A part that is split into layers tells their space once, and programs read part by part."""
    channels = rgb(picture(H, W)) | rgb(picture(H, W), "light_1.")
    written(tmp_path, channels, WriteOptions(layout), colorInteropID="lin_ap1_scene")
    with OpenEXR.File(str(tmp_path / "out.exr"), header_only=True) as out:
        assert [part.header.get("colorInteropID") for part in out.parts] == ["lin_ap1_scene"] * len(out.parts)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("compression", NEW)
def test_compressions_of_new_versions_are_kept(tmp_path, compression, layout):
    """All but lj2k, which changes colours, are kept bit for bit in every part."""
    method = getattr(OpenEXR, f"{compression.upper()}_COMPRESSION")
    before = everything()
    _, out, after = written(tmp_path, before, WriteOptions(layout), compression=method)
    kept = "zip" if compression == "lj2k" else compression
    assert {part.compression for part in open_exr(out).parts} == {kept}
    if compression != "lj2k":
        assert same_bits(flat(after)["crypto00", "R"], before["crypto00.R"])


def test_a_compression_that_the_library_lacks_is_refused(tmp_path, monkeypatch):
    """OpenImageIO would write zip without a word."""
    monkeypatch.setattr(part_specs, "_compress", lambda spec, name: spec.attribute("compression", "future"))
    with pytest.raises(InputError, match="--compression zips: this OpenImageIO writes zip instead; name another one"):
        written(tmp_path, everything(), WriteOptions(compression="zips"))
    assert not (tmp_path / "out.exr").exists()
