# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs msspl-fuse and msspl-render while Blender goes on.

:func:`fuse` and :func:`render_shot` are generators that yield their progress. Closing one ends its program.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Scene

from .errors import Failure
from .frame import Progress
from .options import Options

#: msspl-fuse prints this after each step if it runs with -v.
_STEP = re.compile(r"step (\d+) of (\d+)")
#: Seconds that a cancelled program has to end the Blender that it has started, and to remove its temporary files.
_GRACE = 20


def find_fuse(preference: str = "") -> str:
    """Find msspl-fuse: in the add-on's preferences, otherwise in ``MSSPL_FUSE``, otherwise on ``PATH``."""
    variable = os.environ.get("MSSPL_FUSE")
    for where, name in (("the add-on's preferences", preference), ("MSSPL_FUSE", variable), ("", "msspl-fuse")):
        program = shutil.which(os.path.expanduser(name)) if name else None
        if program is not None:
            return os.path.abspath(program)
        if name and where:
            raise Failure(f"{name}: no such program; correct the path in {where}")
    raise Failure("msspl-fuse is not on PATH; give its path in the add-on's preferences or in the variable MSSPL_FUSE")


def find_render(preference: str = "") -> str:
    """Find msspl-render, which is installed beside msspl-fuse."""
    fuse = Path(find_fuse(preference))
    program = shutil.which(str(fuse.with_name(f"msspl-render{fuse.suffix}")))
    if program is None:
        raise Failure(f"msspl-render does not lie beside {fuse}; name the msspl-fuse that was installed with it")
    return program


def fuse(
    program: str, options: Sequence[str], work: Path, renders: Sequence[str], output: str
) -> Generator[Progress, None, list[str]]:
    """Fuse one render or two, and return the warnings of msspl-fuse.

    Args:
        program: of :func:`find_fuse`.
        work: a folder for temporary files.

    Raises:
        Failure: msspl-fuse failed. The message is its own.
    """
    # Blender's Image node shows all passes of a single-part file only. The result names its renders, whose folder goes.
    names = [os.path.relpath(render, work) for render in renders]
    command = [program, *names, "-o", output, "--layout", "multilayer", "--no-preview", "--json", "-v", *options]

    def progress(log: Path) -> Progress:
        steps = _STEP.findall(_read(log))
        done = int(steps[-1][0]) / int(steps[-1][1]) if steps else 0
        return "fuse", (len(renders) + done) / (len(renders) + 1)

    report = yield from _run("msspl-fuse", command, work, progress)
    return report["warnings"]


def render_shot(
    program: str, work: Path, scene: Scene, options: Options, pattern: str, outputs: dict[int, str]
) -> Generator[Progress, None, list[dict[str, Any]]]:
    """Render and fuse the frames of a scene that is saved, in another Blender.

    Args:
        program: of :func:`find_render`.
        work: a folder for temporary files.
        pattern: the name of all EXRs, with # for the number.
        outputs: the EXR of each frame, by its number. If the scene does not overwrite, frames that exist are left out.

    Returns:
        The reports of msspl-render, one for each frame that it has written.

    Raises:
        Failure: msspl-render failed. The message is its own.
    """
    overwrite, frames = scene.render.use_overwrite, f"{min(outputs)}-{max(outputs)}x{scene.frame_step}"
    command = [program, bpy.data.filepath, "-o", pattern, "--frames", frames, "--json"]
    command += ["--blender", bpy.app.binary_path or sys.executable]
    command += ["--scene-name", scene.name, "--view-layer", options.view_layer, *model_options(scene)]
    command += ["--renders", str(options.renders), "--scale", str(options.scale), "--filter", options.filter.lower()]
    command += ["--hr-spp", str(options.hrls_spp), "--temporal", "auto" if scene.msspl.average else "off"]
    command += ["--lr-spp", str(options.lr_spp)] if options.lr_spp and options.scale > 1 else []
    command += [*(["--components"] if options.components else []), "--overwrite" if overwrite else "--skip-existing"]
    files = list(outputs.values())
    before, done = [_written(path) if overwrite else None for path in files], 0

    def progress(_: Path) -> Progress:
        nonlocal done  # frames are written in order
        while done < len(files) and _written(files[done]) not in (None, before[done]):
            done += 1
        return f"{done} of {len(files)} frames", done / len(files)

    return (yield from _run("msspl-render", command, work, progress))


def model_options(scene: Scene) -> list[str]:
    """Return the options of both programs that choose the model and the device on which it runs."""
    return ["--quality", scene.msspl.quality.lower(), "--device", scene.msspl.device.lower()]


def _run(
    name: str, command: Sequence[str], work: Path, progress: Callable[[Path], Progress]
) -> Generator[Progress, None, Any]:
    """Run a program in a folder and return the JSON that it prints. ``progress`` gets the file of its messages."""
    # The program runs in another Python, which must not get the variables of Blender's.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["PYTHONUTF8"] = "1"  # Paths and messages are in UTF-8 on every platform.
    report, log = work / "report.json", work / "messages.log"
    with report.open("wb") as out, log.open("wb") as err:
        try:
            process = subprocess.Popen(
                command,
                cwd=work,
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
            process.terminate()  # which does nothing if the program has ended
            try:
                process.wait(_GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    if process.returncode:
        lines = _read(log).strip().splitlines() or [f"the program ended with code {process.returncode}"]
        said = next((line for line in lines if line.startswith("error: ")), lines[-1])
        raise Failure(f"{name}: {said.removeprefix('error: ')}", 2 if process.returncode == 2 else 1)
    try:
        return json.loads(_read(report))
    except ValueError as error:
        raise Failure(f"{command[0]}: printed no report; check that it is {name}, of the add-on's version") from error


def _written(path: str) -> int | None:
    """Return when a file was written, or None if there is no file."""
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return None


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")
