# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a scene to the file that its settings name."""

import os
import re
from collections.abc import Iterator

import bpy
from bpy.types import Scene

from .errors import Cancelled, Failure


def render(scene: Scene, file: str, *, window: bool = False) -> Iterator[None]:
    """Render the scene with its present settings, and yield while Blender renders.

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
