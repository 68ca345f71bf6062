# SPDX-License-Identifier: GPL-3.0-or-later
"""A short sequence with Cycles' own Vector pass, for :mod:`research.benchmarks.shots`.

    python -m research.datagen.cycles.sequence SEQUENCES

The camera trucks through a plain room in which a cube slides and turns. The files are those of
:mod:`research.benchmarks.render.sequences`, as multi-layer EXRs of Blender itself. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import bpy

from . import materials as mat
from .render import set_up, write_frame

#: Width and height; multiples of every scale.
SIZE = (320, 180)
FRAMES, SCALES, REFERENCE_HALF = 10, (2, 4), 64
#: Metres that the camera and the cube move in a frame, along x, and radians that the cube turns.
TRUCK, SLIDE, TURN = 0.035, -0.05, 0.05


def material(
    name: str, kind: str, scale: float, colours: tuple[tuple[float, ...], tuple[float, ...]], roughness: float
) -> mat.Material:
    """Make a procedural texture of two colours."""
    graph = mat.new(name)
    place = graph.add("ShaderNodeTexCoord").outputs["Object"]
    texture = graph.add(kind, {"Vector": place, "Scale": scale})
    ramp = graph.add("ShaderNodeValToRGB", {"Fac": texture.outputs.get("Fac") or texture})
    for element, colour in zip(ramp.color_ramp.elements, colours, strict=True):
        element.color = (*colour, 1)
    return graph.surface(graph.add("ShaderNodeBsdfPrincipled", {"Base Color": ramp, "Roughness": roughness}))


def build() -> None:
    """Make the room."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    scene = bpy.context.scene
    checker, noise, waves = "ShaderNodeTexChecker", "ShaderNodeTexNoise", "ShaderNodeTexWave"
    floor = material("floor", waves, 1.5, ((0.30, 0.18, 0.09), (0.55, 0.38, 0.22)), 0.35)
    wall = material("wall", noise, 7.0, ((0.25, 0.35, 0.45), (0.75, 0.72, 0.65)), 0.9)
    tiles = material("tiles", checker, 6.0, ((0.75, 0.20, 0.12), (0.80, 0.78, 0.70)), 0.5)
    marble = material("marble", noise, 4.0, ((0.08, 0.10, 0.08), (0.80, 0.82, 0.78)), 0.15)

    def add(kind: str, surface: bpy.types.Material, **where: object) -> bpy.types.Object:
        getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**where)
        made = bpy.context.object
        made.data.materials.append(surface)
        return made

    add("plane", floor, size=8)
    add("plane", wall, size=8, location=(0, 2.5, 0), rotation=(math.pi / 2, 0, 0))
    add("plane", wall, size=8, location=(-3, 0, 0), rotation=(math.pi / 2, 0, math.pi / 2))
    for x, y, radius in ((-1.2, 0.9, 0.5), (1.4, 1.3, 0.35), (0.5, 2.0, 0.3)):
        add("uv_sphere", marble, radius=radius, location=(x, y, radius), segments=64, ring_count=32)
        bpy.ops.object.shade_smooth()
    add("cylinder", tiles, radius=0.25, depth=1.6, location=(-0.4, 1.9, 0.8))
    add("torus", marble, location=(1.0, 0.2, 0.12), major_radius=0.3, minor_radius=0.12)
    cube = add("cube", tiles, size=0.6, location=(0, 0, 0.3))
    for location, size, power in (((1.5, -1.0, 3.2), 0.5, 160.0), ((-2.0, 0.5, 2.8), 0.3, 60.0)):
        bpy.ops.object.light_add(type="AREA", location=location)
        lamp = bpy.context.object
        lamp.data.size, lamp.data.energy = size, power
    bpy.ops.object.camera_add(location=(0, -3.2, 1.4), rotation=(math.radians(78), 0, 0))
    camera = scene.camera = bpy.context.object
    camera.data.lens = 28
    for frame in (0, FRAMES + 1):
        at = frame - (FRAMES + 1) / 2
        camera.location.x = TRUCK * at
        cube.location.x, cube.rotation_euler.z = SLIDE * at, 0.4 + TURN * at
        camera.keyframe_insert("location", frame=frame)
        cube.keyframe_insert("location", frame=frame)
        cube.keyframe_insert("rotation_euler", frame=frame)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    folder = (args.out / "cycles" / "slide").absolute()
    build()
    scene, start = bpy.context.scene, time.perf_counter()
    set_up(scene, args.threads, "ZIP")
    scene.cycles.pixel_filter_type, scene.cycles.max_bounces = "BOX", 8
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = scene.render.use_motion_blur = False
    layer = scene.view_layers[0]
    layer.use_pass_vector = layer.use_pass_position = True
    layer.cycles.denoising_store_passes = True
    kinds = [("hr", 1, 1), ("full", 1, 2), *((f"lr_x{s}", s, s * s) for s in SCALES)]
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        for kind, scale, spp in [*kinds, *((f"ref_{half}", 1, REFERENCE_HALF) for half in "ab")]:
            path = folder / f"{kind}.{frame:04d}.exr"
            if not path.exists():
                write_frame(scene, path, [side // scale for side in SIZE], spp, path.name)
        print(f"frame {frame}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
