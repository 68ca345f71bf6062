# SPDX-License-Identifier: Apache-2.0
"""Sentences and exit codes for what goes wrong."""

import errno
import os
import tempfile
from pathlib import Path

import pytest

from oiio_msspl.errors import explain


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOENT])
@pytest.mark.parametrize("path", ["shot/lr.exr", b"shot/lr.exr", Path("shot/lr.exr")])
def test_a_path_that_the_file_system_refuses_is_a_mistake_and_named(number, path):
    said = explain(OSError(number, os.strerror(number), path))
    assert said == (f"{Path('shot/lr.exr')}: can't be used ({os.strerror(number)})", 2)


def test_of_two_paths_the_new_name_is_told():
    error = OSError(errno.EACCES, "Permission denied", ".tmp.exr", None, "shot/out.exr")
    assert explain(error) == ("shot/out.exr: can't be used (Permission denied)", 2)


@pytest.mark.parametrize(
    ("path", "what"), [("lr.exr", "lr.exr"), (None, "standard output or a temporary file"), (3, "standard output")]
)
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_failure_that_is_told(path, what, number):
    message, code = explain(OSError(number, os.strerror(number), path))
    assert message.startswith(what) and message.endswith(f": can't be written ({os.strerror(number)}); free space")
    assert code == 1


def test_without_a_folder_for_temporary_files_the_message_names_the_variable(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/nowhere"])
    with pytest.raises(FileNotFoundError) as caught:
        tempfile.gettempdir()
    message, code = explain(caught.value)
    assert message.startswith("no folder for temporary files can be used (") and "'/nowhere'" in message
    assert message.endswith("; free space, or export TMPDIR=/another/folder") and code == 1


@pytest.mark.parametrize("error", [OSError(errno.EIO, "I/O error", "lr.exr"), PermissionError(errno.EPERM, "no")])
def test_other_failures_of_the_system_are_nobody_s_mistake(error):
    message, code = explain(error)
    assert message.startswith("unexpected ") and code == 1
