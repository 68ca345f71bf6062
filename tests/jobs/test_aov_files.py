# SPDX-License-Identifier: Apache-2.0
"""Shots with a file for each AOV, and an alpha in a part of its own."""

import numpy as np
import pytest

from oiio_msspl import InputError, InputOptions, fuse_files, fuse_shot
from oiio_msspl.aovs.mapping import parse_map_options
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.jobs.checks import check_wanted_outputs
from oiio_msspl.jobs.inputs import map_pair
from oiio_msspl.jobs.sequence import find_shot
from tests.conftest import downsample, picture, read_bits, rgb, write_exr
from tests.shots import HEIGHT, WIDTH

FRAMES = (1001, 1002, 1003)


@pytest.fixture
def shot(tmp_path):
    """Two folders of beauties, and one of albedos whose value is the frame's number."""
    for folder in ("lr", "hr", "surface"):
        (tmp_path / folder).mkdir()
    for frame in FRAMES:
        clean = picture(HEIGHT, WIDTH)
        write_exr(tmp_path / "hr" / f"b.{frame}.exr", rgb(clean))
        write_exr(tmp_path / "lr" / f"b.{frame}.exr", rgb(downsample(clean, 4).astype(np.float32)))
        write_exr(tmp_path / "surface" / f"c.{frame}.exr", rgb(np.full((HEIGHT, WIDTH, 3), frame, np.float32)))
    return tmp_path


def options(folder, name):
    return InputOptions(parse_map_options([f"albedo={folder / 'surface' / name}"]))


@pytest.mark.parametrize("name", ["c.####.exr", "c.%04d.exr", "c.@@@@.exr"])
def test_a_pattern_in_a_mapping_gives_each_frame_its_own_file(shot, name):
    inputs = options(shot, name)
    for frame in FRAMES:
        _, hr = map_pair(shot / "lr" / f"b.{frame}.exr", shot / "hr" / f"b.{frame}.exr", inputs)
        assert hr.read(hr.data_window)["albedo"][0, 0, 0] == frame
        assert inputs.files(shot / "hr" / f"b.{frame}.exr", None) == {shot / "surface" / f"c.{frame}.exr"}


def test_a_pattern_needs_a_frame_number(shot):
    (shot / "hr" / "b.1001.exr").rename(shot / "still.exr")
    with pytest.raises(InputError, match=r"c\.####\.exr: is a pattern, but .*still\.exr has no frame number"):
        map_pair(shot / "lr" / "b.1001.exr", shot / "still.exr", options(shot, "c.####.exr"))


def test_one_file_of_a_sequence_is_not_read_for_all_frames(shot):
    inputs, wanted = options(shot, "c.1001.exr"), r"c\.1001\.exr: is one frame of a sequence.*; write .*c\.####\.exr"
    with pytest.raises(InputError, match=wanted):
        fuse_shot(shot / "lr", shot / "hr", shot / "out", inputs=inputs)
    assert not (shot / "out").exists()
    frames = find_shot(shot / "lr", shot / "hr", shot / "out").frames
    with pytest.raises(InputError, match=wanted):  # as a farm's job is checked
        check_wanted_outputs(frames, inputs, WriteOptions(), None, 1 << 32)


def test_a_single_file_may_be_read_for_all_frames(shot, bilinear_models):
    """The camera stands still, and the albedo was rendered once."""
    for frame in FRAMES[1:]:
        (shot / "surface" / f"c.{frame}.exr").unlink()
    report = fuse_shot(
        shot / "lr", shot / "hr", shot / "out", inputs=options(shot, "c.1001.exr"), model=str(bilinear_models[4])
    )
    assert report.exit_code == 0


def test_another_size_in_mid_shot_is_a_warning(shot, bilinear_models):
    half = picture(HEIGHT // 2, WIDTH // 2)
    write_exr(shot / "hr" / "b.1002.exr", rgb(half))
    write_exr(shot / "lr" / "b.1002.exr", rgb(downsample(half, 4).astype(np.float32)))
    report = fuse_shot(shot / "lr", shot / "hr", shot / "out", model=str(bilinear_models[4]), temporal="off")
    said = "the frame is 24x16 here and 48x32 in frame 1001: it may flicker"
    assert [said in report.results[frame].warnings for frame in FRAMES] == [False, True, False]


@pytest.mark.parametrize("window", ["the same", "another"])
def test_an_alpha_in_a_part_of_its_own_is_fused_and_stays_there(tmp_path, bilinear_models, window):
    clean = picture(HEIGHT, WIDTH)
    alpha = np.random.default_rng(0).integers(0, 2, (HEIGHT, WIDTH)).astype(np.float16)
    stored = alpha if window == "the same" else alpha[:-2]
    lr = [("rgb", rgb(downsample(clean, 4)), (0, 0)), ("alpha", {"A": np.full((8, 12), 0.5, np.float16)}, (0, 0))]
    hr = [("rgb", rgb(clean), (0, 0)), ("alpha", {"A": stored}, (0, 0)), ("plate", rgb(clean, "plate."), (0, 0))]
    write_exr(tmp_path / "lr.exr", lr)
    display = (np.zeros(2, np.int32), np.array([WIDTH - 1, HEIGHT - 1], np.int32))
    write_exr(tmp_path / "hr.exr", hr, display=display)
    report = fuse_files(tmp_path / "lr.exr", tmp_path / "hr.exr", tmp_path / "out.exr", model=str(bilinear_models[4]))
    after = dict(read_bits(tmp_path / "out.exr"))
    assert [(name, sorted(channels)) for name, channels in after.items()] == [
        ("rgb", ["B", "G", "R"]),
        ("alpha", ["A"]),
        ("plate", ["plate.B", "plate.G", "plate.R"]),
    ]
    if window == "the same":
        assert abs(float(after["alpha"]["A"].mean()) - 0.5) < 0.05 and not np.array_equal(after["alpha"]["A"], alpha)
    else:
        np.testing.assert_array_equal(after["alpha"]["A"], stored)
        assert any("alpha has another data window" in text for text in report.warnings)
    np.testing.assert_array_equal(after["plate"]["plate.R"], clean[..., 0])
