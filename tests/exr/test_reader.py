# SPDX-License-Identifier: Apache-2.0
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr, reason_of, use_threads
from oiio_msspl.exr.render import Window
from tests.conftest import HEADER_ONLY, SHARED, needs_shared, picture, rgb, write_exr

COMPRESSIONS = ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"]
COMPRESSIONS += [n for n in ("HTJ2K256", "HTJ2K32", "ZSTD", "LJ2K") if hasattr(OpenEXR, f"{n}_COMPRESSION")]


def test_pixels_are_read_by_rectangle(tmp_path):
    """Any rectangle of the data window equals that rectangle of the whole, whatever rows the strips begin on."""
    image = picture(150, 40)
    file = open_exr(write_exr(tmp_path / "a.exr", [("", rgb(image), (-7, -100))]))
    part = file.parts[0]
    assert part.data_window == Window(-7, -100, 33, 50)
    window = Window(0, -31, 20, 37)
    rows, columns = window.slices(part.data_window)
    np.testing.assert_array_equal(file.read(part.channels, window), image[rows, columns])


def test_outside_the_data_window_is_zero(tmp_path):
    file = open_exr(write_exr(tmp_path / "a.exr", rgb(picture(8, 8))))
    pixels = file.read(file.parts[0].channels, Window(-2, -2, 10, 10))
    assert not pixels[:2].any()
    assert not pixels[:, -2:].any()
    assert pixels[2:10, 2:10].any()


def test_where_parts_differ_the_first_one_names_the_metadata(tmp_path):
    """Otherwise they hold together."""
    parts = [
        (name, rgb(picture(4, 4)), (0, 0), own) for name, own in (("a", {"who": "a"}), ("b", {"who": "b", "at": "b"}))
    ]
    metadata = open_exr(write_exr(tmp_path / "a.exr", parts)).metadata
    assert (metadata["who"], metadata["at"]) == ("a", "b")


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_compression_is_read(tmp_path, compression):
    image = picture(70, 33).astype(np.float16)
    path = write_exr(tmp_path / "a.exr", rgb(image), compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
    file = open_exr(path)
    values = file.read(file.parts[0].channels, file.parts[0].data_window)
    lossy = compression in ("B44", "B44A", "DWAA", "DWAB", "LJ2K")
    np.testing.assert_allclose(values, image.astype(np.float32), rtol=0.1 if lossy else 0, atol=0.1 if lossy else 0)


def test_half_float_and_uint_keep_their_types(tmp_path):
    image = picture(8, 8)
    channels = rgb(image.astype(np.float16)) | {"Z": image[..., 0], "id": np.full((8, 8), 2**32 - 5, np.uint32)}
    file = open_exr(write_exr(tmp_path / "a.exr", channels))
    part = file.parts[0]
    assert {c.name: c.type for c in part.channels} == {
        "R": "half",
        "G": "half",
        "B": "half",
        "Z": "float",
        "id": "uint",
    }
    (ids,) = file.native_planes(part, [c for c in part.channels if c.name == "id"], on_disk=False).values()
    assert ids.dtype == np.uint32
    assert (ids == 2**32 - 5).all()


def test_channels_of_several_parts_are_read_together(tmp_path):
    image = picture(8, 8)
    parts = [("rgba", rgb(image), (0, 0)), ("albedo", rgb(image * 2), (0, 0))]
    file = open_exr(write_exr(tmp_path / "a.exr", parts))
    wanted = [file.parts[1].channels[0], file.parts[0].channels[2]]
    values = file.read(wanted, file.parts[0].data_window)
    np.testing.assert_allclose(values, np.stack([image[..., 0] * 2, image[..., 2]], -1))


def test_a_truncated_file_says_where_it_ends(tmp_path):
    rng = np.random.default_rng(0)
    path = write_exr(tmp_path / "a.exr", rgb(rng.random((256, 64, 3)).astype(np.float32)))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    file = open_exr(path)
    with pytest.raises(InputError, match=r"a\.exr: part 0 .*rows \d+ to \d+ can't be read"):
        file.read(file.parts[0].channels, file.parts[0].data_window)


def test_a_damaged_header_is_told_in_one_error(tmp_path):
    """OpenImageIO quotes each piece of the header that it can't read."""
    manifest = ", ".join(f'"object {number}": "{number:08x}"' for number in range(400))
    path = write_exr(tmp_path / "a.exr", rgb(picture(8, 8)), **{"cryptomatte/1/manifest": manifest})
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match="can't be opened as an EXR") as caught:
        open_exr(path)
    assert len(str(caught.value)) < 400 and str(caught.value).count("EXR Error") <= 1


def test_subsampled_channels_are_to_be_converted(tmp_path):
    path = write_exr(tmp_path / "a.exr", rgb(picture(8, 8)))
    header = path.read_bytes()
    sampling = header.index(b"B\0", header.index(b"chlist")) + 2 + 8  # behind name, type and reserved bytes
    path.write_bytes(header[:sampling] + 2 * b"\2\0\0\0" + header[sampling + 8 :])
    with pytest.raises(InputError, match=r"a\.exr: can't be opened .*ubsampled.*; convert it to RGB"):
        open_exr(path)


def test_a_part_that_cannot_be_read_is_not_taken_for_the_end(tmp_path):
    """The parts behind it would be left out, too."""
    small = np.ones((4, 4), np.float16)
    display = (np.array([0, 0], np.int32), np.array([7, 7], np.int32))
    header = {"type": OpenEXR.scanlineimage, "displayWindow": display, "dataWindow": display}
    parts = [
        OpenEXR.Part(dict(header), {k: np.ascontiguousarray(v) for k, v in rgb(picture(8, 8)).items()}, "rgba"),
        OpenEXR.Part(dict(header), {"RY": OpenEXR.Channel("RY", small, 2, 2)}, "chroma"),
        OpenEXR.Part(dict(header), {"Z": picture(8, 8)[..., 0].copy()}, "depth"),
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr: can't be opened .*ubsampled.*\"RY\".*; convert it to RGB"):
        open_exr(tmp_path / "a.exr")


def test_a_long_error_is_cut():
    class Source:
        def geterror(self):
            return f"  channel {'x' * 5000}\nmore"

    assert reason_of(Source()) == f"channel {'x' * 192}..."


@pytest.mark.skipif(not HEADER_ONLY, reason="OpenEXR 3.3 can't read all of them")
@needs_shared("exr")
@pytest.mark.parametrize("path", sorted(SHARED.glob("exr/**/*.exr")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_real_headers_are_read(path):
    """Every real file opens, and its channels and windows are what OpenEXR's own reader finds."""
    file = open_exr(path)
    with OpenEXR.File(str(path), header_only=HEADER_ONLY) as expected:
        assert len(file.parts) == len(expected.parts)
        for part, stored in zip(file.parts, expected.parts, strict=True):
            assert {c.name for c in part.channels} == {c.name for c in stored.header["channels"]}
            low, high = stored.header["dataWindow"]
            assert part.data_window == Window(low[0], low[1], high[0] + 1, high[1] + 1)


def test_files_are_decoded_with_as_many_threads_as_are_allowed():
    names = ("threads", "exr_threads")
    before = [oiio.get_int_attribute(name) for name in names]
    try:
        for count in (1, 0):  # 0 changes nothing
            use_threads(count)
            assert [oiio.get_int_attribute(name) for name in names] == [1, 1]
    finally:
        for name, count in zip(names, before, strict=True):
            oiio.attribute(name, count)
