# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding the program msspl-fuse, and running it while Blender goes on."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

from .errors import Failure

#: msspl-fuse prints this after each step if it runs with -v.
_STEP = re.compile(r"step (\d+) of (\d+)")
#: Seconds that a cancelled msspl-fuse has to remove its temporary file.
_GRACE = 10


def find_program(preference=""):
    """Path of msspl-fuse: from the add-on's preferences, otherwise from ``MSSPL_FUSE``, otherwise from ``PATH``.

    Raises:
        Failure: no program is found there.
    """
    for where, name in (("the add-on's preferences", preference), ("MSSPL_FUSE", os.environ.get("MSSPL_FUSE"))):
        if name:
            found = shutil.which(os.path.expanduser(name))
            if found is None:
                raise Failure(f"{name}: no such program; correct the path in {where}")
            return found
    found = shutil.which("msspl-fuse")
    if found is None:
        raise Failure(
            "msspl-fuse is not on PATH; give its path in the add-on's preferences or in the variable MSSPL_FUSE"
        )
    return found


def run(program, lrhs, hrls, output, work, overwrite, threads):
    """Fuse two files. This is a generator that yields ``(current step, fraction of the frame done)``.

    Closing the generator ends the program.

    Returns:
        The report of msspl-fuse.

    Raises:
        Failure: msspl-fuse failed. The message is its own.
    """
    # Blender's Image node shows all passes of a single-part file only.
    command = [program, lrhs, hrls, "-o", output, "--layout", "multilayer", "--no-preview", "--json", "-v"]
    command += ["--overwrite"] if overwrite else []
    command += ["--threads", threads] if threads else []
    # msspl-fuse runs in another Python, which must not get the variables of Blender's.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment["PYTHONUTF8"] = "1"  # Paths and messages are in UTF-8 on every platform.
    report, log = Path(work, "fuse.json"), Path(work, "fuse.log")
    with report.open("wb") as out, log.open("wb") as err:
        try:
            process = subprocess.Popen(
                [str(part) for part in command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                env=environment,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            raise Failure(f"{program}: can't be started ({error.strerror}); check that it is msspl-fuse") from error
        try:
            while process.poll() is None:
                steps = _STEP.findall(_read(log))
                yield "fuse", (2 + (int(steps[-1][0]) / int(steps[-1][1]) if steps else 0)) / 3
        finally:
            _end(process)
    if process.returncode:
        lines = _read(log).strip().splitlines() or [f"the program ended with code {process.returncode}"]
        said = next((line for line in lines if line.startswith("error: ")), lines[-1])
        raise Failure(f"msspl-fuse: {said.removeprefix('error: ')}", 2 if process.returncode == 2 else 1)
    return json.loads(_read(report))


def _read(path):
    return path.read_text(encoding="utf-8", errors="replace")


def _end(process):
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
