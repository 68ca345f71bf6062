# SPDX-License-Identifier: GPL-3.0-or-later
# ruff: noqa: RUF005 -- adding a tuple to an array is a sum, not a concatenation
"""Random scenes for Cycles. A seed and the asset files determine a scene.

Most scenes are hard for a path tracer: sun and sky through small openings, lamps in shades, round corners and behind
partitions, dozens of small lights, caustics, fur, wires, fog. About one scene in six is easy.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np
from mathutils import Matrix, Vector

from research.datagen import meshes as geo
from research.datagen import textures as tex

from . import materials as mat
from .materials import Rng, chance, log_uniform
from .stage import Stage, blender_mesh

VERSION = 1  # of the generator: raise it when a seed would give another scene


def _size(rng: Rng, low: float = 3.0, high: float = 7.0) -> tuple[float, float, float]:
    return rng.uniform(low, high), rng.uniform(low, high), rng.uniform(2.3, 3.6)


def _glow(s: Stage, hue: float, low: float, high: float) -> mat.Material:
    return mat.lamp(s.tint(hue) * log_uniform(s.rng, low, high))


def daylight(s: Stage) -> None:
    """Build a closed room lit by sun and sky through small openings."""
    rng = s.rng
    s.room(_size(rng), int(rng.integers(2, 8)), 0.75)
    s.sky(log_uniform(rng, 0.5, 3), 0.7)
    if chance(rng, 0.7):
        s.portals()
    s.furnish(int(rng.integers(3, 9)))
    s.clutter(1, 6)
    if chance(rng, 0.2):
        s.bulb()


def lamps(s: Stage) -> None:
    """Build a room without daylight: one to three difficult lamps."""
    rng = s.rng
    s.room(_size(rng), 0)
    s.furnish(int(rng.integers(3, 9)))
    s.clutter(1, 6)
    kinds = [s.bulb, s.bulb, s.shaded, s.shaded, s.cove, s.behind, s.beam, s.tube, s.panel]
    for _ in range(rng.integers(1, 4)):
        kinds[rng.integers(len(kinds))]()


def many_lights(s: Stage) -> None:
    """Dozens of small lights and shiny things."""
    rng = s.rng
    s.room(_size(rng), int(chance(rng, 0.3)))
    s.sky(log_uniform(rng, 0.01, 0.1), 0.0)
    s.furnish(int(rng.integers(2, 7)))
    s.clutter(1, 5, shiny=0.45)
    for _ in range(rng.integers(1, 4)):
        s.string(int(rng.integers(10, 60)))
    if chance(rng, 0.5):
        s.tube()


def glassware(s: Stage) -> None:
    """Glass and metal on a table under small lights, caustics on."""
    rng = s.rng
    s.caustics = chance(rng, 0.8)
    s.room(_size(rng, 2.5, 4.5), int(chance(rng, 0.3)))
    s.sky(log_uniform(rng, 0.1, 1))
    s.add(geo.table(1.8, 1.2, 0.75, 0.07), mat.paint(rng, 0.2, 2))
    s.tops.append((np.array([0, 0, 0.75]), 0.6, 0.4))
    s.clutter(4, 12, shiny=0.25, clear=0.55)
    s.furnish(int(rng.integers(0, 3)))
    kinds = [s.bulb, s.bulb, s.shaded, s.beam, s.panel]
    for _ in range(rng.integers(1, 4)):
        kinds[rng.integers(len(kinds))]()


def corridor(s: Stage) -> None:
    """Build a long room with columns, its only light at the far end, round a corner or through a slit."""
    rng = s.rng
    length, width = rng.uniform(6, 12), rng.uniform(1.6, 3.5)
    s.room((width, length, rng.uniform(2.4, 4)), int(rng.integers(0, 3)), 0.8)
    s.sky(log_uniform(rng, 0.3, 3), 0.9)
    material = mat.paint(rng, 0.4, 2, True)
    for y in np.arange(-length / 2 + 1, length / 2 - 0.5, rng.uniform(0.8, 2)):
        r = rng.uniform(0.06, 0.2)
        for x in (-width / 2 + 0.3, width / 2 - 0.3):
            high = s.corners[1][2]
            column = geo.cylinder(r, high) if chance(rng, 0.5) else geo.block(2 * r, 2 * r, high)
            s.add(column, material, (x, y, 0))
        s.focus.append(np.array([0, y, rng.uniform(0.3, 1.5)]))
    end = np.array([rng.uniform(-0.5, 0.5), (length / 2 - 0.4) * rng.choice([-1, 1]), rng.uniform(0.3, 2)])
    wall = geo.box((-width * 0.35, -0.05, 0), (width * 0.35, 0.05, s.corners[1][2] * rng.uniform(0.7, 1)))
    s.add(wall, material, (rng.choice([-1, 1]) * width * 0.2, end[1] * 0.8, 0))
    s.lamp("POINT", end, log_uniform(rng, 60, 400), s.tint(), shadow_soft_size=log_uniform(rng, 0.01, 0.2))
    for _ in range(rng.integers(3, 9)):
        s.put(s.spot(), rng.uniform(0.15, 0.8))
    for _ in range(rng.integers(0, 4)):
        s.hang_picture()
    if chance(rng, 0.5):
        s.panel()


def outdoors(s: Stage) -> None:
    """Ground with grass, trees, rocks, fences and walls under a sky."""
    rng = s.rng
    s.sky(1.0)
    n = 120
    x, y = np.meshgrid(np.linspace(-15, 15, n), np.linspace(-15, 15, n), indexing="ij")
    low = 0.25 * rng.random()
    height = low * sum(np.sin(x * a + b) * np.sin(y * c + d) for a, b, c, d in rng.uniform(0.2, 2, (4, 4)))
    s.add(geo.surface(np.stack([x, y, height], -1), np.stack([x, y], -1)), mat.paint(rng, 0.1, log_uniform(rng, 1, 10)))

    def ground(px: float, py: float) -> float:
        row, column = (int(np.clip((position + 15) / 30 * (n - 1), 0, n - 1)) for position in (px, py))
        return float(height[row, column])

    if chance(rng, 0.65):
        roots = np.c_[rng.normal(size=(250, 2)) * 0.25, np.zeros(250)]
        blades = geo.blades(rng, roots, rng.uniform(0.08, 0.5), rng.uniform(0.004, 0.02), rng.uniform(0.1, 0.8))
        tuft, material = blender_mesh(blades), mat.leaf(rng)
        for px, py in rng.normal(size=(int(rng.integers(60, 250)), 2)) * rng.uniform(1, 3.5):
            turn = Matrix.Rotation(rng.uniform(0, 6.3), 4, "Z")
            s.place(tuft, material, Matrix.Translation((px, py, ground(px, py))) @ turn)
    for _ in range(rng.integers(0, 3)):
        tall = rng.uniform(1.5, 5)
        trunk, tips = geo.branching(rng, tall, 0.03 * tall, 3)
        bark, green = mat.paint(rng, 0.2, 10), mat.leaf(rng)
        wood = blender_mesh(trunk)
        centres = np.repeat(tips, 5, 0) + rng.normal(size=(5 * len(tips), 3)) * 0.15
        crown = blender_mesh(geo.leaves(rng, centres, rng.uniform(0.05, 0.25)))
        for px, py in rng.normal(size=(int(rng.integers(1, 5)), 2)) * 3.5:
            turn = Matrix.Rotation(rng.uniform(0, 6.3), 4, "Z") @ Matrix.Scale(rng.uniform(0.6, 1.2), 4)
            spin = Matrix.Translation((px, py, ground(px, py))) @ turn
            s.place(wood, bark, spin)
            s.place(crown, green, spin)
            s.focus.append(np.array([px, py, tall * rng.uniform(0.2, 0.7)]))
    for _ in range(rng.integers(1, 4)):
        p, length, angle = rng.normal(size=2) * 3, rng.uniform(2, 6), rng.uniform(0, 6.3)
        at = (*p, ground(*p))
        if chance(rng, 0.6):
            fence = geo.bars(length, rng.uniform(0.5, 1.5), int(length / rng.uniform(0.04, 0.2)),
                             log_uniform(rng, 0.006, 0.03), chance(rng, 0.3))  # fmt: skip
            s.add(fence.moved(-length / 2, 0, 0).turned(angle), mat.thing(rng, 0.5, 0.4, 0.0), at)
        else:
            house = geo.wall(length, rng.uniform(1.8, 4), 0.25, [(length * 0.3, 0.6, length * 0.6, 1.5)])
            s.add(house.moved(-length / 2, 0, 0).turned(angle), mat.paint(rng, 0.1, 1.5), at)
        s.focus.append(np.array([*p, at[2] + 0.6]))
    for _ in range(rng.integers(3, 12)):
        p = rng.normal(size=2) * 1.5
        s.put(np.array([*p, ground(*p)]), log_uniform(rng, 0.12, 1.5))


def street(s: Stage) -> None:
    """Night: lit windows, street lamps, signs, wet ground, often mist."""
    rng = s.rng
    s.dim_world(log_uniform(rng, 0.0005, 0.05))
    graph = mat.new("asphalt")
    puddles = {"Vector": graph.coordinates(rng.uniform(0.3, 2)), "Scale": 1, "Detail": 6}
    wet = graph.threshold(graph.add("ShaderNodeTexNoise", puddles).outputs[0], 0.5, 0.15)
    rough = graph.span(wet, rng.uniform(0.0, 0.15), rng.uniform(0.3, 0.9))
    base = mat.color(graph, rng, 0.3, 2.0) if chance(rng, 0.5) else tex.color(rng, 0.02, 0.2)
    asphalt = mat.principled(graph, rng, {"Base Color": base, "Roughness": rough}, 8.0, 0.7)
    s.add(geo.rectangle(60, 60), asphalt)
    for side in (-1, 1):
        y = -9.0
        while y < 9:
            w, h, d = rng.uniform(2, 5), rng.uniform(3, 9), rng.uniform(2, 4)
            x = side * (rng.uniform(2.0, 3.5) + d / 2)
            s.add(geo.block(d, w, h), mat.paint(rng, 0.2, 1.2), (x, y + w / 2, 0))
            shows = chance(rng, 0.3)
            glow = mat.screen(rng, log_uniform(rng, 0.5, 8)) if shows else _glow(s, 0.2, 0.5, 8)
            dark = mat.coated(rng, 3)
            face = x - side * (d / 2 + 0.01)
            for z in np.arange(0.5, h - 1, rng.uniform(1.2, 2.2)):
                for k in np.arange(0.3, w - 0.8, rng.uniform(0.7, 1.5)):
                    a, b = y + k, y + k + 0.5
                    corners = [[face, a, z], [face, b, z], [face, b, z + 0.8], [face, a, z + 0.8]]
                    s.add(geo.quads(np.array([corners])), glow if chance(rng, 0.3) else dark)
            s.focus.append(np.array([face, y + w / 2, rng.uniform(0.5, 3)]))
            y += w + (rng.uniform(0.3, 2) if chance(rng, 0.4) else 0.02)
    for _ in range(rng.integers(1, 5)):
        p = np.array([rng.choice([-1.8, 1.8]), rng.uniform(-6, 6), 0])
        s.add(geo.cylinder(0.04, 3, 16), mat.metal(rng), p)
        s.emitter(geo.sphere(rng.uniform(0.03, 0.15), 16), log_uniform(rng, 5, 60), s.tint(0.15), p + (0, 0, 3.05))
        s.focus.append(p + (0, 0, rng.uniform(0.5, 2.5)))
    for _ in range(rng.integers(4, 12)):
        s.put(np.array([*rng.normal(size=2) * (1.2, 2.5), 0]), log_uniform(rng, 0.15, 1.5), 0.4, 0.1)
    if chance(rng, 0.35):
        s.haze(np.array([-30, -30, -1.0]), np.array([30, 30, 12.0]), log_uniform(rng, 0.005, 0.05))


def studio(s: Stage) -> None:
    """Build an easy scene: objects on a ground under softboxes or an open environment."""
    rng = s.rng
    x, t = np.meshgrid(np.linspace(-8, 8, 20), np.linspace(0, 1, 60), indexing="ij")
    profile_y, profile_z = (np.interp(t, [0, 0.6, 0.75, 1], ends) for ends in ([-6, 3, 4, 4.2], [0, 0, 0.8, 6]))
    s.add(geo.surface(np.stack([x, profile_y, profile_z], -1), np.stack([x, t * 12], -1)), mat.paint(rng, 0.6, 1))
    s.sky(log_uniform(rng, 0.05, 1), 0.3)
    for _ in range(rng.integers(1, 4)):
        a = rng.uniform(0, 6.3)
        at = np.array([math.cos(a) * 2.5, math.sin(a) * 2.5, rng.uniform(1.5, 3.5)])
        s.lamp("AREA", at, log_uniform(rng, 50, 400), s.tint(0.15), np.array([0, 0, 0.3]),
               shape="RECTANGLE", size=rng.uniform(0.3, 2), size_y=rng.uniform(0.3, 2))  # fmt: skip
    for _ in range(rng.integers(4, 14)):
        s.put(np.array([*rng.normal(size=2) * 0.6, 0]), rng.uniform(0.15, 0.7), 0.3, 0.12)
    if chance(rng, 0.5):
        s.furniture(np.array([*rng.normal(size=2), 0]), rng.uniform(0, 6.3))
        s.clutter(1, 4)


def abstract(s: Stage) -> None:
    """Build a swarm of floating copies of a few shapes, as in motion graphics."""
    rng = s.rng
    s.sky(log_uniform(rng, 0.02, 1), 0.5)
    meshes = [
        geo.block(1, 1, 1),
        geo.sphere(0.5, 24),
        geo.torus(0.4, 0.1),
        geo.knot(rng, 1),
        geo.cylinder(0.1, 1.5, 12),
    ]
    for _ in range(rng.integers(2, 5)):
        data = blender_mesh(meshes[rng.integers(len(meshes))].fitted(1.0))
        kind = rng.random()
        material = _glow(s, 0.5, 1, 50) if kind < 0.2 else mat.thing(rng, 0.2, 0.3, 0.2)
        spread, size = rng.uniform(0.3, 2, 3), log_uniform(rng, 0.04, 0.4)
        for i in range(int(rng.integers(20, 200))):
            p = rng.normal(size=3) * spread
            turn = Matrix(geo.random_rotation(rng).tolist()).to_4x4()
            turn = turn @ Matrix.Scale(size * rng.uniform(0.4, 1.3), 4)
            o = s.place(data, material, Matrix.Translation(Vector(p + (0, 0, 1.2))) @ turn)
            if i < 15:
                s.movers.append(o)
                s.focus.append(p + (0, 0, 1.2))
    for _ in range(rng.integers(1, 4)):
        at = rng.normal(size=3) * 2 + (0, 0, 3)
        kind_of_lamp = "AREA" if chance(rng, 0.5) else "POINT"
        s.lamp(kind_of_lamp, at, log_uniform(rng, 50, 500), s.tint(0.4), np.array([0, 0, 1.2]))
    if chance(rng, 0.6):
        s.add(geo.rectangle(30, 30), mat.paint(rng, 0.3, 1), (0, 0, -1.5 * rng.random()))


KINDS: dict[Callable[[Stage], None], float] = {
    daylight: 0.27, lamps: 0.20, many_lights: 0.09, glassware: 0.09, corridor: 0.08, outdoors: 0.10, street: 0.07,
    studio: 0.06, abstract: 0.04,
}  # fmt: skip


def build(seed: int) -> Stage:
    """Fill an empty Blender file with the scene of a seed."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng([seed, VERSION])
    stage = Stage(rng)
    kind = list(KINDS)[rng.choice(len(KINDS), p=np.array(list(KINDS.values())) / sum(KINDS.values()))]
    stage.kind = kind.__name__
    kind(stage)
    if stage.bounds is not None and chance(rng, 0.06):
        stage.haze(stage.bounds[0] + 0.01, stage.bounds[1] - 0.01, log_uniform(rng, 0.01, 0.15))
        stage.kind += "+haze"
    if stage.movers and chance(rng, 0.1):
        _set_moving(stage)
        stage.kind += "+motion"
    return stage


def _set_moving(stage: Stage) -> None:
    """Animate some objects, so that they move during the exposure of frame 1, which is rendered."""
    rng = stage.rng
    stage.scene.render.use_motion_blur = True
    stage.scene.render.motion_blur_shutter = rng.uniform(0.3, 1.0)
    for i in rng.permutation(len(stage.movers))[: rng.integers(1, 9)]:
        o = stage.movers[i]
        o.rotation_mode = "XYZ"
        way, spin = Vector(rng.normal(size=3) * log_uniform(rng, 0.01, 0.3)), rng.normal(size=3) * 0.3
        place, turn = o.location.copy(), np.array(o.rotation_euler)
        for frame, sign in ((0, -1), (2, 1)):
            o.location, o.rotation_euler = place + way * sign, list(turn + spin * sign)
            o.keyframe_insert("location", frame=frame)
            o.keyframe_insert("rotation_euler", frame=frame)
    stage.scene.frame_set(1)


def aim(stage: Stage, rng: Rng) -> dict[str, object]:
    """Aim the scene's camera at a random target. The caller checks that it shows something."""
    scene = stage.scene
    if scene.camera is None:
        scene.camera = stage.place(bpy.data.cameras.new("camera"))
    target = stage.focus[rng.integers(len(stage.focus))] + rng.normal(size=3) * 0.15
    if stage.bounds is not None:
        low, high = stage.bounds
        margin = np.array([0.15, 0.15, 0.15])
        origin = rng.uniform(low + margin, high - margin)
        origin[2] = rng.uniform(0.12, 0.75) * high[2]
        if chance(rng, 0.4):  # a close-up
            away = origin - target
            distance = float(np.linalg.norm(away))
            origin = np.clip(target + away / distance * min(rng.uniform(0.4, 1.5), distance), low + 0.1, high - 0.1)
        angle = rng.uniform(35, 85)
    else:
        a, distance = rng.uniform(0, 6.3), log_uniform(rng, 0.6, 4)
        origin = target + (distance * math.cos(a), distance * math.sin(a), 0)
        origin[2] = rng.uniform(0.1, 0.5 + distance * 0.6)
        angle = rng.uniform(25, 70)
    distance = float(np.linalg.norm(target - origin))
    turn = Vector(target - origin).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    scene.camera.matrix_world = Matrix.Translation(Vector(origin)) @ turn @ Matrix.Rotation(rng.normal() * 0.06, 4, "Z")
    lens = scene.camera.data
    lens.angle, lens.clip_start = math.radians(angle), 0.01
    lens.dof.use_dof = chance(rng, 0.25)
    aperture = distance * log_uniform(rng, 0.006, 0.05)  # metres, radius
    lens.dof.focus_distance = distance * rng.uniform(0.7, 1.3)
    lens.dof.aperture_fstop = lens.lens * 1e-3 / (2 * aperture)
    lens.dof.aperture_blades = int(rng.choice([0, 0, 5, 6, 8]))
    aperture = aperture if lens.dof.use_dof else 0.0
    focus = lens.dof.focus_distance
    return {
        "origin": origin.tolist(), "target": target.tolist(), "fov": angle, "aperture": aperture, "focus": focus
    }  # fmt: skip
