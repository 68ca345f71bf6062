# SPDX-License-Identifier: Apache-2.0
"""Starts msspl-render for the tests."""

import os
import sys

import pytest

posix = pytest.mark.skipif(os.name != "posix", reason="the program in place of Blender is a script")


def render_command(*arguments):
    """Return the command line of msspl-render in this Python."""
    main = "import sys; from msspl_cli.app import msspl_render as main; sys.argv[0] = 'msspl-render'; main()"
    return [sys.executable, "-c", main, *map(str, arguments)]
