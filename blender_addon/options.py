# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of a frame: renders, samples, view layer, and the sizes that follow from the scene."""

from dataclasses import dataclass

import bpy
from bpy.types import Scene, ViewLayer

from .errors import Failure


@dataclass(frozen=True)
class Options:
    """The options with which a frame is rendered and fused."""

    renders: int = 1
    """1; or 2, each with its own noise seed."""
    scale: int = 1
    """The first of two renders has 1/scale of the frame's width and height. If scale > 1, it is the LRHS."""
    hr_spp: int = 0
    """0: chosen by :attr:`hrls_spp`."""
    lr_spp: int = 0
    """0: chosen by :attr:`lrhs_spp`."""
    filter: str = "BOX"
    """``BOX``: an LRHS pixel is exactly the mean of its HRLS pixels. ``SCENE``: the scene's own pixel filter."""
    view_layer: str = ""
    """Empty: the only one that is enabled."""
    components: bool = False
    """Render all component passes, which sum to the beauty, besides the passes that the scene has on."""
    vectors: bool = False
    """Render motion vectors, and different noise in every frame, because frames are averaged with their neighbours."""
    threads: int = 0
    """0: Blender uses the number that the scene sets, and fusing uses one thread per core."""

    @property
    def hrls_spp(self) -> int:
        """Samples per pixel of each render of the frame's size: by default 1 beside an LRHS, otherwise 8 in all."""
        return self.hr_spp or (1 if self.scale > 1 else 8 // self.renders)

    @property
    def lrhs_spp(self) -> int:
        """Samples per pixel of the first of two renders. By default an LRHS takes a third of the HRLS's total samples,
        rounded up, but at least scale² per pixel, which is always more than the HRLS has."""
        if self.scale == 1:
            return self.hrls_spp
        return self.lr_spp or -(-(self.scale**2) * max(3, self.hrls_spp) // 3)


def frame_size(scene: Scene, scale: int = 1) -> tuple[int, int]:
    """Return (width, height) in pixels of the frame, or of its LRHS, rounded up so that it covers the whole frame."""
    render, percent = scene.render, scene.render.resolution_percentage
    width, height = render.resolution_x * percent // 100, render.resolution_y * percent // 100
    return -(-width // scale), -(-height // scale)


def find_view_layer(scene: Scene, options: Options) -> ViewLayer:
    """Return the view layer to render: the named one, or the only one that is enabled."""
    names = [options.view_layer] if options.view_layer else [layer.name for layer in scene.view_layers if layer.use]
    if len(names) != 1:
        seen = f"{len(names)} view layers are on ({', '.join(names)})" if names else "no view layer is on"
        raise Failure(f"scene '{scene.name}': {seen}; choose one with --view-layer NAME")
    view_layer = scene.view_layers.get(names[0])
    if view_layer is None:
        existing = ", ".join(layer.name for layer in scene.view_layers)
        raise Failure(f"scene '{scene.name}' has no view layer '{names[0]}'; it has {existing}")
    return view_layer


def view_layer_path(view_layer: ViewLayer) -> str:
    """Return the data path of a view layer in its scene."""
    return f'view_layers["{bpy.utils.escape_identifier(view_layer.name)}"]'
