# SPDX-License-Identifier: Apache-2.0
"""The main job on one pair: what is refused before any work, and what does not stop it."""

import numpy as np
import pytest

from oiio_msspl import InputError, InputOptions, MssplError, WriteOptions, fuse_files
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.jobs import frame
from oiio_msspl.jobs.frame import map_pair
from tests.conftest import downsample, picture, read_bits, rgb, write_exr
from tests.shots import HEIGHT, WIDTH, layers, low_layers


@pytest.fixture
def pair(tmp_path):
    return write_exr(tmp_path / "lr.exr", low_layers(1)), write_exr(tmp_path / "hr.exr", layers(1))


def test_the_result_is_written_over_the_hrls_s_data_window(pair, tmp_path, bilinear_models):
    done = []
    report = fuse_files(
        *pair, tmp_path / "out.exr", model=str(bilinear_models[4]), progress=lambda *tiles: done.append(tiles)
    )
    beauty = open_exr(report.output).parts[0]
    assert beauty.data_window.size == f"{WIDTH}x{HEIGHT}"
    assert done[-1] == (report.tiles, report.tiles)
    assert set(report.seconds) == {"read", "fuse", "network", "write"}


@pytest.mark.parametrize(
    ("output", "more", "message"),
    [
        ("out.png", {}, "the result is an EXR"),
        ("hr.exr", {"overwrite": True}, "is one of the inputs"),
        ("lr.exr", {}, "exists; pass --overwrite"),
        ("out.exr", {"write": WriteOptions(layers=("nothing*",))}, "nothing"),
    ],
)
def test_what_is_wrong_is_said_before_the_work(pair, tmp_path, monkeypatch, output, more, message):
    monkeypatch.setattr(frame, "Session", pytest.fail)
    with pytest.raises(InputError, match=message):
        fuse_files(*pair, tmp_path / output, **more)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hr.exr", "lr.exr"]


def test_a_frame_without_its_preview_is_a_warning(pair, tmp_path, bilinear_models, monkeypatch):
    def full_disk(*arguments, **more):
        raise MssplError("disk full")

    monkeypatch.setattr(frame, "write_preview", full_disk)
    out = tmp_path / "out.exr"
    report = fuse_files(*pair, out, model=str(bilinear_models[4]), preview_path=tmp_path / "out.png")
    assert out.is_file()
    assert report.preview is None
    assert "no preview: disk full" in report.warnings


def test_the_mapping_is_the_hrls_s_and_only_its_beauty_applies_to_the_lrhs(tmp_path):
    """The LRHS need not have the layer that albedo is mapped to, and then has no albedo."""
    clean = picture(HEIGHT, WIDTH)
    lr = write_exr(tmp_path / "lr.exr", rgb(clean[::4, ::4], "key.") | rgb(clean[::4, ::4], "albedo."))
    hr = write_exr(tmp_path / "hr.exr", rgb(clean, "key.") | rgb(clean, "colours."))
    low, high = map_pair(lr, hr, InputOptions({"rgb": "key", "albedo": "colours"}, lr_spp=64, hr_spp=2))
    assert (set(low.features), set(high.features)) == ({"rgb"}, {"rgb", "albedo"})
    assert (low.features["rgb"].text, high.features["albedo"].text) == ("key", "colours")
    assert (low.spp, high.spp) == (64, 2)


@pytest.mark.parametrize(("pixel_type", "lamp", "clipped"), [("half", 65504.0, 3 * 64), ("float", 1e6, 0)])
def test_values_that_half_cannot_hold_are_clipped_and_counted(tmp_path, bilinear_models, pixel_type, lamp, clipped):
    clean = np.full((64, 64, 3), 0.5, np.float32)
    clean[16:24, 40:48] = 1e6
    lr, hr = write_exr(tmp_path / "lr.exr", rgb(downsample(clean, 4))), write_exr(tmp_path / "hr.exr", rgb(clean))
    write = WriteOptions(pixel_type=pixel_type)
    report = fuse_files(lr, hr, tmp_path / "out.exr", write=write, model=str(bilinear_models[4]))
    assert report.clipped == report.as_dict()["clipped"] == clipped
    assert any(f"{clipped} values are too bright for half" in warning for warning in report.warnings) == bool(clipped)
    [(_, channels)] = read_bits(tmp_path / "out.exr")
    assert (channels["R"][16:24, 40:48] == lamp).all()
