# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a low-resolution-high-spp / high-resolution-low-spp pair of one frame with Cycles.

    python -m research.datagen.cycles.pair --out PAIR

The scene is built in code from a seed. PAIR gets hr.exr, lr.exr and, with --ref-spp, ref.exr, as multi-layer EXRs.
"""

from __future__ import annotations

import argparse
import math
import random
import time
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from . import materials as mat
from .materials import Graph, Material, Socket, rgba
from .render import LIGHT_PASSES, set_up

Point = tuple[float, float, float]


# Materials; colours are linear RGB


def principled(graph: Graph, **inputs: Any) -> Material:
    """Finish with a Principled shader; keyword `Base_Color` sets or links the input `Base Color`."""
    named = {key.replace("_", " "): value for key, value in inputs.items()}
    return graph.surface(graph.add("ShaderNodeBsdfPrincipled", named))


def plain(name: str, color: Point, roughness: float, **inputs: float) -> Material:
    return principled(mat.new(name), Base_Color=color, Roughness=roughness, **inputs)


def place(graph: Graph, scale: Point = (1, 1, 1), turn: float = 0, at: Point = (0, 0, 0)) -> Socket:
    """Return positions in an object, scaled, turned around z by `turn` degrees, and shifted."""
    coords = graph.add("ShaderNodeTexCoord").outputs["Object"]
    inputs = {"Vector": coords, "Scale": scale, "Rotation": (0, 0, math.radians(turn)), "Location": at}
    return graph.add("ShaderNodeMapping", inputs).outputs[0]


def ramp(graph: Graph, factor: Socket, low: tuple[float, Point], high: tuple[float, Point]) -> Socket:
    """Map a factor to a colour between two, each at a value of the factor."""
    node = graph.add("ShaderNodeValToRGB", {0: factor})
    for element, (position, color) in zip(node.color_ramp.elements, (low, high), strict=True):
        element.position, element.color = position, rgba(color)
    return node.outputs["Color"]


def stripes(graph: Graph, vector: Socket, scale: float, direction: str) -> Socket:
    inputs = {"Vector": vector, "Scale": scale, "Distortion": 0}
    return graph.add("ShaderNodeTexWave", inputs, bands_direction=direction).outputs["Fac"]


def wood_floor() -> Material:
    graph = mat.new("Wood Floor")
    planks = graph.add("ShaderNodeTexBrick", {
        "Vector": place(graph, turn=90), "Color1": (0.46, 0.25, 0.11), "Color2": (0.27, 0.13, 0.055),
        "Mortar": (0.03, 0.015, 0.008), "Scale": 1, "Mortar Size": 0.005, "Brick Width": 1.3, "Row Height": 0.17,
    })  # fmt: skip
    inputs = {"Vector": place(graph, scale=(22, 1.6, 1)), "Scale": 3, "Detail": 8, "Roughness": 0.65}
    grain = graph.add("ShaderNodeTexNoise", inputs).outputs[0]
    return principled(graph, Base_Color=graph.mix(0.55, planks.outputs["Color"], grain, "OVERLAY"), Roughness=0.32)


def wallpaper() -> Material:
    graph = mat.new("Wallpaper")
    factor = stripes(graph, place(graph), 2.1, "X")
    return principled(
        graph, Base_Color=ramp(graph, factor, (0.47, (0.33, 0.45, 0.42)), (0.53, (0.42, 0.54, 0.49))), Roughness=0.8
    )


def checker(name: str, a: Point, b: Point, scale: float, roughness: float) -> Material:
    graph = mat.new(name)
    # a turn and an offset keep faces away from the boundaries of the 3-D pattern
    vector = place(graph, turn=3, at=(0.013, 0.017, 0.021))
    squares = graph.add("ShaderNodeTexChecker", {"Vector": vector, "Scale": scale, "Color1": a, "Color2": b})
    return principled(graph, Base_Color=squares, Roughness=roughness)


def tablecloth() -> Material:
    """Make a matte plaid from two crossed wave textures."""
    graph = mat.new("Cloth")
    color: Any = (0.76, 0.71, 0.62)
    flat = graph.add("ShaderNodeTexCoord").outputs["UV"]
    for direction, tint in (("X", (0.55, 0.06, 0.05)), ("Y", (0.10, 0.14, 0.34))):
        share = ramp(graph, stripes(graph, flat, 3.4, direction), (0.62, (0, 0, 0)), (0.70, (0.8, 0.8, 0.8)))
        color = graph.mix(share, color, tint)
    return principled(graph, Base_Color=color, Roughness=0.9, Sheen_Weight=0.4)


def painting() -> Material:
    graph = mat.new("Painting")
    cells = graph.add("ShaderNodeTexVoronoi", {"Vector": place(graph), "Scale": 13}).outputs["Color"]
    return principled(graph, Base_Color=graph.mix(0.55, cells, (0.95, 0.45, 0.12), "OVERLAY"), Roughness=0.5)


def grass_blade() -> Material:
    graph = mat.new("Grass")
    tone = graph.add("ShaderNodeTexNoise", {"Scale": 9, "Detail": 2}).outputs[0]
    return principled(graph, Base_Color=graph.mix(tone, (0.05, 0.20, 0.03), (0.42, 0.50, 0.10)), Roughness=0.5)


def glass() -> Material:
    """Glass whose shadow is clear, so that path tracing it stays quiet."""
    graph = mat.new("Glass")
    bsdf = graph.add("ShaderNodeBsdfGlass", {"Color": (0.95, 0.985, 0.97), "Roughness": 0, "IOR": 1.45})
    shadow = graph.add("ShaderNodeLightPath").outputs["Is Shadow Ray"]
    clear = graph.add("ShaderNodeBsdfTransparent", {"Color": (0.86, 0.90, 0.88)})
    return graph.surface(graph.add("ShaderNodeMixShader", {0: shadow, 1: bsdf, 2: clear}))


# Geometry


def finish(ob: Any, mat: Material, smooth: bool = False) -> Any:
    """Give an object its material and smoothness."""
    ob.data.materials.append(mat)
    if smooth:
        ob.data.polygons.foreach_set("use_smooth", [True] * len(ob.data.polygons))
    return ob


def mesh_object(
    name: str, verts: list[Any], faces: list[Any], mat: Material, smooth: bool = False, at: Point = (0, 0, 0)
) -> Any:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(verts, [], faces)
    mesh.validate()
    ob = bpy.data.objects.new(name, mesh)
    ob.location = at
    bpy.context.scene.collection.objects.link(ob)
    return finish(ob, mat, smooth)


def box(name: str, lo: Point, hi: Point, mat: Material) -> Any:
    c = ((lo[0] + hi[0]) / 2, (lo[1] + hi[1]) / 2, (lo[2] + hi[2]) / 2)
    h = [(hi[i] - lo[i]) / 2 for i in range(3)]
    verts = [(x * h[0], y * h[1], z * h[2]) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh_object(name, verts, faces, mat, at=c)


def tube(name: str, points: list[Point], radius: float, mat: Material) -> Any:
    """Make a thin round wire through points."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", radius, 2
    spline = curve.splines.new("POLY")
    spline.points.add(len(points) - 1)
    for p, q in zip(spline.points, points, strict=True):
        p.co = (*q, 1)
    ob = bpy.data.objects.new(name, curve)
    bpy.context.scene.collection.objects.link(ob)
    return finish(ob, mat)


def cloth(name: str, mat: Material, at: Point) -> Any:
    """Make a round tablecloth: a flat top, a rounded edge and folds that grow towards the hem."""
    n, rings, radius, drop = 220, 44, 0.56, 0.50
    total = radius + drop
    verts: list[Point] = [(0, 0, 0)]
    flat: list[tuple[float, float]] = [(0, 0)]  # where the point lay before it was draped
    for k in range(1, rings + 1):
        s = total * k / rings
        for j in range(n):
            a = 2 * math.pi * j / n
            hang = max(0.0, s - radius)
            fold = (0.6 * math.sin(11 * a) + 0.4 * math.sin(17 * a + 1.3)) * 0.085
            r = min(s, radius) + (0.05 + fold) * (hang / drop) ** 0.8
            z = -hang * (1 - 0.03 * math.sin(5 * a)) - 0.012 * math.exp(-(((s - radius) / 0.03) ** 2))
            verts.append((r * math.cos(a), r * math.sin(a), z))
            flat.append((s * math.cos(a), s * math.sin(a)))
    faces: list[tuple[int, ...]] = [(0, 1 + j, 1 + (j + 1) % n) for j in range(n)]
    for k in range(rings - 1):
        for j in range(n):
            a, b = 1 + k * n + j, 1 + k * n + (j + 1) % n
            faces.append((a, a + n, b + n, b))
    ob = mesh_object(name, verts, faces, mat, smooth=True, at=at)
    uv = ob.data.uv_layers.new(name="Flat")
    for loop in ob.data.loops:
        uv.data[loop.index].uv = flat[loop.vertex_index]
    return ob


def grass(name: str, rng: random.Random, mat: Material, at: Point, radius: float, height: float) -> Any:
    verts: list[Any] = []
    faces: list[Any] = []
    for _ in range(260):
        a, r = rng.uniform(0, 2 * math.pi), radius * math.sqrt(rng.random())
        base = Vector((r * math.cos(a), r * math.sin(a), 0))
        lean = Vector((math.cos(a), math.sin(a), 0)) * rng.uniform(0.05, 0.75) * (0.3 + r / radius)
        h, w, turn = height * rng.uniform(0.55, 1.0), rng.uniform(0.004, 0.009), rng.uniform(0, math.pi)
        side = Vector((math.cos(turn), math.sin(turn), 0)) * w
        first = len(verts)
        for k in range(7):
            t = k / 6
            p = base + Vector((0, 0, h * (t - 0.25 * t**3))) + lean * h * t * t
            verts += [tuple(p - side * (1 - t)), tuple(p + side * (1 - t))]
        faces += [(first + 2 * k, first + 2 * k + 1, first + 2 * k + 3, first + 2 * k + 2) for k in range(6)]
    return mesh_object(name, verts, faces, mat, at=at)


def primitive(kind: str, name: str, mat: Material, smooth: bool = False, **where: Any) -> Any:
    """Add a mesh that Blender has built in."""
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**where)
    ob = bpy.context.object
    ob.name = name
    return finish(ob, mat, smooth)


def sphere(name: str, radius: float, mat: Material, at: Point, segments: int = 64) -> Any:
    rings = segments // 2
    return primitive("uv_sphere", name, mat, True, segments=segments, ring_count=rings, radius=radius, location=at)


def cone(name: str, r1: float, r2: float, depth: float, mat: Material, at: Point, cap: str = "NGON") -> Any:
    shape: dict[str, Any] = {"vertices": 64, "radius1": r1, "radius2": r2, "depth": depth, "end_fill_type": cap}
    return primitive("cone", name, mat, location=at, **shape)


def label(text: str, size: float, mat: Material, at: Point) -> Any:
    curve = bpy.data.curves.new("Text", "FONT")
    curve.body, curve.size, curve.align_x = text, size, "CENTER"
    ob = bpy.data.objects.new(f"Text {text}", curve)
    ob.location, ob.rotation_euler = at, (math.radians(90), 0, 0)
    bpy.context.scene.collection.objects.link(ob)
    return finish(ob, mat)


# The scene


def build_scene(seed: int) -> Any:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = random.Random(seed)
    scene = bpy.context.scene
    white = plain("Paint", (0.80, 0.79, 0.76), 0.45)
    dark = plain("Dark Metal", (0.05, 0.05, 0.055), 0.35, Metallic=1)
    plaster = plain("Plaster", (0.47, 0.55, 0.51), 0.8)
    oak = plain("Oak", (0.34, 0.19, 0.09), 0.4)

    # shell: floor, back wall, a left wall with a barred window
    box("Floor", (-4, -5, -0.1), (4, 2.2, 0), wood_floor())
    wall = wallpaper()
    box("Back Wall", (-2.1, 2.2, 0), (4, 2.3, 3.4), wall)
    box("Skirting", (-4, 2.17, 0), (4, 2.2, 0.13), white)
    x0, x1, ya, yb, za, zb = -2.1, -2.0, 0.15, 1.75, 0.85, 2.35
    parts = [
        ((x0, -5, 0), (x1, ya, 3.4)), ((x0, yb, 0), (x1, 2.2, 3.4)),
        ((x0, ya, 0), (x1, yb, za)), ((x0, ya, zb), (x1, yb, 3.4)),
    ]  # fmt: skip
    for k, (lo, hi) in enumerate(parts):
        box(f"Left Wall {k}", lo, hi, plaster)
    for k in range(1, 4):
        y = ya + (yb - ya) * k / 4
        box(f"Bar V{k}", (x0 + 0.03, y - 0.014, za), (x1 - 0.03, y + 0.014, zb), white)
    for k in range(1, 3):
        z = za + (zb - za) * k / 3
        box(f"Bar H{k}", (x0 + 0.03, ya, z - 0.014), (x1 - 0.03, yb, z + 0.014), white)
    box("Sill", (x0, ya - 0.05, za - 0.04), (x1 + 0.14, yb + 0.05, za), white)

    # rug, pedestal with the head, table with cloth and glass ball
    rug = checker("Rug", (0.60, 0.52, 0.40), (0.13, 0.035, 0.04), 11.0, 0.95)
    box("Rug", (-1.45, -0.95, 0), (0.55, 0.30, 0.012), rug)
    marquetry = checker("Marquetry", (0.36, 0.20, 0.09), (0.13, 0.06, 0.03), 9.0, 0.25)
    box("Pedestal", (-1.02, 0.62, 0), (-0.28, 1.30, 0.62), marquetry)
    gold = plain("Gold", (0.95, 0.56, 0.20), 0.16, Metallic=1)
    head = primitive("monkey", "Suzanne", gold, True, size=0.92, location=(-0.65, 0.93, 1.03))
    head.rotation_euler = (math.radians(-14), 0, math.radians(16))
    head.modifiers.new("Subdivision", "SUBSURF").render_levels = 2

    table = (0.74, 0.62, 0.74)
    cone("Table Leg", 0.20, 0.05, 0.72, oak, (table[0], table[1], 0.36))
    cloth("Tablecloth", tablecloth(), table)
    sphere("Glass Ball", 0.22, glass(), (table[0] - 0.12, table[1] - 0.14, table[2] + 0.22))
    china = plain("China", (0.80, 0.82, 0.86), 0.08)
    sphere("Pearl", 0.085, china, (table[0] + 0.26, table[1] - 0.20, table[2] + 0.085))
    red = plain("Red Lacquer", (0.62, 0.03, 0.03), 0.12, Coat_Weight=1)
    sphere("Cherry", 0.055, red, (table[0] + 0.10, table[1] - 0.37, table[2] + 0.055))

    # pot with grass, wire globe
    pot = plain("Terracotta", (0.52, 0.19, 0.09), 0.8)
    cone("Pot", 0.13, 0.19, 0.30, pot, (1.62, 0.16, 0.15))
    grass("Grass", rng, grass_blade(), (1.62, 0.16, 0.29), radius=0.16, height=0.60)
    steel = plain("Steel", (0.75, 0.77, 0.80), 0.2, Metallic=1)
    globe = primitive("ico_sphere", "Wire Globe", steel, subdivisions=3, radius=0.23, location=(-0.98, -0.30, 0.24))
    globe.rotation_euler = (0.05, 0.0, 0.25)
    globe.modifiers.new("Wireframe", "WIREFRAME").thickness = 0.010

    # pendant lamp: cable, shade, visible bulb, three stay wires
    lamp = Vector((0.10, 0.80, 1.98))
    tube("Cable", [(lamp.x, lamp.y, 3.4), (lamp.x, lamp.y, lamp.z + 0.16)], 0.006, dark)
    shade = plain("Shade", (0.04, 0.20, 0.22), 0.3)
    cone("Shade", 0.26, 0.07, 0.20, shade, lamp + Vector((0, 0, 0.06)), cap="NOTHING")
    bulb = principled(mat.new("Bulb"), Emission_Color=(1.0, 0.72, 0.40), Emission_Strength=38)
    sphere("Bulb", 0.062, bulb, lamp - Vector((0, 0, 0.02)), segments=24)
    for k in range(3):
        a = 2 * math.pi * k / 3 + 0.4
        edge = lamp + Vector((0.26 * math.cos(a), 0.26 * math.sin(a), -0.04))
        tube(f"Stay {k}", [tuple(lamp + Vector((0, 0, 0.62))), tuple(edge)], 0.0035, dark)

    # picture and shelf on the back wall
    box("Frame", (-1.55, 2.12, 1.42), (-0.95, 2.2, 2.22), dark)
    box("Mat", (-1.51, 2.115, 1.46), (-0.99, 2.12, 2.18), white)
    box("Painting", (-1.44, 2.11, 1.66), (-1.06, 2.115, 2.11), painting())
    label("LRHS + HRLS", 0.068, dark, (-1.25, 2.112, 1.535))
    box("Shelf", (0.48, 1.96, 1.38), (1.98, 2.2, 1.42), oak)
    x = 0.55
    while x < 1.86:
        w, h = rng.uniform(0.025, 0.065), rng.uniform(0.24, 0.40)
        hue = rng.choice([
            (0.45, 0.08, 0.06), (0.08, 0.16, 0.34), (0.60, 0.47, 0.24),
            (0.10, 0.25, 0.14), (0.50, 0.50, 0.47), (0.62, 0.28, 0.06),
        ])  # fmt: skip
        cover = plain("Book", hue, rng.uniform(0.25, 0.7))
        book = box("Book", (x, 1.99 + rng.uniform(0, 0.03), 1.42), (x + w, 2.17, 1.42 + h), cover)
        bands = plain("Band", (0.75, 0.60, 0.25), 0.3, Metallic=1)
        y = book.location.y - 0.001 - (2.17 - book.location.y)
        for f in (0.18, 0.80):
            box("Band", (x + 0.002, y, 1.42 + f * h), (x + w - 0.002, y + 0.002, 1.42 + f * h + 0.013), bands)
        x += w + rng.uniform(0.002, 0.006)

    # light: a window-sized area light and the sun outside, a soft fill in front, the sky
    def light(name: str, kind: str, energy: float, color: Point, at: Point, to: Point, **attrs: Any) -> Any:
        data = bpy.data.lights.new(name, kind)
        data.energy, data.color = energy, color
        for key, value in attrs.items():
            setattr(data, key, value)
        ob = bpy.data.objects.new(name, data)
        ob.location = at
        ob.rotation_euler = (Vector(to) - Vector(at)).to_track_quat("-Z", "Y").to_euler()
        scene.collection.objects.link(ob)
        ob.visible_camera = False
        return ob

    window, fill = ({"shape": "RECTANGLE", "size": a, "size_y": b} for a, b in ((1.5, 1.7), (1.6, 1.2)))
    light("Window", "AREA", 85, (0.82, 0.91, 1.0), (-2.35, 0.95, 1.65), (1, 0.2, 0.9), **window)
    light("Sun", "SUN", 11.0, (1.0, 0.84, 0.62), (-4, 1.85, 3.2), (0.2, -0.1, 0), angle=math.radians(0.8))
    light("Fill", "AREA", 30, (1.0, 0.95, 0.88), (1.9, -3.4, 3.0), (0, 0.8, 0.7), **fill)

    world = bpy.data.worlds.new("Sky")
    scene.world = world
    graph = Graph(world)
    up = graph.add("ShaderNodeSeparateXYZ", {0: graph.add("ShaderNodeTexCoord").outputs["Generated"]}).outputs["Z"]
    sky = ramp(graph, up, (0, (0.90, 0.93, 0.95)), (1, (0.30, 0.50, 0.95)))
    graph.surface(graph.add("ShaderNodeBackground", {"Color": sky, "Strength": 0.62}))
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = 512

    data = bpy.data.cameras.new("Camera")
    data.lens = 40
    camera = bpy.data.objects.new("Camera", data)
    camera.location = (0.30, -4.35, 1.42)
    camera.rotation_euler = (Vector((-0.02, 0.8, 0.97)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


# The render


def configure(scene: Any, threads: int) -> None:
    set_up(scene, threads, "ZIP")
    c, r, image, layer = scene.cycles, scene.render, scene.render.image_settings, scene.view_layers[0]
    c.sampling_pattern, c.pixel_filter_type = "TABULATED_SOBOL", "BOX"
    c.caustics_reflective = c.caustics_refractive = False
    c.max_bounces, c.diffuse_bounces, c.glossy_bounces, c.transmission_bounces = 8, 4, 4, 8
    r.use_persistent_data, r.use_motion_blur = True, False
    image.color_depth, image.use_exr_interleave = "16", False
    for name in ("z", "normal", "cryptomatte_object", *LIGHT_PASSES):
        setattr(layer, f"use_pass_{name}", True)
    layer.cycles.denoising_store_passes = True
    layer.pass_cryptomatte_depth = 2


def render(scene: Any, path: Path, size: tuple[int, int], spp: int, seed: int) -> None:
    r = scene.render
    r.resolution_x, r.resolution_y = size
    scene.cycles.samples, scene.cycles.seed = spp, seed
    r.filepath = str(path)
    start = time.time()
    bpy.ops.render.render(write_still=True)
    took = time.time() - start
    print(f"{path.name}: {size[0]}x{size[1]}, {spp} spp, seed {seed}, {took:.1f} s", flush=True)


def size(text: str) -> tuple[int, ...]:
    return tuple(int(v) for v in text.lower().split("x"))


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    p.add_argument("--size", type=size, default=(512, 384), metavar="WxH", help="size of the HRLS render")
    p.add_argument("--scale", type=int, default=4, help="LRHS is rendered at 1/scale of the size")
    p.add_argument("--hr-spp", type=int, default=1)
    p.add_argument("--lr-spp", type=int, default=16)
    p.add_argument("--ref-spp", type=int, default=0, help="0: no reference")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--threads", type=int, default=1)
    args = p.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    scene = build_scene(args.seed)
    configure(scene, args.threads)
    w, h = args.size
    # rounded up: an LRHS render covers all of the frame
    low = -(-w // args.scale), -(-h // args.scale)
    # every render has a seed of its own, else the samples of one would be nested in another's
    jobs = [("hr", (w, h), args.hr_spp, 1), ("lr", low, args.lr_spp, 2), ("ref", (w, h), args.ref_spp, 3)]
    for name, pixels, spp, offset in jobs:
        if spp > 0:
            render(scene, args.out.resolve() / f"{name}.exr", pixels, spp, 1000 * args.seed + offset)


if __name__ == "__main__":
    main()
