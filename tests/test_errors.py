# SPDX-License-Identifier: Apache-2.0
"""Sentences and exit codes for what goes wrong."""

import errno
import os
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


@pytest.mark.parametrize("error", [OSError(errno.EIO, "I/O error", "lr.exr"), PermissionError(errno.EPERM, "no")])
def test_other_failures_of_the_system_are_nobody_s_mistake(error):
    message, code = explain(error)
    assert message.startswith("unexpected ") and code == 1
