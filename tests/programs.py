# SPDX-License-Identifier: Apache-2.0
"""Runs the programs as users run them."""

import os
import signal
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


def start(command, **options):
    """Start a process that signals can end, even if this one ignores some of them, as under nohup."""

    def listen():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            signal.signal(getattr(signal, name), signal.SIG_DFL)

    listening = {"preexec_fn": listen} if os.name == "posix" else {}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*map(str, command)], **(listening | streams | options))


def leave_temporary(target):
    """Return the temporary file of a process that was killed while it wrote ``target``."""
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
