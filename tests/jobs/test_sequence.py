# SPDX-License-Identifier: Apache-2.0
"""Which files are the frames of a shot."""

import re

import pytest

from oiio_msspl import InputError
from oiio_msspl.jobs.sequence import (
    find_shot,
    format_frames,
    frame_in_name,
    is_sequence,
    next_file,
    parse_frames,
    parse_pattern,
)


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("pattern", ["a.####.exr", "a.%04d.exr", "a.@@@@.exr", "a.$F4.exr"])
def test_every_way_to_write_a_pattern_means_the_same_files(tmp_path, pattern):
    """Four digits: 7 is 0007 and not 7, 10000 has five, -3 is -003; other names are others' files."""
    names = ["a.0007.exr", "a.10000.exr", "a.-003.exr", "a.7.exr", "b.0007.exr", "a.0007.crypto.exr", "a.x.exr"]
    folder = touch(tmp_path / "lr#1", *names)
    found = find_shot(folder / pattern, folder / pattern, tmp_path / pattern)
    assert [frame.number for frame in found.frames] == [-3, 7, 10000]
    assert [frame.lr.name for frame in found.frames] == ["a.-003.exr", "a.0007.exr", "a.10000.exr"]
    assert found.frames[1].output == tmp_path / "a.0007.exr"


@pytest.mark.parametrize("name", ["still@2x.exr", "me@home.exr", "100%done.exr", "a.exr", "take#2.exr", "#a.exr"])
def test_ordinary_names_are_no_patterns(tmp_path, name):
    assert not is_sequence(tmp_path / name)
    longer = name.replace(".exr", ".####.exr")
    assert parse_pattern(tmp_path / longer).path(7).name == name.replace(".exr", ".0007.exr")


@pytest.mark.parametrize(
    "name", ["a.@.exr", "@.exr", "a_@-b.exr", "a%d.exr", "a.%d_lr.exr", "%d", "a#.exr", "a.#_lr.exr"]
)
def test_the_shortest_patterns_are_of_one_digit(tmp_path, name):
    assert is_sequence(tmp_path / name)
    assert parse_pattern(tmp_path / name).path(7).name == re.sub("[@#]|%d", "7", name)


def test_folders_pair_by_number_whatever_names_and_padding(tmp_path):
    """Blender's 0001.exr against name-1.exr; hidden files, pictures and unnumbered EXRs are no frames."""
    touch(tmp_path / "lr", "0001.exr", "0002.exr", ".0003.exr", "0004.png", "single.exr")
    touch(tmp_path / "hr", "shot-1.exr", "shot-2.exr", "shot-10.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert [(f.number, f.lr and f.lr.name, f.hr and f.hr.name, f.output.name) for f in found.frames] == [
        (1, "0001.exr", "shot-1.exr", "shot-1.exr"),
        (2, "0002.exr", "shot-2.exr", "shot-2.exr"),
        (10, None, "shot-10.exr", "shot-10.exr"),
    ]


def test_results_are_named_as_the_hrls_whatever_its_padding(tmp_path):
    touch(tmp_path / "lr", "lr.998.exr", "lr.999.exr", "lr.1000.exr")
    touch(tmp_path / "hr", "hr.998.exr", "hr.0999.exr", "hr.1000.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", "998-1001")
    assert [frame.output.name for frame in found.frames] == ["hr.998.exr", "hr.0999.exr", "hr.1000.exr", "hr.1001.exr"]
    assert found.target(999).name == "hr.0999.exr"


@pytest.mark.parametrize("names", [("hr.-002.exr", "hr.-001.exr"), ("hr.-0002.exr", "hr.-0001.exr")])
@pytest.mark.parametrize("pattern", ["hr.####.exr", "hr.%04d.exr", ""])
def test_negative_numbers_have_a_sign_beside_their_digits_or_in_place_of_one(tmp_path, names, pattern):
    touch(tmp_path / "lr", "lr.-0002.exr", "lr.-0001.exr", "lr.0000.exr", "lr.0001.exr")
    touch(tmp_path / "hr", *names, "hr.0000.exr", "hr.0001.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr" / pattern, tmp_path / "out")
    assert [frame.number for frame in found.frames] == [-2, -1, 0, 1]
    assert [frame.output.name for frame in found.frames] == [*names, "hr.0000.exr", "hr.0001.exr"]
    assert next_file(found.frames[2].hr) == found.frames[3].hr
    assert next_file(found.frames[3].hr) is None


def test_negative_numbers_inside_of_names_are_of_the_same_sequence(tmp_path):
    touch(tmp_path / "lr", "lr.-001_b.exr", "lr.0001_b.exr")
    touch(tmp_path / "hr", "shot-0001_b.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert [(frame.number, bool(frame.hr)) for frame in found.frames] == [(-1, False), (1, True)]


def test_of_several_sequences_those_of_one_name_are_paired(tmp_path):
    touch(tmp_path / "lr", "beauty_0001.exr", "beauty_0002.exr", "ao.1.exr")
    touch(tmp_path / "hr", "beauty.0001.exr", "beauty.0002.exr", "crypto.0001.exr", "beauty.0001.id.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert (found.lr.pattern.name, found.hr.pattern.name) == ("beauty_####.exr", "beauty.####.exr")


def test_a_folder_knows_the_names_of_renders_that_msspl_render_keeps(tmp_path):
    """A number in front of a suffix is that of the frame if it follows a separator: versions and sizes are none."""
    touch(tmp_path / "lr", *(f"a_v2.{n:04d}_lr.exr" for n in (9, 10000)), "a_v2_lr.exr", "a_x2_lr.exr", "single.exr")
    touch(tmp_path / "hr", *(f"a_v2.{n:04d}_hr.exr" for n in (9, 10000)))
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert [(f.number, f.lr and f.lr.name, f.output.name) for f in found.frames] == [
        (9, "a_v2.0009_lr.exr", "a_v2.0009_hr.exr"),
        (10000, "a_v2.10000_lr.exr", "a_v2.10000_hr.exr"),
    ]


def test_a_number_at_the_end_of_a_name_wins_over_one_in_front_of_a_suffix(tmp_path):
    """The fused frames, beside the renders that msspl-render keeps."""
    touch(tmp_path / "a", *(f"shot01_v002.{n}{suffix}.exr" for n in (1001, 1002) for suffix in ("", "_lr", "_hr")))
    found = find_shot(tmp_path / "a", tmp_path / "a", tmp_path / "out")
    assert found.lr.pattern.name == found.hr.pattern.name == "shot01_v002.####.exr"


def test_results_are_named_exr_whatever_the_hrls_is_named(tmp_path):
    touch(tmp_path, "hr.exr.0001", "hr.exr.0002")
    found = find_shot(tmp_path / "hr.exr.####", tmp_path / "hr.exr.####", tmp_path / "out")
    assert [frame.output.name for frame in found.frames] == ["hr.exr.0001.exr", "hr.exr.0002.exr"]


@pytest.mark.parametrize(
    ("lr", "hr", "message"),
    [
        (["a.1.exr", "b.1.exr"], ["a.1.exr", "b.1.exr"], r"hr has a\.#\.exr, b\.#\.exr; name the two"),
        (["lr.1.exr"], ["a.1.exr", "b.1.exr"], r"hr has a\.#\.exr, b\.#\.exr; name the two"),
        (["lr.1.exr", "lr.0001.exr"], ["a.1.exr"], "with and without zeros"),
        (["lr.exr"], ["a.1.exr"], "lr: no numbered EXRs"),
    ],
)
def test_folders_that_leave_a_doubt_are_explained(tmp_path, lr, hr, message):
    touch(tmp_path / "lr", *lr), touch(tmp_path / "hr", *hr)
    with pytest.raises(InputError, match=message):
        find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")


def test_a_folder_with_both_sequences_is_explained(tmp_path):
    folder = touch(tmp_path / "both", "beauty.1.exr", "lr.1.exr")
    message = r"both has beauty\.#\.exr, lr\.#\.exr; name the two as patterns, the low-resolution one first"
    with pytest.raises(InputError, match=message):
        find_shot(folder, folder, tmp_path / "out")


@pytest.mark.parametrize(
    ("first", "output"), [(1, "#"), (1001, "#"), (1001, "%d"), (1001, "####"), (10000, "####"), (-1, "#")]
)
def test_results_beside_the_renders_are_no_candidates(tmp_path, first, output):
    """So a run can resume, and the next task of a farm can start. The numbers may have more digits than the pattern."""
    touch(tmp_path / "lr", f"shot.{first}.exr", f"shot.{first + 1}.exr")
    touch(tmp_path / "hr", f"beauty.{first}.exr", f"beauty.{first + 1}.exr", f"fused.{first}.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "hr" / f"fused.{output}.exr")
    assert sorted(path.name for path in found.hr.files.values()) == [f"beauty.{n}.exr" for n in (first, first + 1)]


@pytest.mark.parametrize(
    ("frames", "numbers"),
    [
        ("1001-1007x3", [1001, 1004, 1007]),
        ("1004, 1001-1002", [1004, 1001, 1002]),
        ("-2-1", [-2, -1, 0, 1]),
        ([1003, 1001, 1003], [1003, 1001]),
        (range(5, 7), [5, 6]),
    ],
)
def test_ranges_are_taken_in_their_order(tmp_path, frames, numbers):
    folder = touch(tmp_path / "a", "a.1001.exr")
    found = find_shot(folder, folder, tmp_path / "out", frames)
    assert [frame.number for frame in found.frames] == numbers
    assert sum(frame.lr is not None for frame in found.frames) == numbers.count(1001)


def test_frames_are_shown_as_ranges():
    assert format_frames([1001, 1002, 1003, 1007]) == "1001-1003,1007"


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("v2####.exr", "v20007.exr"),
        ("take1-3_####.exr", "take1-3_0007.exr"),
        ("a.####_v2.exr", "a.0007_v2.exr"),
        ("a [left].####.exr", "a [left].0007.exr"),
        ("####", "0007"),
    ],
)
def test_names_that_fileseq_splits_differently(tmp_path, name, file):
    """Digits before the number are no frame range, text after it needs no dot, and brackets are no wildcard."""
    folder = touch(tmp_path / "lr#1.%04d", file)
    assert parse_pattern(folder / name).path(7) == folder / file
    found = find_shot(folder / name, folder / name, tmp_path / "out")
    assert [frame.lr for frame in found.frames] == [folder / file]


def test_a_hyphen_after_a_letter_is_a_separator_and_a_sign_elsewhere(tmp_path):
    touch(tmp_path / "lr", "shot-0001.exr", "shot-0002.exr")
    touch(tmp_path / "hr", "a.-001.exr", "a.0002.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert (found.lr.pattern.name, list(found.lr.files)) == ("shot-####.exr", [1, 2])
    assert (found.hr.pattern.name, sorted(found.hr.files)) == ("a.####.exr", [-1, 2])


def test_a_step_may_be_written_with_a_colon():
    """As Houdini and Open Job Description write it. To fileseq a colon means a staggered range."""
    assert parse_frames("1-9:4") == [1, 5, 9]
    assert parse_frames("1001, 1003") == [1001, 1003]
    with pytest.raises(InputError, match="separate numbers and ranges by commas"):
        parse_frames("1001 1002")


@pytest.mark.parametrize(
    ("name", "following"),
    [
        ("hr.1001.exr", "hr.1002.exr"),
        ("hr0009.exr", "hr0010.exr"),
        ("anim.0001_lr.exr", "anim.0002_lr.exr"),
        ("anim.0001_v2.exr", None),
        ("shot_v001.exr", None),
        ("still.exr", None),
    ],
)
def test_the_frame_number_in_a_name_is_no_version(tmp_path, name, following):
    found = frame_in_name(tmp_path / name)
    assert (found and found[0].path(found[1] + 1)) == (following and tmp_path / following)


def test_a_number_in_the_name_of_a_new_folder_is_explained(tmp_path):
    touch(tmp_path, "lr.1.exr", "hr.1.exr")
    with pytest.raises(
        InputError, match=r"take##2: ## stands for the frame number, and the results are EXRs; name them"
    ):
        find_shot(tmp_path / "lr.#.exr", tmp_path / "hr.#.exr", tmp_path / "take##2")


def test_versions_in_a_folder_are_no_frames(tmp_path):
    """Or versions of a still would be averaged with each other. A pattern may name them."""
    touch(tmp_path / "lr", "still_v001.exr", "still_v002.exr")
    touch(tmp_path / "hr", "still_v001.exr", "still_v002.exr")
    with pytest.raises(InputError, match="lr: no numbered EXRs in this folder"):
        find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    found = find_shot(tmp_path / "lr/still_v###.exr", tmp_path / "hr/still_v###.exr", tmp_path / "out")
    assert sorted(found.hr.files) == [1, 2]
    touch(tmp_path / "lr", "rev1.exr")
    touch(tmp_path / "hr", "rev1.exr")
    assert list(find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out").hr.files) == [1]


def test_where_aovs_have_files_of_their_own_the_beauty_is_paired(tmp_path):
    names = [f"shot_{word}.{n}.exr" for word in ("beauty", "albedo", "depth") for n in (1, 2)]
    touch(tmp_path / "lr", *names)
    touch(tmp_path / "hr", *names)
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert (found.lr.pattern.name, found.hr.pattern.name) == ("shot_beauty.#.exr",) * 2


def test_sub_frames_are_no_frames(tmp_path):
    """Renderers write them between whole frames, for motion blur. A number without its frame may be a version."""
    for side in ("lr", "hr"):
        touch(tmp_path / side, "a.1001.exr", "a.1001.50.exr", "a.1002.exr", "a.1002.25.exr", "a.1002.75.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert [frame.hr.name for frame in found.frames] == ["a.1001.exr", "a.1002.exr"]
    touch(tmp_path / "versions", "a.2.0001.exr", "a.2.0002.exr")
    found = find_shot(tmp_path / "versions", tmp_path / "versions", tmp_path / "out")
    assert [frame.number for frame in found.frames] == [1, 2]
