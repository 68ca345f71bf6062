# SPDX-License-Identifier: GPL-3.0-or-later
"""What is set on a scene for the two renders, and put back after them.

Settings are dictionaries of a scene's data paths: they can be added, read back and restored without knowing each one.
"""

import os
import re
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import bpy

from .errors import Cancelled, Failure

V5 = bpy.app.version >= (5, 0, 0)

#: What the network reads besides Combined; passes that are on already stay on.
PASSES = (
    "use_pass_combined",
    "use_pass_normal",
    "use_pass_diffuse_direct",
    "use_pass_diffuse_indirect",
    "use_pass_diffuse_color",
    "use_pass_glossy_direct",
    "use_pass_glossy_indirect",
    "use_pass_glossy_color",
    "cycles.denoising_store_passes",
)
_held = []  #: what :func:`settings` holds now: (scene's name and session_uid, values, the user's)
LR_SEED = 1009  #: added to the scene's seed: with the same one, the LRHS would repeat the HRLS's samples


@dataclass(frozen=True)
class Options:
    """How a frame is rendered and fused."""

    scale: int = 4
    hr_spp: int = 1
    lr_spp: int = 0
    """0: in all, a third of the samples that the HRLS has, at least as many as it has pixels."""
    filter: str = "BOX"
    """``BOX``: an LRHS pixel is exactly the mean of its HRLS pixels; ``SCENE``: the scene's own pixel filter."""
    view_layer: str = ""
    """Empty: the only one that is on."""
    threads: int = 0
    """0: one a core."""

    @property
    def low_spp(self):
        return self.lr_spp or self.scale**2 * max(1, round(self.hr_spp / 3))


def high_size(scene):
    """(width, height) of the frame."""
    render = scene.render
    return tuple(size * render.resolution_percentage // 100 for size in (render.resolution_x, render.resolution_y))


def low_size(scene, scale):
    """(width, height) of the LRHS: rounded up, so that it covers all of the frame."""
    return tuple(-(-size // scale) for size in high_size(scene))


def layer(scene, options):
    """The view layer to render.

    Raises:
        Failure: there is none of that name, or several are on and none is named.
    """
    names = [options.view_layer] if options.view_layer else [each.name for each in scene.view_layers if each.use]
    if len(names) != 1:
        seen = f"{len(names)} view layers are on ({', '.join(names)})" if names else "no view layer is on"
        raise Failure(f"scene '{scene.name}': {seen}; name the one to render")
    found = scene.view_layers.get(names[0])
    if found is None:
        known = ", ".join(each.name for each in scene.view_layers)
        raise Failure(f"scene '{scene.name}' has no view layer '{names[0]}'; it has {known}")
    return found


def _path(view_layer):
    return f'view_layers["{bpy.utils.escape_identifier(view_layer.name)}"]'


def check(scene, options):
    """Refuse what can't be fused, before anything is rendered.

    Raises:
        Failure: the sentence says what to change.
    """
    render = scene.render
    if render.engine != "CYCLES":
        raise Failure(f"scene '{scene.name}' renders with {render.engine}; set the render engine to Cycles")
    if scene.camera is None:
        raise Failure(f"scene '{scene.name}' has no camera; add one")
    if render.use_border:
        raise Failure(f"scene '{scene.name}' renders a region only; turn Render Region off")
    if render.use_multiview:
        raise Failure(f"scene '{scene.name}' is stereoscopic; turn Stereoscopy off and render a view at a time")
    if render.use_freestyle:
        raise Failure(f"scene '{scene.name}' draws Freestyle lines, as thick in both sizes; turn Freestyle off")
    if min(low_size(scene, options.scale)) < 4:  # Blender renders no smaller
        width, height = high_size(scene)
        raise Failure(f"{width}x{height} is too small for x{options.scale}; use a smaller scale")
    layer(scene, options)


def _common(scene, options):
    """What is read of either render, and noise that is independent from pixel to pixel, unbiased and unfiltered; all of
    it written losslessly."""
    image = scene.render.image_settings
    one = layer(scene, options)
    values = {f"{_path(each)}.use": each == one for each in scene.view_layers}
    values |= {f"{_path(one)}.{name}": True for name in PASSES}
    values |= {
        "cycles.use_denoising": False,
        "cycles.use_adaptive_sampling": False,
        "cycles.time_limit": 0.0,
        "cycles.use_layer_samples": "IGNORE",
        "cycles.use_sample_subset": False,
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
    if options.filter == "BOX":
        values["cycles.pixel_filter_type"] = "BOX"
    if options.threads:
        values |= {"render.threads_mode": "FIXED", "render.threads": options.threads}
    if V5:
        values["render.image_settings.media_type"] = "MULTI_LAYER_IMAGE"
    values |= {
        "render.image_settings.file_format": "OPEN_EXR_MULTILAYER",
        "render.image_settings.color_mode": "RGBA",
        "render.image_settings.color_depth": image.color_depth if image.file_format.startswith("OPEN_EXR") else "16",
        "render.image_settings.exr_codec": "ZIP",
        "render.image_settings.color_management": "FOLLOW_SCENE",
    }
    if V5:  # one part: Blender 5.0 can't write several when pixels are not square
        values["render.image_settings.use_exr_interleave"] = True
    return values


def low(scene, options):
    """Settings of the LRHS."""
    (width, height), (high_width, high_height) = low_size(scene, options.scale), high_size(scene)
    aspect_x, aspect_y = scene.render.pixel_aspect_x, scene.render.pixel_aspect_y
    # Sizes that were rounded must still show the whole frame: the pixels are that much out of square. Aspects are >= 1.
    aspect_x *= (high_width * height) / (high_height * width)
    least = min(aspect_x, aspect_y, 1.0)
    return _common(scene, options) | {
        "render.resolution_x": width,
        "render.resolution_y": height,
        "render.pixel_aspect_x": aspect_x / least,
        "render.pixel_aspect_y": aspect_y / least,
        "cycles.samples": options.low_spp,
        "cycles.seed": (scene.cycles.seed + LR_SEED) % 2**31,
        # In pixels of the render: adaptive subdivision must give both renders the same surface.
        "cycles.dicing_rate": max(0.1, scene.cycles.dicing_rate / options.scale),
    }


def high(scene, options):
    """Settings of the HRLS."""
    width, height = high_size(scene)
    return _common(scene, options) | {
        "render.resolution_x": width,
        "render.resolution_y": height,
        "cycles.samples": options.hr_spp,
    }


def plain(scene, options, spp):
    """Settings of an ordinary render that Cycles denoises with OIDN, at its best."""
    # It loads the scene itself, as the LRHS had to.
    return high(scene, options) | {
        "render.use_persistent_data": False,
        "cycles.samples": spp,
        "cycles.use_denoising": True,
        f"{_path(layer(scene, options))}.cycles.use_denoising": True,
        "cycles.denoiser": "OPENIMAGEDENOISE",
        "cycles.denoising_input_passes": "RGB_ALBEDO_NORMAL",
        "cycles.denoising_prefilter": "ACCURATE",
        "cycles.denoising_quality": "HIGH",
    }


@contextmanager
def settings(scene, values):
    """Set ``{data path: value}`` on a scene for a while; what was there comes back, however the block ends."""
    identity = scene.name, scene.session_uid
    old = {path: getattr(*_owner(scene, path)) for path in values}
    held = identity, values, old
    _held.append(held)
    try:
        _apply(scene, values)
        yield
    finally:
        _held.remove(held)
        with suppress(Failure):
            # In the same order: a file format is only known once its media type is set.
            _apply(find_scene(*identity), old)


@bpy.app.handlers.persistent
def put_back(*_):
    """Before a file is saved: it gets the user's settings."""
    for identity, _, old in reversed(_held):
        with suppress(Failure):
            _apply(find_scene(*identity), old)


@bpy.app.handlers.persistent
def set_again(*_):
    """After a file is saved."""
    for identity, values, _ in _held:
        with suppress(Failure):
            _apply(find_scene(*identity), values)


def find_scene(name, uid):
    """The scene that had this ``session_uid``: undo makes another object of it, and no reference lives through that.

    Raises:
        Failure: there is none any more.
    """
    found = next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)
    if found is None:
        raise Failure(f"scene '{name}' was removed while it was rendered; bring it back and do it again")
    return found


def literal(path):
    """A path for ``render.filepath``, where ``{name}`` would be the value of a variable."""
    return path.replace("{", "{{").replace("}", "}}")


def check_animation(scene, values):
    """Refuse settings that keyframes or drivers take back when the frame is rendered.

    Args:
        values: what :func:`settings` has just set.

    Raises:
        Failure: one has another value now.
    """
    if scene.animation_data is None:
        return
    wanted = {path: getattr(*_owner(scene, path)) for path in values}  # as it is stored: single precision
    one = next(each for each in scene.view_layers if each.use)
    scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
    # Not everything that is animated shows in the scene itself. The copy that is rendered has one view layer only.
    copy = scene.evaluated_get(one.depsgraph)
    for path, value in wanted.items():
        here = [scene] if path.startswith("view_layers[") and not path.startswith(_path(one)) else [scene, copy]
        if any(getattr(*_owner(each, path)) != value for each in here):
            raise Failure(f"scene '{scene.name}': {path} is animated; remove its keyframes or driver")


def _owner(scene, path):
    head, _, name = path.rpartition(".")
    return scene.path_resolve(head), name


def _apply(scene, values):
    for path, value in values.items():
        setattr(*_owner(scene, path), value)


def render(scene, file, *, window=False):
    """Render the scene as it is set, to the file that it names, as steps.

    Args:
        window: Blender goes on meanwhile. Only for a caller that lets it: the render begins when Blender is back at its
            own events.

    Raises:
        Cancelled: the user pressed Esc.
        Failure: Blender could not render or write.
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
