# SPDX-License-Identifier: Apache-2.0
"""The programs as users run them."""

import subprocess
import sys


def run(program, *arguments, cwd=None):
    code = f"import sys; from msspl_cli.app import {program} as main; sys.argv[0] = '{program}'; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd)


def fuse(*arguments):
    return run("msspl_fuse", *arguments)
