# SPDX-License-Identifier: Apache-2.0
"""A file appears whole or not at all."""

import errno
import os
import re
import sys
import time

import pytest

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr import atomic
from oiio_msspl.exr.atomic import check_separate, check_target, make_folder, remove_leftovers, replacing
from tests.programs import leave_temporary


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
    os.mkfifo(tmp_path / "pipe.exr")
    with pytest.raises(InputError, match="is no ordinary file"):
        check_target(tmp_path / "pipe.exr", overwrite=True)


def test_leftovers_of_killed_runs_are_removed_and_nothing_else(tmp_path):
    """The temporary folder of a process that died goes, whatever it wrote. Files and folders of similar names stay."""
    leave_temporary(tmp_path / "out.exr")
    leave_temporary(tmp_path / "other.exr")
    (tmp_path / ".msspl-notes").mkdir()
    (tmp_path / "out.exr").write_text("kept")
    remove_leftovers([tmp_path / "out.exr"])
    assert sorted(os.listdir(tmp_path)) == [".msspl-notes", "out.exr"]


@pytest.mark.skipif(sys.platform == "win32", reason="on Windows only the age counts")
def test_a_temporary_file_that_a_living_process_writes_stays(tmp_path):
    """Even if it is old, because a process of this machine can be looked up."""
    target = tmp_path / "out.exr"
    with replacing(target) as temporary:
        temporary.write_text("half")
        os.utime(temporary.parent, (0, 0))
        remove_leftovers([target])
        assert temporary.exists()
    assert target.exists()


def test_a_process_on_another_machine_is_taken_for_dead_after_a_day(tmp_path, monkeypatch):
    target = tmp_path / "out.exr"
    monkeypatch.setattr(atomic, "_machine", lambda: "0123abcd")
    new, old = leave_temporary(target), leave_temporary(target)
    os.utime(old.parent, (time.time() - 25 * 3600,) * 2)
    monkeypatch.undo()
    remove_leftovers([target])
    assert list(tmp_path.iterdir()) == [new.parent]


@pytest.mark.parametrize("name", ["x" * 251 + ".exr", "ä" * 125 + ".exr"])
def test_a_name_as_long_as_the_file_system_allows_is_written(tmp_path, name):
    with replacing(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert os.listdir(tmp_path) == [name]


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX links")
def test_the_format_follows_the_name_that_was_given_and_not_that_of_the_link_s_target(tmp_path):
    (tmp_path / "out.exr").symlink_to("stored.data")
    with replacing(tmp_path / "out.exr") as temporary:
        assert temporary.suffix == ".exr"
        temporary.write_text("new")
    assert (tmp_path / "stored.data").read_text() == "new"


def test_a_write_protected_file_is_not_replaced(tmp_path):
    target = tmp_path / "out.exr"
    target.write_text("published")
    target.chmod(0o444)
    with pytest.raises(InputError, match="is write-protected; make it writable or name another file"):
        check_target(target, overwrite=True)


def link(path, to):
    path.symlink_to(to.name)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX links")
@pytest.mark.parametrize("named", [link, lambda path, to: os.link(to, path), lambda path, to: None])
def test_what_is_read_is_not_written_under_any_name(tmp_path, named):
    """The same name, a link, or a second name of one file; before it is written, and if it is written twice."""
    source, other = tmp_path / "in.exr", tmp_path / "other.exr"
    source.write_text("render")
    named(other, source)
    target = other if other.exists() else tmp_path / ".." / tmp_path.name / "in.exr"
    with pytest.raises(InputError, match="is one of the inputs"):
        check_separate([source], [tmp_path / "out.exr", target])
    with pytest.raises(InputError, match="is the same file as"):
        check_separate([], [source, target])
    check_separate([source], [tmp_path / "out.exr", tmp_path / "out.png"])


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_folder_behind_a_link_that_leads_nowhere_is_refused(tmp_path):
    (tmp_path / "out").symlink_to(tmp_path / "nowhere" / "else")
    with pytest.raises(InputError, match="the folder can't be made"):
        make_folder(tmp_path / "out")
    make_folder(tmp_path / "new")
    make_folder(tmp_path / "new")
    assert (tmp_path / "new").is_dir()


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX links")
def test_the_folder_of_a_links_target_must_exist(tmp_path):
    """It is where the file will be written."""
    link = tmp_path / "link.exr"
    link.symlink_to("gone/real.exr")
    with pytest.raises(InputError, match=rf"link\.exr: the folder {tmp_path}/gone does not exist; create it first"):
        check_target(link, overwrite=True)
    (tmp_path / "gone").mkdir()
    assert check_target(link, overwrite=True) == link


def test_pixels_are_on_the_disk_before_a_file_gets_its_name(tmp_path, monkeypatch):
    """A crash of the machine leaves the old file or the whole new one."""
    calls = []
    for name in ("fsync", "replace", "link"):
        call = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, name=name, call=call, **k: (calls.append(name), call(*a, **k))[1])
    for overwrite, naming in ((False, "link"), (True, "replace")):
        with replacing(tmp_path / "out.exr", overwrite=overwrite) as temporary:
            temporary.write_text("new")
        assert calls == ["fsync", naming]
        calls.clear()


# ------------------------------------------------------------------------------------------- other systems


def test_without_hard_links_a_file_is_renamed_unless_another_has_appeared(tmp_path, monkeypatch):
    """As on FAT, exFAT and some network shares."""

    def unknown(*arguments):
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", unknown)
    with replacing(tmp_path / "out.exr") as temporary:
        temporary.write_text("ours")
    assert (tmp_path / "out.exr").read_text() == "ours"
    with pytest.raises(InputError, match="appeared while this was computed"), replacing(tmp_path / "out.exr") as again:
        again.write_text("later")
    assert (tmp_path / "out.exr").read_text() == "ours" and os.listdir(tmp_path) == ["out.exr"]


def test_a_target_that_another_program_holds_open_is_told_and_left_as_it_was(tmp_path, monkeypatch):
    """Windows refuses to rename onto such a file."""

    def refused(*arguments):
        raise PermissionError(errno.EACCES, "The process cannot access the file")

    (tmp_path / "out.exr").write_text("old")
    monkeypatch.setattr(os, "replace", refused)
    with (
        pytest.raises(MssplError, match=r"out.exr: can't be written \(The process cannot .* the target is as it was"),
        replacing(tmp_path / "out.exr", overwrite=True) as temporary,
    ):
        temporary.write_text("new")
    assert (tmp_path / "out.exr").read_text() == "old" and os.listdir(tmp_path) == ["out.exr"]


def test_on_windows_only_the_age_of_a_temporary_file_counts(tmp_path, monkeypatch):
    """There, os.kill(process, 0) would end the process."""
    target = tmp_path / "out.exr"
    new, old = leave_temporary(target), leave_temporary(target)
    os.utime(old.parent, (time.time() - 25 * 3600,) * 2)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "kill", lambda *arguments: pytest.fail("would end a process"))
    remove_leftovers([target])
    assert list(tmp_path.iterdir()) == [new.parent]


def test_a_machine_has_a_name_without_the_files_of_linux(monkeypatch):
    def missing(*arguments, **options):
        raise FileNotFoundError

    monkeypatch.setattr(atomic.Path, "read_text", missing)
    assert re.fullmatch("[0-9a-f]{8}", atomic._machine.__wrapped__())
