# SPDX-License-Identifier: GPL-3.0-or-later
"""A short sequence with Cycles' own Vector pass, for :mod:`research.benchmarks.shots`.

    python -m research.datagen.cycles.sequence SEQUENCES

The camera trucks through a plain room in which a cube slides and turns. The files are those of
:mod:`research.benchmarks.render.sequences`, as multi-layer EXRs of Blender itself; ``mask.####.exr`` says where the
cube is.
Files that exist are kept.
"""

from __future__ import annotations

import argparse
import math
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import OpenImageIO as oiio

if TYPE_CHECKING:
    import bpy

#: Width and height; multiples of every scale.
SIZE = (320, 180)
FRAMES, SCALES, REFERENCE_HALF = 10, (2, 4), 64
#: Metres that the camera and the cube move in a frame, along x, and radians that the cube turns.
TRUCK, SLIDE, TURN = 0.035, -0.05, 0.05


def material(
    name: str, kind: str, scale: float, colours: tuple[tuple[float, ...], tuple[float, ...]], roughness: float
) -> Any:
    """Make a procedural texture of two colours."""
    import bpy

    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    texture = nodes.new(kind)
    texture.inputs["Scale"].default_value = scale
    ramp = nodes.new("ShaderNodeValToRGB")
    for element, colour in zip(ramp.color_ramp.elements, colours, strict=True):
        element.color = (*colour, 1)
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Object"], texture.inputs["Vector"])
    links.new(texture.outputs.get("Fac") or texture.outputs[0], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return made


def build() -> None:
    """Make the room. The cube that moves has the pass index 1."""
    import bpy

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
    cube.pass_index = 1
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


def set_up(threads: int) -> None:
    """Set what all files share."""
    import bpy

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    settings, output = scene.cycles, scene.render
    settings.device, settings.pixel_filter_type = "CPU", "BOX"
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.sample_clamp_indirect = 0.0
    settings.max_bounces = 8
    settings.caustics_reflective = settings.caustics_refractive = False
    output.threads_mode, output.threads = "FIXED", threads
    output.use_motion_blur = output.use_compositing = output.use_sequencer = False
    output.resolution_percentage, output.dither_intensity = 100, 0.0
    image = output.image_settings
    image.media_type, image.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec, image.use_exr_interleave = "32", "ZIP", True
    layer = scene.view_layers[0]
    layer.use_pass_vector = layer.use_pass_object_index = layer.use_pass_position = True
    layer.cycles.denoising_store_passes = True


def write_mask(render: Path, path: Path) -> None:
    """Where the moving object is in a render."""
    image = oiio.ImageBuf(str(render))
    names = image.spec().channelnames
    index = next(i for i, name in enumerate(names) if name.endswith(".Object Index.X"))
    moves = np.asarray(image.get_pixels(oiio.FLOAT))[..., index : index + 1] > 0.5
    spec = oiio.ImageSpec(*SIZE, 2, "half")
    spec.channelnames = ("moves.Y", "reflects.Y")
    mask = oiio.ImageBuf(spec)
    mask.set_pixels(oiio.ROI(), np.concatenate([moves, np.zeros_like(moves)], axis=-1).astype(np.float32))
    if not mask.write(str(path)):
        raise SystemExit(f"{path}: {mask.geterror()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    import bpy

    folder = (args.out / "cycles" / "slide").absolute()
    build()
    set_up(args.threads)
    scene, start = bpy.context.scene, time.perf_counter()
    kinds = [("hr", 1, 1), ("full", 1, 2), *((f"lr_x{s}", s, s * s) for s in SCALES)]
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        for kind, scale, spp in [*kinds, *((f"ref_{half}", 1, REFERENCE_HALF) for half in "ab")]:
            path = folder / f"{kind}.{frame:04d}.exr"
            if path.exists():
                continue
            scene.render.resolution_x, scene.render.resolution_y = (side // scale for side in SIZE)
            scene.cycles.samples, scene.cycles.seed = spp, zlib.crc32(path.name.encode()) % 2**31
            scene.render.filepath = str(path.with_name("part.exr"))
            bpy.ops.render.render(write_still=True)
            path.with_name("part.exr").replace(path)
        write_mask(folder / f"hr.{frame:04d}.exr", folder / f"mask.{frame:04d}.exr")
        print(f"frame {frame}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
