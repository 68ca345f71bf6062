# SPDX-License-Identifier: Apache-2.0
"""A file appears whole or not at all."""

import os
import sys

import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_target, remove_leftovers, replacing


def test_a_failing_block_leaves_the_old_file(tmp_path):
    target = tmp_path / "out.exr"
    target.write_text("old")
    with pytest.raises(RuntimeError), replacing(target) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.exr"]


def test_two_jobs_do_not_overwrite_each_other(tmp_path):
    """A file that appears while ours is computed stays, unless overwriting was asked for."""
    target = tmp_path / "out.exr"
    with pytest.raises(InputError, match="appeared while this was computed"), replacing(target) as temporary:
        temporary.write_text("ours")
        target.write_text("theirs")
    assert target.read_text() == "theirs"
    assert os.listdir(tmp_path) == ["out.exr"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX links and modes")
def test_links_and_permissions_are_kept(tmp_path):
    (tmp_path / "real.exr").write_text("old")
    (tmp_path / "real.exr").chmod(0o640)
    (tmp_path / "link.exr").symlink_to("real.exr")
    with replacing(tmp_path / "link.exr", overwrite=True) as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.exr").is_symlink()
    assert (tmp_path / "real.exr").read_text() == "new"
    assert (tmp_path / "real.exr").stat().st_mode & 0o777 == 0o640
    (tmp_path / "dangling.exr").symlink_to("nowhere.exr")
    with pytest.raises(InputError, match="exists; pass --overwrite"):
        check_target(tmp_path / "dangling.exr", overwrite=False)


def test_targets_are_checked_before_any_work(tmp_path):
    (tmp_path / "there.exr").write_text("old")
    with pytest.raises(InputError, match="exists; pass --overwrite"):
        check_target(tmp_path / "there.exr", overwrite=False)
    assert check_target(tmp_path / "there.exr", overwrite=True)
    with pytest.raises(InputError, match="does not exist; create it first"):
        check_target(tmp_path / "nowhere" / "x.exr", overwrite=False)
    with pytest.raises(InputError, match="is a folder"):
        check_target(tmp_path, overwrite=True)


def test_leftovers_of_killed_runs_are_removed_and_nothing_else(tmp_path):
    """The temporary file of a run that never ended goes; files that only look like one stay."""
    target = tmp_path / "out.exr"
    stack = replacing(target)
    leftover = stack.__enter__()
    leftover.write_text("half")
    others = [tmp_path / name for name in (".other.12.tmp.exr", ".out.12.tmp.png", ".out.x.tmp.exr", "out.exr")]
    for path in others:
        path.write_text("kept")
    remove_leftovers([target])
    assert sorted(tmp_path.iterdir()) == sorted(others)
