# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.tiles.alignment import align


def render(name, width, height, data=None, origin=(0, 0), aspect=1.0):
    display = Window(origin[0], origin[1], origin[0] + width, origin[1] + height)
    data = data or display
    return Render({"rgb": np.zeros((data.height, data.width, 3), np.float32)}, data, display, aspect, name=name)


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("size", [(1920, 1080), (1921, 1081), (1023, 577)])
@pytest.mark.parametrize("rounding", ["up", "down"])
def test_the_scale_follows_from_the_display_windows(scale, size, rounding):
    low = [(-(-n // scale) if rounding == "up" else n // scale) for n in size]
    alignment = align(render("lr", *low), render("hr", *size))
    assert alignment.scale == scale
    assert alignment.grid.width * scale >= size[0] > (alignment.grid.width - 1) * scale


def test_pixels_may_be_out_of_square_by_what_was_rounded():
    """2048 x 858 at x4 is 512 x 215: an LRHS whose pixels are 1.0023 wide shows the frame from edge to edge."""
    aspect = 2048 * 215 / (858 * 512)
    assert align(render("lr", 512, 215, aspect=aspect), render("hr", 2048, 858)).scale == 4
    with pytest.raises(InputError, match="pixel aspect"):
        align(render("lr", 512, 215, aspect=1.01), render("hr", 2048, 858))


def test_crop_regions_and_overscan_are_mapped_to_low_resolution_pixels():
    """An HRLS region that starts between LRHS pixels needs the whole pixels around it."""
    high = render("hr", 64, 64, Window(-3, 10, 70, 33))
    low = render("lr", 16, 16, Window(-1, 2, 18, 9))
    assert align(low, high).grid == Window(-1, 2, 18, 9)


def test_a_render_is_empty_outside_of_its_data_window():
    """Data windows that are cropped to what is not empty differ between two noisy renders."""
    alignment = align(render("lr", 16, 16, Window(3, 4, 9, 9)), render("hr", 64, 64, Window(8, 12, 40, 44)))
    assert alignment.grid == Window(2, 3, 10, 11)
    assert alignment.lr_data_window == Window(0, 0, 16, 16)


def test_display_windows_may_begin_anywhere():
    high = render("hr", 64, 64, Window(100, 100, 164, 164), origin=(100, 100))
    low = render("lr", 16, 16, Window(-5, 0, 11, 16), origin=(-5, 0))
    alignment = align(low, high)
    assert alignment.grid == Window(0, 0, 16, 16)
    assert alignment.lr_data_window == Window(0, 0, 16, 16)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (render("lr.exr", 64, 64), render("hr.exr", 16, 16), "look swapped: lr.exr is 64x64 and hr.exr is 16x16"),
        (render("lr.exr", 20, 20), render("hr.exr", 60, 60), r"ratio of 3 is not supported .* one of 30x30 \(x2\)"),
        (render("lr.exr", 16, 9), render("hr.exr", 32, 32), "framing differs: the ratio is 2 in width and 3.56"),
        (render("lr.exr", 16, 16), render("hr.exr", 32, 32, aspect=2), "pixel aspect 1, hr.exr has 2"),
        (render("lr.exr", 16, 16), render("hr.exr", 32, 32, Window(-8, 0, 32, 32)), "covers only 16x16"),
        (render("lr.exr", 16, 16), render("hr.exr", 32, 32, Window(-4, 0, 32, 32)), "covers only 16x16"),
    ],
)
def test_what_does_not_fit_is_explained(low, high, message):
    with pytest.raises(InputError, match=message):
        align(low, high)


@pytest.mark.parametrize(("missing", "known"), [(1, 1), (2, 0)])
def test_a_crop_may_be_rounded_by_one_pixel(missing, known):
    """An LRHS that lacks more is black in the rest of its frame."""
    high, low = render("hr", 64, 64), render("lr", 16, 16, Window(missing, 0, 16, 16))
    alignment = align(low, high)
    assert (alignment.grid, alignment.lr_data_window) == (Window(0, 0, 16, 16), Window(known, 0, 16, 16))
