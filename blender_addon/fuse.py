# SPDX-License-Identifier: GPL-3.0-or-later
"""The program msspl-fuse: where it is, and running it while Blender goes on."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

from .errors import Failure

_TILE = re.compile(r"tile (\d+) of (\d+)")
_GRACE = 10  #: seconds that a cancelled msspl-fuse gets to remove its temporary file


def find_program(preference=""):
    """msspl-fuse as the add-on's preferences, the variable MSSPL_FUSE or the path name it.

    Raises:
        Failure: it is not where it was said to be, or nowhere.
    """
    for where, name in (("the add-on's preferences", preference), ("MSSPL_FUSE", os.environ.get("MSSPL_FUSE"))):
        if name:
            found = shutil.which(os.path.expanduser(name))
            if found is None:
                raise Failure(f"{name}: no such program; correct it in {where}")
            return found
    found = shutil.which("msspl-fuse")
    if found is None:
        raise Failure("msspl-fuse is not on the path; name it in the add-on's preferences or in MSSPL_FUSE")
    return found


def run(program, low, high, output, work, overwrite, threads):
    """Fuse two files, as steps of :func:`.frame.make`; closing the steps ends the program.

    Returns:
        msspl-fuse's report.

    Raises:
        Failure: its error, in its own words.
    """
    # A single part is what Blender's Image node reads with all passes.
    command = [program, low, high, "-o", output, "--layout", "multilayer", "--no-preview", "--json", "-v"]
    command += ["--overwrite"] if overwrite else []
    command += ["--threads", threads] if threads else []
    # Its own Python must not inherit what was set for Blender's.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment["PYTHONUTF8"] = "1"  # so that names are read here as they are written there
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
            raise Failure(f"{program}: can't be started ({error.strerror}); is it msspl-fuse?") from error
        try:
            while process.poll() is None:
                tiles = _TILE.findall(_read(log))
                yield "fuse", (2 + (int(tiles[-1][0]) / int(tiles[-1][1]) if tiles else 0)) / 3
        finally:
            _end(process)
    if process.returncode:
        lines = _read(log).strip().splitlines() or [f"it ended with code {process.returncode}"]
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
