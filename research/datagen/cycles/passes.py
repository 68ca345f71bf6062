# SPDX-License-Identifier: GPL-3.0-or-later
"""Pairs and references with light groups and all component passes, for :mod:`research.benchmarks.passes`.

    python -m research.datagen.cycles.passes PASSES

Of every seed a folder ``cycles_SEED_FILTER`` is written, with the files that :mod:`research.benchmarks.render.passes`
describes:
HRLS of 1, 2 and 4 spp, LRHS with 1 and 2 samples a HRLS pixel, and a reference. Each is the multi-layer EXR of Blender
itself. Every lamp is in one of at most `GROUPS` light groups; the world has a group of its own. Caustics are off,
because a reference with caustics takes too many samples. Files that exist are kept.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import bpy

from . import scenes
from .render import Renderer, find_cameras, write_frame

#: Width and height; multiples of every scale.
SIZE = (384, 216)
#: (seed, pixel filter). Seeds of test scenes, which training never sees: see :func:`research.datagen.views.split_of`.
#: They show metal and glass under softboxes, a room with dozens of lights, glassware, and a room with three lamps.
VIEWS = ((11261, "BOX"), (10441, "BLACKMAN_HARRIS"), (10921, "BOX"), (10121, "BLACKMAN_HARRIS"))
SCALES, HRLS, LRHS = (2, 4), (1, 2, 4), (1, 2)
#: Samples per pixel of a reference.
REFERENCE = 512
#: Most light groups of lamps.
GROUPS = 4
#: The components that sum to Combined. Combined itself is always on.
PASSES = (
    *(f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")),
    "emit",
    "environment",
)


def emits(thing: bpy.types.Object) -> bool:
    """Whether an object is a lamp or has a glowing material."""
    if thing.type == "LIGHT":
        return not thing.data.cycles.is_portal
    materials = [slot.material for slot in thing.material_slots if slot.material and slot.material.use_nodes]
    return any(node.bl_idname == "ShaderNodeEmission" for material in materials for node in material.node_tree.nodes)


def group_lights(scene: bpy.types.Scene) -> None:
    """Put lamps that follow each other into one light group, and the world into its own."""
    groups = scene.view_layers[0].lightgroups
    lamps = [thing for thing in scene.objects if emits(thing)]
    count = min(GROUPS, len(lamps))
    for i in range(count):
        name = groups.add(name=f"lamps_{i + 1}").name
        for lamp in lamps[len(lamps) * i // count : len(lamps) * (i + 1) // count]:
            lamp.lightgroup = name
    if scene.world:
        scene.world.lightgroup = groups.add(name="world").name


def render(out: Path, seed: int, pixel_filter: str, threads: int) -> None:
    """Render the files of one seed that do not exist yet."""
    folder = out / f"cycles_{seed}_{pixel_filter.lower()}"
    jobs = [(f"hr_{spp}spp", 1, spp) for spp in HRLS]
    jobs += [(f"lr_x{scale}_{scale**2 * spp}spp", scale, scale**2 * spp) for scale in SCALES for spp in LRHS]
    missing = [job for job in [*jobs, ("ref", 1, REFERENCE)] if not (folder / f"{job[0]}.exr").exists()]
    if not missing:
        return
    stage = scenes.build(seed)
    stage.caustics = False
    group_lights(stage.scene)  # before the first render, because persistent data does not notice new groups
    with tempfile.TemporaryDirectory() as scratch:
        renderer = Renderer(Path(scratch), stage, threads)
        if next(find_cameras(renderer, stage, seed, 0), None) is None:
            raise SystemExit(f"seed {seed}: no camera sees the scene; choose another seed")
    scene = stage.scene
    layer, image = scene.view_layers[0], scene.render.image_settings
    renderer.layers(True)
    for name in PASSES:
        setattr(layer, f"use_pass_{name}", True)
    layer.cycles.use_pass_volume_direct = layer.cycles.use_pass_volume_indirect = True
    image.color_depth, image.exr_codec = "16", "ZIP"
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = pixel_filter, 1.5
    for name, scale, spp in missing:
        write_frame(scene, folder / f"{name}.exr", [side // scale for side in SIZE], spp, f"{seed} {name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    for seed, pixel_filter in VIEWS:
        start = time.perf_counter()
        render(args.out, seed, pixel_filter, args.threads)
        print(f"seed {seed}, {pixel_filter}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
