# SPDX-License-Identifier: GPL-3.0-or-later
"""How a frame is rendered: scale, samples, view layer, and the two sizes that follow from the scene."""

from dataclasses import dataclass

import bpy

from .errors import Failure


@dataclass(frozen=True)
class Options:
    """How a frame is rendered and fused."""

    scale: int = 4
    """The LRHS has 1/scale of the frame's width and height."""
    hr_spp: int = 1
    lr_spp: int = 0
    """0: chosen by :attr:`lrhs_spp`."""
    filter: str = "BOX"
    """``BOX``: an LRHS pixel is exactly the mean of its HRLS pixels. ``SCENE``: the scene's own pixel filter."""
    view_layer: str = ""
    """Empty: the only one that is enabled."""
    components: bool = False
    """Render all component passes, which together are the beauty, besides the passes that the scene has on."""
    vectors: bool = False
    """Frames are averaged with their neighbours: render motion vectors, and other noise in every frame."""
    threads: int = 0
    """0: Blender uses the number that the scene sets, and fusing uses one thread per core."""

    @property
    def lrhs_spp(self):
        """By default the LRHS takes a third of the HRLS's total samples, rounded up, but at least scale² per pixel.

        That is always more than the HRLS has.
        """
        return self.lr_spp or -(-(self.scale**2) * max(3, self.hr_spp) // 3)


def hrls_size(scene):
    """(width, height) of the frame."""
    render = scene.render
    return tuple(size * render.resolution_percentage // 100 for size in (render.resolution_x, render.resolution_y))


def lrhs_size(scene, scale):
    """(width, height) of the LRHS, rounded up so that it covers the whole frame."""
    return tuple(-(-size // scale) for size in hrls_size(scene))


def find_view_layer(scene, options):
    """The view layer to render.

    Raises:
        Failure: the named view layer does not exist, or none is named and not exactly one is enabled.
    """
    names = [options.view_layer] if options.view_layer else [each.name for each in scene.view_layers if each.use]
    if len(names) != 1:
        seen = f"{len(names)} view layers are on ({', '.join(names)})" if names else "no view layer is on"
        raise Failure(f"scene '{scene.name}': {seen}; choose one with --view-layer NAME")
    found = scene.view_layers.get(names[0])
    if found is None:
        known = ", ".join(each.name for each in scene.view_layers)
        raise Failure(f"scene '{scene.name}' has no view layer '{names[0]}'; it has {known}")
    return found


def view_layer_path(view_layer):
    """Data path of a view layer in its scene."""
    return f'view_layers["{bpy.utils.escape_identifier(view_layer.name)}"]'
