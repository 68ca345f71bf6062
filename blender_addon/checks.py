# SPDX-License-Identifier: GPL-3.0-or-later
"""Refuses a scene that cannot be rendered or fused, with a sentence that says what to change."""

import os
from pathlib import Path
from typing import Any

from bpy.types import Scene

from .errors import Failure
from .options import Options, find_view_layer, frame_size, view_layer_path
from .overrides import read


def check_scene(scene: Scene, options: Options) -> None:
    """Check the scene before anything is rendered."""
    render = scene.render
    if render.engine != "CYCLES":
        raise Failure(f"scene '{scene.name}' renders with {render.engine}; set the render engine to Cycles")
    if scene.camera is None:
        raise Failure(f"scene '{scene.name}' has no camera; add one")
    if render.use_border:
        raise Failure(f"scene '{scene.name}' renders a region only; turn Render Region off")
    if render.use_multiview:
        raise Failure(f"scene '{scene.name}' is stereoscopic; turn Stereoscopy off and render one view at a time")
    if render.use_freestyle:
        raise Failure(f"scene '{scene.name}' draws Freestyle lines, which are no noise to remove; turn Freestyle off")
    if min(frame_size(scene, options.scale)) < 4:  # Blender renders no smaller image.
        width, height = frame_size(scene)
        raise Failure(f"{width}x{height} is too small for x{options.scale}; use a smaller scale or a larger frame")
    find_view_layer(scene, options)


def check_animation(scene: Scene, values: dict[str, Any]) -> None:
    """Check that no keyframe or driver changes an overridden setting when the frame is rendered.

    Args:
        values: the ``{data path: value}`` that :func:`.overrides.override` has just set.
    """
    if scene.animation_data is None:
        return
    wanted = {path: read(scene, path) for path in values}  # as Blender stores them, in single precision
    rendered = next(layer for layer in scene.view_layers if layer.use)
    scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
    # Some animated values change only in the evaluated copy, and that copy has only the rendered view layer.
    copy = scene.evaluated_get(rendered.depsgraph)
    for path, value in wanted.items():
        other_layer = path.startswith("view_layers[") and not path.startswith(view_layer_path(rendered))
        if any(read(version, path) != value for version in ([scene] if other_layer else [scene, copy])):
            instead = ", and turn on Animate Seed, the clock beside it" if path == "cycles.seed" else ""
            raise Failure(f"scene '{scene.name}': {path} is animated; remove its keyframes or driver{instead}")


def check_output(path: Path, overwrite: bool) -> None:
    """Check the output before anything is rendered."""
    if path.suffix.lower() != ".exr":
        raise Failure(f"{path}: the result is an EXR; name it .exr")
    if not path.parent.is_dir():
        raise Failure(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise Failure(f"{path}: the folder {path.parent} is not writable; choose another one")
    if path.exists() and not overwrite:
        raise Failure(f"{path}: exists; allow overwriting, or name another file")
