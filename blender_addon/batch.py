# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders and fuses a list of frames without a window, as :mod:`.headless` gets them from msspl-render."""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import bpy
from bpy.types import Scene

from . import render_settings
from .checks import check_scene
from .errors import Failure
from .frame import Progress, Report, loaded_once, render_frame
from .options import Options, find_view_layer, frame_size
from .overrides import override

#: Prints a message for msspl-render, given as keyword arguments.
Send = Callable[..., None]


def run_job(job: dict[str, Any], send: Send, receive: Callable[[], None]) -> None:
    """Render every frame of a job, and let msspl-render fuse it.

    Args:
        job: the dictionary that :mod:`.headless` describes.
        send: gets the progress, the files to fuse, and the report of each frame.
        receive: waits until the files are fused.

    Raises:
        Failure: a frame failed. The frames before it are complete.
    """
    if bpy.app.version < (4, 5, 0):
        raise Failure(f"Blender {bpy.app.version_string} is too old; use 4.5 or later")
    _open_scene(job["scene"], job["scene_name"])
    if bpy.app.autoexec_fail:
        send(
            warning=f"Blender did not run the scripts and drivers of {job['scene']} ({bpy.app.autoexec_fail_message}); "
            "allow them with Auto Run Python Scripts in Blender's preferences"
        )
    scene, options = bpy.context.scene, Options(**job["options"])
    if options.vectors and scene.render.use_motion_blur:
        send(no_vectors="motion blur is on, and Cycles then writes no motion vectors; turn it off")
        options = replace(options, vectors=False)
    with loaded_once(scene):
        for index, (number, output) in enumerate(job["frames"]):
            if number is not None:
                scene.frame_set(number)
            check_scene(scene, options)
            if index == 0:
                send(size=frame_size(scene), **_passes(scene, options))
            if output is not None or options.vectors:
                for step, fraction in _run_frame(scene, options, Path(job["work"]), output, send, receive):
                    send(frame=scene.frame_current, step=step, fraction=fraction)


def _open_scene(file: str, name: str) -> None:
    """Open a .blend, unless Blender has opened one, and activate a scene; with an empty name the scene stays."""
    if not bpy.data.filepath:
        try:
            bpy.ops.wm.open_mainfile(filepath=file)
        except RuntimeError as error:
            raise Failure(f"{file}: can't be opened ({str(error).strip()})") from error
    if name:
        if name not in bpy.data.scenes:
            raise Failure(f"{file}: has no scene '{name}'; it has {', '.join(scene.name for scene in bpy.data.scenes)}")
        bpy.context.window.scene = bpy.data.scenes[name]


def _passes(scene: Scene, options: Options) -> dict[str, Any]:
    """Return the passes that both renders will have, for the message that :mod:`.headless` describes."""
    try:
        from cycles.engine import list_render_passes

        with override(scene, render_settings.hrls(scene, options)):
            passes = list(list_render_passes(scene, find_view_layer(scene, options)))
            value_bytes = 2 if scene.render.image_settings.color_depth == "16" else 4
        colours = [name for name, _, kind in passes if kind == "COLOR"]
        return {"layers": colours, "pixel_bytes": value_bytes * sum(len(channels) for _, channels, _ in passes)}
    except (ImportError, AttributeError, TypeError, ValueError):
        # Cycles lists them for Blender, and may do so in another way one day.
        return {"layers": None, "pixel_bytes": 0}


def _run_frame(
    scene: Scene, options: Options, work: Path, output: str | None, send: Send, receive: Callable[[], None]
) -> Iterator[Progress]:
    """Render a frame and have it fused. A frame without an output is rendered for its neighbours."""
    number = scene.frame_current
    folder = work / str(number)
    folder.mkdir()
    renders = yield from render_frame(scene, options, folder)
    yield "fuse", len(renders) / (len(renders) + 1)
    start = time.perf_counter()
    send(fuse=[part.file for part in renders])  # msspl-render keeps its model loaded
    receive()
    if output is not None:
        # msspl-render has warnings of its own, and may not have written this frame yet.
        report = Report(output, renders, time.perf_counter() - start, warnings=[])
        send(report={"frame": number, "seconds": report.seconds, "plain_spp": report.plain_spp, **asdict(report)})
