# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a job of msspl-render in Blender, or in a Python that has bpy::

    blender -b scene.blend --python headless.py -- job.json
    python -P headless.py job.json

The job is a JSON object:

    scene      the .blend to open
    scene_name the scene to render, or "" for the active one
    frames     list of [frame number or null for the current frame, EXR to write or null]. A frame without an EXR is
               rendered because its neighbours need it
    work       folder for temporary files, on the same file system as the results
    options    fields of :class:`.options.Options`

Progress, reports and errors are printed. Each is one line: ``MSSPL`` and a JSON object. After the line
``MSSPL {"fuse": [file]}``, or two files, msspl-render fuses these renders, and deletes them when no frame needs them
any more. It then writes a line to standard input. A frame that it can't fuse ends the input.

Before the first frame is rendered comes ``MSSPL {"size": [width, height], "layers": names or null, "pixel_bytes":
number}``: the size of the frame, its passes with colours, and the bytes of all its passes for each pixel (0 if they are
not known). If such a frame can't be fused, msspl-render ends this process.

``MSSPL {"no_vectors": reason}`` says that frames can't be averaged with their neighbours, ``MSSPL {"warning":
sentence}`` that all frames may be wrong.
"""

import importlib
import json
import os
import shutil
import sys
import traceback
from pathlib import Path
from typing import NoReturn

import bpy

# Blender runs this file as a script, so relative imports do not work here.
_FOLDER = Path(__file__).resolve().parent
sys.path.append(str(_FOLDER.parent))
run_job = importlib.import_module(f"{_FOLDER.name}.batch").run_job
Failure = importlib.import_module(f"{_FOLDER.name}.errors").Failure


def send(**message: object) -> None:
    """Print a message for msspl-render."""
    print("MSSPL", json.dumps(message), flush=True)


def receive() -> None:
    """Wait until msspl-render has fused the frame."""
    if not sys.stdin.readline():
        raise Failure("the frame was not fused", 1)


def leave(code: int) -> NoReturn:
    """End the process with an exit code."""
    sys.stdout.flush()
    if bpy.app.binary_path:
        sys.exit(code)
    # A normal exit would run the destructors of bpy, which can hang in 4.5.
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(code)


if __name__ == "__main__":
    try:
        run_job(json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8")), send, receive)
    except Failure as error:
        send(error=str(error), code=error.code)
        leave(error.code)
    except Exception as error:  # Blender would only print the error and end with exit code 0.
        traceback.print_exc(file=sys.stdout)
        send(error=f"unexpected {type(error).__name__} in Blender: {error} (-v shows where)", code=1)
        leave(1)
    leave(0)
