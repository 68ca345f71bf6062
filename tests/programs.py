# SPDX-License-Identifier: Apache-2.0
"""The programs as users run them."""

import subprocess
import sys
from pathlib import Path

from oiio_msspl.exr import atomic


def run(program, *arguments, cwd=None):
    code = f"import sys; from msspl_cli.app import {program} as main; sys.argv[0] = '{program}'; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd)


def fuse(*arguments):
    return run("msspl_fuse", *arguments)


def leave_temporary(target):
    """The temporary file of a process that was killed while it wrote ``target``."""
    code = (
        "import sys, os; from pathlib import Path; from oiio_msspl.exr import atomic\n"
        "atomic._machine = lambda: sys.argv[2]\n"
        "with atomic.replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half')\n"
        "    print(temporary, flush=True)\n"
        "    os._exit(1)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, target, atomic._machine()], capture_output=True, text=True)
    return Path(done.stdout.strip())
