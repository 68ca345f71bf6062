# SPDX-License-Identifier: Apache-2.0
"""The preview shows the frame in display values."""

import subprocess
import sys
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.preview import check_view, is_our_preview, write_preview
from oiio_msspl.exr.render import Window
from oiio_msspl.image.colour import srgb
from tests.shots import write_png


def png(path):
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))


def test_the_preview_shows_the_display_window(tmp_path):
    """Overscan is cut off, and what was not rendered is black."""
    rgb = np.full((100, 20, 3), 10, np.float32)
    write_preview(tmp_path / "a.png", rgb, Window(-5, 30, 15, 130), Window(0, 0, 40, 100))
    picture = png(tmp_path / "a.png")
    assert picture.shape == (100, 40, 3)
    assert (picture[30:, :15] == 255).all()
    assert not picture[:30].any()
    assert not picture[:, 15:].any()


def test_the_preview_has_the_srgb_curve(tmp_path):
    rgb = np.full((4, 4, 3), 0.5, np.float32)
    window = Window(0, 0, 4, 4)
    write_preview(tmp_path / "a.png", rgb, window, window)
    assert (png(tmp_path / "a.png") == round(255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055))).all()


def test_every_value_is_at_most_one_step_from_the_curve(tmp_path):
    rgb = np.linspace(0, 1.2, 64 * 64 * 3, dtype=np.float32).reshape(64, 64, 3)
    window = Window(0, 0, 64, 64)
    write_preview(tmp_path / "a.png", rgb, window, window)
    steps = png(tmp_path / "a.png").astype(int) - np.rint(srgb(rgb) * 255)
    assert abs(steps).max() <= 1 and np.count_nonzero(steps) < 0.02 * steps.size


def test_light_beyond_half_floats_is_white_and_what_is_no_number_is_black(tmp_path):
    rgb = np.array([[[1e30, np.inf, 65504], [-1e30, -np.inf, np.nan]]], np.float32)
    write_preview(tmp_path / "a.png", rgb, Window(0, 0, 2, 1), Window(0, 0, 2, 1))
    assert png(tmp_path / "a.png").tolist() == [[[255] * 3, [0] * 3]]


def test_rows_are_stored_with_the_filter_that_is_fast(tmp_path):
    window = Window(0, 0, 7, 5)
    write_preview(tmp_path / "a.png", np.random.default_rng(0).random((5, 7, 3), np.float32), window, window)
    data = (tmp_path / "a.png").read_bytes()
    start = data.index(b"IDAT")
    length = int.from_bytes(data[start - 4 : start], "big")
    rows = zlib.decompress(data[start + 4 : start + 4 + length])
    assert list(rows[:: 1 + 7 * 3]) == [1] * 5  # "Sub"


def test_our_previews_are_told_from_other_pictures(tmp_path):
    write_png(tmp_path / "ours.png")
    oiio.ImageBuf(np.zeros((4, 4, 3), np.float32)).write(str(tmp_path / "other.png"))
    (tmp_path / "text.png").write_text("no picture")
    assert is_our_preview(tmp_path / "ours.png")
    assert not is_our_preview(tmp_path / "other.png")
    assert not is_our_preview(tmp_path / "text.png")


def test_an_unknown_view_is_refused_with_those_that_exist(tmp_path):
    check_view("Un-tone-mapped")
    with pytest.raises(InputError, match=r"--ocio-view 'sepia': .* has .*Un-tone-mapped"):
        check_view("sepia")


def test_a_picture_is_not_overwritten_without_being_told(tmp_path):
    (tmp_path / "a.png").write_text("old")
    with pytest.raises(InputError, match="pass --overwrite"):
        write_png(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_text() == "old"


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit for the size of files")
def test_a_picture_whose_last_bytes_cannot_be_written_is_none(tmp_path):
    """OpenImageIO does not tell. The limit of a process stands for a full disk."""
    code = (
        "import resource, sys, numpy as np; from pathlib import Path;"
        "from oiio_msspl.exr.preview import Window, write_preview;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000));"
        "image, window = np.random.default_rng(0).random((256, 256, 3), np.float32), Window(0, 0, 256, 256);"
        "write_preview(Path(sys.argv[1]), image, window, window)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.png")], capture_output=True, text=True)
    assert "MssplError" in done.stderr and "is the disk full?" in done.stderr and not list(tmp_path.iterdir())
