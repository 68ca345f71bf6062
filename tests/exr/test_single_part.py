# SPDX-License-Identifier: Apache-2.0
import OpenEXR
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.exr.writer import check_layout
from tests.conftest import HEADER_ONLY, picture, rgb, write_exr
from tests.exr.sources import H, W, everything, stereo, write_beside, written


def test_multilayer_layout_is_one_part(tmp_path):
    _, _, parts = written(tmp_path, everything(), WriteOptions(layout="multilayer"))
    assert len(parts) == 1
    assert parts[0][1].keys() == everything().keys()


def test_multilayer_refuses_parts_of_different_windows(tmp_path):
    source = [("rgba", rgb(picture(H, W)), (0, 0)), ("mist", {"mist.Z": picture(20, 10)[..., 1]}, (5, 3))]
    with pytest.raises(InputError, match=r"part 'mist' of .* one part can hold only one, use --layout spec"):
        written(tmp_path, source, WriteOptions(layout="multilayer"))
    assert not (tmp_path / "out.exr").exists()


def test_a_channel_of_an_added_layer_and_one_of_two_parts_are_told_apart(tmp_path):
    """By the headers alone."""
    multilayer = WriteOptions(layout="multilayer")
    plane = picture(H, W)[..., 0]
    one = map_render(open_exr(write_exr(tmp_path / "one.exr", rgb(picture(H, W)) | {"error.Y": plane})))
    check_layout(one.file, one.beauty_channels, multilayer, [])
    with pytest.raises(InputError, match=r"--error-layer: .*one\.exr has a layer 'error' of its own"):
        check_layout(one.file, one.beauty_channels, multilayer, ["error"])
    parts = [("rgba", rgb(picture(H, W)) | {"a.Y": plane}, (0, 0)), ("more", {"a.Y": plane}, (0, 0))]
    two = map_render(open_exr(write_exr(tmp_path / "two.exr", parts)))
    with pytest.raises(InputError, match=r"two parts of .*two\.exr hold a channel 'a\.Y'; use --layout spec"):
        check_layout(two.file, two.beauty_channels, multilayer, [])


@pytest.mark.parametrize(
    ("layers", "views"), [((), ("right", "left")), (("none",), ("right",)), (("*.A",), ("right", "left"))]
)
def test_only_the_views_that_are_written_are_named(tmp_path, layers, views):
    options = WriteOptions(layout="multilayer", layers=layers)
    _, out, _ = written(tmp_path, stereo(), options, multiView=["right", "left"])
    assert open_exr(out).metadata["multiView"] == views


def test_metadata_of_all_parts_is_kept(tmp_path):
    """Cryptomatte's manifests among it. A part that is left out takes its own along; the beauty's counts most."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    manifest = {"cryptomatte/abc1234/name": "CryptoObject", "cryptomatte/abc1234/manifest": '{"box": "00ff"}'}
    plane = picture(H, W)[..., 0]
    source = [
        OpenEXR.Part(header | {"comments": "beauty"}, rgb(picture(H, W)), "rgba"),
        OpenEXR.Part(header | manifest | {"comments": "ids"}, {"R": plane, "G": plane}, "CryptoObject00"),
        OpenEXR.Part(header | {"far": 10.0, "view": "left"}, {"Z": plane}, "depth"),
    ]
    with OpenEXR.File(source) as file:
        file.write(str(tmp_path / "hr.exr"))
    hr = map_render(open_exr(tmp_path / "hr.exr"))
    for layers, is_kept in (((), True), (("depth",), False)):
        write_beside(hr, WriteOptions(layout="multilayer", layers=layers), overwrite=True)
        with OpenEXR.File(str(tmp_path / "out.exr"), header_only=HEADER_ONLY) as file:
            written_header = dict(file.parts[0].header)
        assert (written_header["comments"], written_header["far"]) == ("beauty", 10)
        assert "view" not in written_header
        assert written_header.get("name", "Part0") == "Part0"  # a name that OpenEXR 3.3 makes up
        assert (manifest.items() <= written_header.items()) == is_kept
