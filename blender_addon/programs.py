# SPDX-License-Identifier: GPL-3.0-or-later
"""Running msspl-fuse and msspl-render while Blender goes on.

:func:`fuse` and :func:`render_shot` are generators that yield ``(current step, fraction done)``. Closing one ends its
program.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import bpy

from .errors import Failure

#: msspl-fuse prints this after each step if it runs with -v.
_STEP = re.compile(r"step (\d+) of (\d+)")
#: Seconds that a cancelled program has to end the Blender that it has started, and to remove its temporary files.
_GRACE = 20


def find_fuse(preference=""):
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


def find_render(preference=""):
    """Path of msspl-render, which is installed beside msspl-fuse.

    Raises:
        Failure: one of the two is not found.
    """
    beside = Path(find_fuse(preference))
    found = shutil.which(str(beside.with_name(f"msspl-render{beside.suffix}")))
    if found is None:
        raise Failure(f"msspl-render does not lie beside {beside}; name the msspl-fuse that was installed with it")
    return found


def fuse(program, lrhs, hrls, output, work, overwrite, threads):
    """Fuse two files.

    Args:
        program: of :func:`find_fuse`.
        work: a folder for temporary files.

    Returns:
        The report of msspl-fuse.

    Raises:
        Failure: msspl-fuse failed. The message is its own.
    """
    # Blender's Image node shows all passes of a single-part file only.
    command = [program, lrhs, hrls, "-o", output, "--layout", "multilayer", "--no-preview", "--json", "-v"]
    command += ["--overwrite"] if overwrite else []
    command += ["--threads", threads] if threads else []

    def progress(log):
        steps = _STEP.findall(_read(log))
        return "fuse", (2 + (int(steps[-1][0]) / int(steps[-1][1]) if steps else 0)) / 3

    return (yield from _run("msspl-fuse", command, work, progress))


def render_shot(program, file, *, scene, frames, outputs, pattern, options, work, overwrite, average):
    """Render and fuse frames of a .blend in another Blender.

    Args:
        program: of :func:`find_render`.
        file: the .blend.
        scene: the name of the scene in it.
        frames: a range of their numbers.
        outputs: the EXR of each.
        pattern: the name of all of them, with # for the number.
        options: :class:`.options.Options`.
        work: a folder for temporary files.
        overwrite: replace files that exist. Otherwise their frames are left out.
        average: average each frame with its neighbours.

    Returns:
        The reports of msspl-render, one for each frame that it has written.

    Raises:
        Failure: msspl-render failed. The message is its own.
    """
    first, last, step = frames[0], frames[-1], frames.step
    command = [program, file, "-o", pattern, "--frames", f"{first}-{last}x{step}", "--json"]
    command += ["--blender", bpy.app.binary_path or sys.executable]
    command += ["--scene-name", scene, "--view-layer", options.view_layer]
    command += ["--scale", options.scale, "--hr-spp", options.hr_spp, "--filter", options.filter.lower()]
    command += ["--lr-spp", options.lr_spp] if options.lr_spp else []
    command += ["--components"] if options.components else []
    command += ["--threads", options.threads] if options.threads else []
    command += ["--temporal", "auto" if average else "off", "--overwrite" if overwrite else "--skip-existing"]
    before = [_written(path) for path in outputs] if overwrite else [None] * len(outputs)
    done = 0

    def progress(_):
        nonlocal done  # frames are written in order
        while done < len(outputs) and _written(outputs[done]) not in (None, before[done]):
            done += 1
        return f"{done} of {len(outputs)} frames", done / len(outputs)

    return (yield from _run("msspl-render", command, work, progress))


def _run(name, command, work, progress):
    """Run a program that prints JSON, and return that.

    Args:
        name: what messages call the program.
        work: a folder for what it prints.
        progress: takes the file of its messages, and returns what to yield.
    """
    # The program runs in another Python, which must not get the variables of Blender's.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment["PYTHONUTF8"] = "1"  # Paths and messages are in UTF-8 on every platform.
    report, log = Path(work, "report.json"), Path(work, "messages.log")
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
            raise Failure(f"{command[0]}: can't be started ({error.strerror}); check that it is {name}") from error
        try:
            while process.poll() is None:
                yield progress(log)
        finally:
            _end(process)
    if process.returncode:
        lines = _read(log).strip().splitlines() or [f"the program ended with code {process.returncode}"]
        said = next((line for line in lines if line.startswith("error: ")), lines[-1])
        raise Failure(f"{name}: {said.removeprefix('error: ')}", 2 if process.returncode == 2 else 1)
    return json.loads(_read(report))


def _written(path):
    """When a file was written; None if there is none."""
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return None


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
