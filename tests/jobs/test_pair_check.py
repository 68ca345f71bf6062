# SPDX-License-Identifier: Apache-2.0
"""Colour spaces of a pair of files, and checking a pair without fusing it."""

import numpy as np
import OpenImageIO as oiio
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.preview import write_preview
from oiio_msspl.exr.render import Window
from oiio_msspl.image.colour import ACESCG, REC709, conversion
from oiio_msspl.jobs.checks import check_first_pair
from oiio_msspl.jobs.files import fuse_files
from oiio_msspl.jobs.fitting import check_files
from oiio_msspl.jobs.inputs import InputOptions, map_pair
from oiio_msspl.jobs.sequence import find_shot
from tests.conftest import downsample, noisy, picture, rgb, write_exr
from tests.shots import make_shot

SPACES = {space.name: space for space in (ACESCG, REC709)}


def write_pair(folder, lr=None, hr=None):
    """lr.exr and hr.exr at x4, whose headers declare these spaces."""
    clean = picture(96, 128)
    for name, image, space in (("lr", noisy(downsample(clean, 4), 64), lr), ("hr", noisy(clean, 4, seed=1), hr)):
        buffer = oiio.ImageBuf(np.ascontiguousarray(image, np.float32))
        if space is not None and space not in SPACES:
            buffer.specmod().attribute("oiio:ColorSpace", space)
        elif space is not None:  # OpenEXR's own module writes six of the eight numbers
            buffer.specmod().attribute("chromaticities", oiio.TypeDesc("float[8]"), SPACES[space].chromaticities)
        assert buffer.write(str(folder / f"{name}.exr"))
    return folder / "lr.exr", folder / "hr.exr"


def test_two_colour_spaces_are_refused(tmp_path):
    pair = write_pair(tmp_path, "lin_rec709", "acescg")
    with pytest.raises(InputError, match=r"lr.exr is in lin_rec709 and .*hr.exr in acescg; write both in the same"):
        map_pair(*pair, InputOptions())
    assert map_pair(*pair, InputOptions(colourspace="ACEScg"))[1].space == ACESCG


@pytest.mark.skipif(oiio.VERSION < 30100, reason="OpenImageIO 3.0 does not know these names")
@pytest.mark.parametrize("encoding", ["srgb_rec709_scene", "g22_ap1_scene"])
def test_an_encoding_that_is_not_linear_is_refused(tmp_path, encoding):
    """Also if both renders have it."""
    pair = write_pair(tmp_path, encoding, encoding)
    with pytest.raises(InputError, match=rf"by its header .*lr.exr is in {encoding}, which is not linear; write it in"):
        map_pair(*pair, InputOptions())
    assert map_pair(*pair, InputOptions(colourspace="ACEScg"))[1].space == ACESCG


@pytest.mark.parametrize(
    ("lr", "hr", "space"),
    [(None, None, REC709), ("acescg", None, ACESCG), (None, "acescg", ACESCG), ("acescg", "acescg", ACESCG)],
)
def test_the_space_is_that_of_the_headers(tmp_path, lr, hr, space):
    assert map_pair(*write_pair(tmp_path, lr, hr), InputOptions())[1].space == space


def test_a_space_that_nobody_knows_is_refused(tmp_path):
    with pytest.raises(InputError, match="--colorspace 'sepia': use one of lin_rec709, acescg"):
        map_pair(*write_pair(tmp_path), InputOptions(colourspace="sepia"))


@pytest.mark.parametrize("view", [None, "Un-tone-mapped"])
def test_previews_show_the_colours_of_the_space(tmp_path, view):
    """A picture in ACEScg looks as the same picture in Rec. 709 does."""
    colours = np.random.default_rng(0).random((8, 8, 3), dtype=np.float32)
    window = Window(0, 0, 8, 8)
    write_preview(tmp_path / "a.png", colours, window, window, view)
    write_preview(tmp_path / "b.png", colours @ conversion(REC709, ACESCG).T.astype("f4"), window, window, view, ACESCG)
    a, b = (np.asarray(oiio.ImageBuf(str(tmp_path / f"{n}.png")).get_pixels(oiio.UINT8)).astype(int) for n in "ab")
    assert np.abs(a - b).max() <= 1


def test_the_preview_of_a_fused_file_knows_its_header(tmp_path, bilinear_models):
    pixels = []
    for space in ("lin_rec709", "acescg"):
        lr, hr = write_pair(tmp_path, space, space)
        options = {"model": str(bilinear_models[4]), "preview_path": tmp_path / "p.png", "overwrite": True}
        fuse_files(lr, hr, tmp_path / f"{space}.exr", **options)
        pixels.append(np.asarray(oiio.ImageBuf(str(tmp_path / "p.png")).get_pixels(oiio.FLOAT)))
    saturation = [(p.max(-1) - p.min(-1)).mean() for p in pixels]
    assert saturation[1] > 1.1 * saturation[0]


def test_checking_names_what_is_wrong(tmp_path):
    lr, hr = write_pair(tmp_path)
    assert check_files(lr, hr).fits
    assert "given twice" in check_files(hr, hr).problem
    assert "look swapped" in check_files(hr, lr).problem
    write_exr(tmp_path / "bright.exr", rgb((noisy(picture(96, 128), 4, seed=1) * 4).astype(np.float32)))
    check = check_files(lr, tmp_path / "bright.exr")
    assert not check.fits
    assert any("times as bright" in warning for warning in check.warnings)
    assert check.as_dict()["fits"] is False


def test_checking_says_what_it_could_not_judge(tmp_path):
    """A flat picture has no framing. That of a lit one is judged, and its light is not in its albedo."""
    flat = np.full((96, 128, 3), 0.2, np.float32)
    for name, image, spp in (("lr", downsample(flat, 4), 64), ("hr", flat, 4)):
        write_exr(tmp_path / f"{name}.exr", rgb(noisy(image, spp, seed=spp).astype(np.float32)))
    check = check_files(tmp_path / "lr.exr", tmp_path / "hr.exr")
    assert check.fits
    assert {"whether both show the same thing", "the framing"} <= set(check.not_judged)
    assert check.as_dict()["not_judged"] == check.not_judged


def test_the_first_whole_pair_of_a_shot_is_checked(tmp_path):
    make_shot(tmp_path, 3)
    (tmp_path / "lr/lr.1001.exr").unlink()
    frames = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path).frames
    assert check_first_pair(frames, InputOptions()) == []
    (tmp_path / "lr/lr.1002.exr").write_bytes(b"no EXR")
    (doubt,) = check_first_pair(frames, InputOptions())
    assert doubt.startswith("frame 1002: can't be checked here: ")
