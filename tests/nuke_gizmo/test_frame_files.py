# SPDX-License-Identifier: Apache-2.0
"""File names of numbered frames."""

import pytest
from msspl_bridge import FuseError
from msspl_bridge.frame_files import FrameFile, ReadRange, file_numbers, find_number, name_output, parse_range


@pytest.mark.parametrize(
    ("pattern", "path", "number", "back"),
    [
        ("/a/hr.%04d.exr", "/a/hr.1001.exr", 1001, "/a/hr.%04d.exr"),
        ("/a/hr.####.exr", "/a/hr.0007.exr", 7, "/a/hr.%04d.exr"),
        ("/a/hr_%d.exr", "/a/hr_12.exr", 12, "/a/hr_%01d.exr"),
        ("/a/hr-%04d.exr", "/a/hr-0101.exr", 101, "/a/hr-%04d.exr"),
        ("/a/hr.%04d.exr", "/a/hr.-003.exr", -3, "/a/hr.%04d.exr"),
        ("/a/v2%04d.exr", "/a/v20001.exr", 1, "/a/v2%04d.exr"),
        ("/%V/hr.%v.%04d.exr", "/left/hr.l.0001.exr", 1, "/%V/hr.%v.%04d.exr"),
        ("/a/still.exr", "/a/still.exr", None, "/a/still.exr"),
    ],
)
def test_the_number_is_found_where_the_pattern_has_it(pattern, path, number, back):
    file = find_number(pattern, path)
    assert (file.number, file.in_view("left").path, file.pattern) == (number, path, back)


def test_a_file_that_does_not_match_the_pattern_is_refused():
    with pytest.raises(FuseError, match=r"^/a/proxy\.1\.exr: does not match the pattern /a/hr"):
        find_number("/a/hr.%04d.exr", "/a/proxy.1.exr")


def test_the_output_is_named_after_the_hrls_or_by_the_artist():
    hrls = find_number("/a/hr.%04d.exr", "/a/hr.1001.exr")
    still = FrameFile("/a/hr.exr")
    assert name_output("", hrls, 1).path == "/a/hr_fused.1001.exr"
    assert name_output("", still, 1).path == "/a/hr_fused.exr"
    assert name_output("/b/out_##.exr", hrls, 1).path == "/b/out_1001.exr"
    assert name_output("/b/out_##.exr", still, 1).path == "/b/out_01.exr"
    assert name_output("/b/out.exr", hrls, 1).path == "/b/out.exr"
    stereo = find_number("/%V/hr.%04d.exr", "/left/hr.1001.exr")
    assert name_output("", stereo, 1).pattern == "/%V/hr_fused.%04d.exr"
    assert name_output("/b/%v_##.exr", stereo, 1).in_view("right").path == "/b/r_1001.exr"
    with pytest.raises(FuseError, match=r"output out\.exr: is a relative path"):
        name_output("out.exr", hrls, 1)


def test_a_range_is_two_frames_or_one():
    frames = {"1001-1100": range(1001, 1101), "7": range(7, 8), "-5--2": range(-5, -1), "-1-3": range(-1, 4)}
    assert {text: parse_range(text) for text in frames} == frames
    for text in ("5-4", "1001-1100x2", "all"):
        with pytest.raises(FuseError, match=f"range '{text}': write the first and the last frame"):
            parse_range(text)


def test_a_range_is_numbered_as_the_output_files_are():
    lrhs, hrls = (ReadRange(name, FrameFile(name, 1001), FrameFile(name, 1003)) for name in ("Read1", "Read2"))
    assert file_numbers([lrhs, hrls], FrameFile("/a/out.%04d.exr", 1001), 1, 3) == (1001, 1003)


@pytest.mark.parametrize(
    ("begin", "end", "out", "sentence"),
    [
        (1001, 1002, 1001, r"^Read2 does not have one numbered file per frame from 1 to 3; change the range or"),
        (None, None, 1001, r"^Read2 does not have one numbered file per frame from 1 to 3"),
        (1002, 1004, 1001, r"^at frame 1, Read1 reads file number 1001 and Read2 reads file number 1002; for a range"),
        (1001, 1003, None, r"^output /a/out\.exr: a range needs a frame number in the name"),
    ],
)
def test_a_range_that_msspl_fuse_cannot_pair_is_refused(begin, end, out, sentence):
    lrhs = ReadRange("Read1", FrameFile("lr", 1001), FrameFile("lr", 1003))
    hrls = ReadRange("Read2", FrameFile("hr", begin), FrameFile("hr", end))
    with pytest.raises(FuseError, match=sentence):
        file_numbers([lrhs, hrls], FrameFile("/a/out.exr", out), 1, 3)
