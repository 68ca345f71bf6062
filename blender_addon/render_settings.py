# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene settings of the renders to fuse, as ``{data path: value}``.

Dictionaries of data paths can be merged, read back and restored by code that knows none of the settings.
"""

import re
from typing import Any

import bpy
from bpy.types import Scene

from .options import Options, find_view_layer, frame_size, view_layer_path

BLENDER_5 = bpy.app.version >= (5, 0, 0)

#: The passes of light and colour of each kind of surface.
_DIFFUSE, _GLOSSY, _TRANSMISSION = (
    [f"use_pass_{kind}_{part}" for part in ("direct", "indirect", "color")]
    for kind in ("diffuse", "glossy", "transmission")
)
#: The passes that the network reads. Other passes stay as the user has set them.
_PASSES = ["use_pass_combined", "use_pass_normal", *_DIFFUSE, *_GLOSSY, "cycles.denoising_store_passes"]
#: The passes that component passes add: the remaining surfaces, and the light that no surface reflects.
_COMPONENTS = [*_TRANSMISSION, "use_pass_emit", "cycles.use_pass_volume_direct", "cycles.use_pass_volume_indirect"]
#: Names of linear colour spaces: Linear Rec.2020, lin_ap1, scene_linear, ACEScg, ACES2065-1. Blender does not tell.
_LINEAR = re.compile(r"(?<![a-z])lin(ear)?(?![a-z])|acescg|aces2065", re.IGNORECASE)
#: Added to the scene's seed for the first of two renders. With one seed, both would share samples and their noise.
_FIRST_SEED = 1009


def lrhs(scene: Scene, options: Options) -> dict[str, Any]:
    """Return the settings of the first of two renders. It is the LRHS, unless the scale is 1."""
    (width, height), (full_width, full_height) = frame_size(scene, options.scale), frame_size(scene)
    aspect_x, aspect_y = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
    # The size is rounded up, so the pixel aspect is adjusted until the LRHS shows exactly the frame.
    aspect_x *= (full_width * height) / (full_height * width)
    least = min(aspect_x, aspect_y, 1.0)  # Blender accepts no aspect below 1.
    return _common(scene, options) | {
        "render.resolution_x": width,
        "render.resolution_y": height,
        "render.pixel_aspect_x": aspect_x / least,
        "render.pixel_aspect_y": aspect_y / least,
        "cycles.samples": options.lrhs_spp,
        "cycles.seed": (scene.cycles.seed + _FIRST_SEED) % 2**31,
        # The dicing rate is in pixels. Adaptive subdivision must give both renders the same surface.
        "cycles.dicing_rate": max(0.1, scene.cycles.dicing_rate / options.scale),
    }


def hrls(scene: Scene, options: Options) -> dict[str, Any]:
    """Return the settings of the HRLS, or of the last or only render of the frame's size."""
    width, height = frame_size(scene)
    return _common(scene, options) | {
        "render.resolution_x": width,
        "render.resolution_y": height,
        "cycles.samples": options.hrls_spp,
    }


def _common(scene: Scene, options: Options) -> dict[str, Any]:
    """Return what all renders share: the passes, unbiased and unfiltered noise, and a lossless multilayer EXR."""
    image = scene.render.image_settings
    chosen = find_view_layer(scene, options)
    values = {f"{view_layer_path(layer)}.use": layer == chosen for layer in scene.view_layers}
    passes = [*_PASSES, *(["use_pass_vector"] if options.vectors else [])]
    if options.components:
        # Behind a transparent film, Combined has no environment, but the pass Environment would have it.
        passes += [*_COMPONENTS, *([] if scene.render.film_transparent else ["use_pass_environment"])]
    values |= {f"{view_layer_path(chosen)}.{name}": True for name in passes}
    values |= {
        "cycles.use_denoising": False,
        "cycles.use_adaptive_sampling": False,
        "cycles.time_limit": 0.0,
        "cycles.use_layer_samples": "IGNORE",
        "cycles.use_sample_subset": False,
        # Pixels must have independent noise, and clamping would darken the two renders differently.
        "cycles.sampling_pattern": "TABULATED_SOBOL",
        "cycles.auto_scrambling_distance": False,
        "cycles.scrambling_distance": 1.0,
        "cycles.sample_clamp_direct": 0.0,
        "cycles.sample_clamp_indirect": 0.0,
        "render.resolution_percentage": 100,
        "render.use_single_layer": False,
        "render.use_compositing": False,
        "render.use_sequencer": False,
        "render.use_file_extension": True,
    }
    if options.vectors:  # With one seed, neighbouring frames would share their noise, and no average would remove it.
        values["cycles.use_animated_seed"] = True
    if options.filter == "BOX":
        values["cycles.pixel_filter_type"] = "BOX"
    if options.threads:
        values |= {"render.threads_mode": "FIXED", "render.threads": options.threads}
    if BLENDER_5:
        values["render.image_settings.media_type"] = "MULTI_LAYER_IMAGE"
    values |= {
        "render.image_settings.file_format": "OPEN_EXR_MULTILAYER",
        "render.image_settings.color_mode": "RGBA",
        "render.image_settings.color_depth": image.color_depth if image.file_format.startswith("OPEN_EXR") else "16",
        "render.image_settings.exr_codec": "ZIP",
        # An override, or else the space in which the scene is rendered.
        "render.image_settings.color_management": "OVERRIDE" if linear_override(scene) else "FOLLOW_SCENE",
    }
    name = image.linear_colorspace_settings.name
    if name:  # Blender can change it when the file format is set. It is empty if the configuration lacks it.
        values["render.image_settings.linear_colorspace_settings.name"] = name
    if BLENDER_5:  # Blender 5.0 cannot write several parts if the pixels are not square.
        values["render.image_settings.use_exr_interleave"] = True
    return values


def linear_override(scene: Scene) -> str:
    """Return the colour space that overrides the scene's for its output, if it is linear; otherwise an empty text."""
    image = scene.render.image_settings
    name = image.linear_colorspace_settings.name
    overridden = image.color_management == "OVERRIDE" and image.has_linear_colorspace
    return name if overridden and _LINEAR.search(name) else ""
