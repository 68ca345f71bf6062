# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering a scene to the file that it names."""

import os
import re

import bpy

from .errors import Cancelled, Failure


def render(scene, file, *, window=False):
    """Render the scene with its present settings. This is a generator that yields while Blender renders.

    Args:
        file: the path in ``render.filepath``.
        window: let Blender go on while it renders. The render starts when the caller returns to Blender's event loop.

    Raises:
        Cancelled: the user pressed Esc.
        Failure: Blender could not render or could not write.
    """
    mode = "INVOKE_DEFAULT" if window and not bpy.app.background else "EXEC_DEFAULT"
    try:
        bpy.ops.render.render(mode, write_still=True, scene=scene.name)
    except RuntimeError as error:
        raise Failure(re.sub(r"\s*\n?Error: ", " ", str(error)).strip(), 1) from error
    while bpy.app.is_job_running("RENDER"):
        yield
    if not os.path.isfile(file):
        if bpy.app.background:
            raise Failure(f"{file}: Blender wrote no file", 1)
        raise Cancelled


def escape_path(path):
    """A path for ``render.filepath``, where Blender replaces ``{name}`` by the value of a variable."""
    return path.replace("{", "{{").replace("}", "}}")
