# SPDX-License-Identifier: GPL-3.0-or-later
# ruff: noqa: RUF005 -- adding a tuple to an array is a sum, not a concatenation
"""Building blocks of random scenes: objects, furniture, rooms, lamps, skies. Lengths are in metres; z is up."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

from research.datagen import meshes as geo
from research.datagen import textures as tex
from research.datagen.meshes import Mesh

from . import materials as mat
from .materials import Material, Rng, chance, log_uniform


def blender_mesh(mesh: Mesh) -> bpy.types.Mesh:
    data = bpy.data.meshes.new("mesh")
    count = len(mesh.f)
    data.vertices.add(len(mesh.v))
    data.vertices.foreach_set("co", np.ascontiguousarray(mesh.v, np.float32).ravel())
    data.loops.add(3 * count)
    data.loops.foreach_set("vertex_index", np.ascontiguousarray(mesh.f, np.int32).ravel())
    data.polygons.add(count)
    data.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    data.polygons.foreach_set("use_smooth", np.full(count, mesh.n is not None))
    uv = data.uv_layers.new(name="UV")
    uv.uv.foreach_set("vector", np.ascontiguousarray(mesh.uv[mesh.f.ravel()], np.float32).ravel())
    data.update(calc_edges=True)
    if mesh.n is not None:
        data.normals_split_custom_set_from_vertices(np.asarray(mesh.n, np.float32))
    return data


def from_bmesh(built: bmesh.types.BMesh, smooth: bool) -> bpy.types.Mesh:
    data = bpy.data.meshes.new("shape")
    uv = built.loops.layers.uv.new("UV")
    for face in built.faces:
        for loop in face.loops:
            loop[uv].uv = (loop.vert.co.x + 0.5 * loop.vert.co.z, loop.vert.co.y + 0.5 * loop.vert.co.z)
    built.to_mesh(data)
    built.free()
    if smooth:
        data.shade_smooth()
    return data


def strands(path: np.ndarray, radius: float) -> bpy.types.HairCurves:
    """Hair along (K, N, 3) points, thinning towards the tip."""
    count, steps, _ = path.shape
    data = bpy.data.hair_curves.new("hair")
    data.add_curves([steps] * count)
    data.position_data.foreach_set("vector", np.ascontiguousarray(path, np.float32).ravel())
    attribute = data.attributes.get("radius") or data.attributes.new("radius", "FLOAT", "POINT")
    attribute.data.foreach_set("value", np.tile(np.linspace(radius, 0.2 * radius, steps, dtype=np.float32), count))
    return data


class Stage:
    """A Blender scene under construction, and what a camera may look at."""

    def __init__(self, rng: Rng) -> None:
        self.rng, self.kind = rng, ""
        self.focus: list[np.ndarray] = []  # points worth looking at
        self.tops: list[tuple[np.ndarray, float, float]] = []  # surfaces to put things on: centre, half sizes
        self.bounds: tuple[np.ndarray, np.ndarray] | None = None  # of the room that cameras stay in
        self.openings: list[tuple[Matrix, float, float]] = []  # of its walls: the outer lower corner, width, height
        self.movers: list[bpy.types.Object] = []  # what may move where there is motion blur
        self.hazy = False
        self.caustics = chance(rng, 0.25)
        self.scene = bpy.context.scene

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner (3,) of the room."""
        assert self.bounds is not None
        return self.bounds

    # -- building blocks ---------------------------------------------------------------------------

    def place(
        self, data: Mesh | bpy.types.ID, material: Material | None = None, matrix: Matrix | None = None
    ) -> bpy.types.Object:
        """Add an object of a mesh, curve or light; several objects may share Blender's data."""
        data = blender_mesh(data) if isinstance(data, Mesh) else data
        o = bpy.data.objects.new(data.name, data)
        if material is not None and not data.materials:
            data.materials.append(material)
        if matrix is not None:
            o.matrix_world = matrix
        self.scene.collection.objects.link(o)
        return o

    def add(self, mesh: Mesh, material: Material, at: np.ndarray | tuple = (0, 0, 0)) -> bpy.types.Object:
        return self.place(mesh, material, Matrix.Translation(Vector(map(float, at))))

    def lamp(self, kind: str, at: np.ndarray, energy: float, color: np.ndarray, target: np.ndarray | None = None,
             **attributes: object) -> bpy.types.Object:  # fmt: skip
        """Add a light of Blender's: POINT, SPOT and AREA in watts, SUN in watts a square metre."""
        data = bpy.data.lights.new(kind.lower(), kind)
        data.energy, data.color = float(energy), [float(c) for c in color]
        for name, value in attributes.items():
            setattr(data, name, value)
        towards = Vector((0, 0, -1)) if target is None else Vector(map(float, np.asarray(target) - at))
        matrix = Matrix.Translation(Vector(map(float, at))) @ towards.to_track_quat("-Z", "Y").to_matrix().to_4x4()
        return self.place(data, matrix=matrix)

    def emitter(self, mesh: Mesh, power: float, color: np.ndarray, at: np.ndarray | tuple = (0, 0, 0)) -> None:
        """Add a glowing mesh; `power` spreads over its surface, so that small ones are bright."""
        corners = mesh.v[mesh.f]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        self.add(mesh, mat.lamp(color * power / max(float(area), 1e-6)), at)

    def tint(self, hue: float = 0.2) -> np.ndarray:
        """Draw the colour of a light: warm or cold white, or any hue with probability `hue`."""
        rng = self.rng
        if chance(rng, hue):
            return tex.color(rng, 0.6, 1.0)
        return np.array([1.0, rng.uniform(0.55, 1.0), rng.uniform(0.25, 1.15)])

    # -- surroundings ------------------------------------------------------------------------------

    def sky(self, strength: float = 1.0, sun: float = 0.75) -> None:
        """Add a world: Blender's sky, or a gradient with a sun lamp."""
        rng = self.rng
        world = bpy.data.worlds.new("world")
        self.scene.world = world
        world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 512
        graph = mat.Graph(world)
        if chance(rng, 0.5):
            node = graph.add(
                "ShaderNodeTexSky", sky_type="SINGLE_SCATTERING", sun_disc=chance(rng, sun),
                sun_elevation=rng.uniform(0.03, 1.2), sun_rotation=rng.uniform(0, 6.3),
                sun_size=math.radians(log_uniform(rng, 0.5, 4)),
            )  # fmt: skip
            color = node.outputs["Color"]
        else:
            direction = graph.add("ShaderNodeTexCoord").outputs["Generated"]
            up = graph.add("ShaderNodeSeparateXYZ", {0: direction}).outputs[2]
            zenith = tex.color(rng, 0.1, 0.8) * (0.6, 0.8, 1.3)
            color = graph.mix(graph.threshold(up, 0.3, 0.6), tex.color(rng, 0.4, 1), zenith)
            if chance(rng, sun):
                self._sun(strength * log_uniform(rng, 3, 30))
        graph.surface(graph.add("ShaderNodeBackground", {"Color": color, "Strength": strength}))

    def _sun(self, strength: float) -> None:
        rng = self.rng
        turn, high = rng.uniform(0, 6.3), rng.uniform(0.15, 1.3)
        at = np.array([math.cos(turn) * math.cos(high), math.sin(turn) * math.cos(high), math.sin(high)])
        warm = np.array([1, 0.6 + 0.35 * min(high, 1), 0.3 + 0.6 * min(high, 1)])
        self.lamp("SUN", 30 * at, strength, warm, np.zeros(3), angle=math.radians(log_uniform(rng, 0.3, 4)))

    def dim_world(self, strength: float) -> None:
        world = bpy.data.worlds.new("night")
        self.scene.world = world
        graph = mat.Graph(world)
        graph.surface(graph.add("ShaderNodeBackground", {"Color": np.array([0.4, 0.6, 1.0]), "Strength": strength}))

    def haze(self, low: np.ndarray, high: np.ndarray, density: float) -> None:
        self.hazy = True
        self.add(geo.box(low, high), mat.fog(self.rng, density))

    # -- things ------------------------------------------------------------------------------------

    def put(self, at: np.ndarray, size: float, shiny: float = 0.25, clear: float = 0.1) -> None:
        """One object of about `size` metres that stands at `at`."""
        rng = self.rng
        self.focus.append(np.asarray(at, float) + (0, 0, size * 0.4))
        makers: dict[Callable[[np.ndarray, float], None], float] = {
            self._fur: 0.06, self._wires: 0.07, self._cage: 0.06, self._plant: 0.12, self._heap: 0.06,
            self._letters: 0.05, self._chain: 0.04, self._candle: 0.04,
        }  # fmt: skip
        pick = rng.random()
        for make, share in makers.items():
            pick -= share
            if pick < 0:
                return make(np.asarray(at, float), size)
        return self._solid(np.asarray(at, float), size, shiny, clear)

    def _solid(self, at: np.ndarray, size: float, shiny: float, clear: float) -> None:
        rng = self.rng
        kind = int(rng.integers(10))
        material = mat.thing(rng, size, shiny, clear)
        if kind < 6:
            makers: list[Callable[[], Mesh]] = [
                lambda: geo.vase(rng, 1.0), lambda: geo.blob(rng, 0.5, rng.uniform(0.1, 0.5)), lambda: geo.sphere(0.5),
                lambda: geo.torus(0.4, rng.uniform(0.05, 0.2)).rotated(geo.random_rotation(rng)),
                lambda: geo.knot(rng, 1.0).rotated(geo.random_rotation(rng)),
                lambda: geo.cylinder(rng.uniform(0.1, 0.5), rng.uniform(0.2, 1)),
            ]  # fmt: skip
            mesh = makers[kind]().fitted(size).turned(rng.uniform(0, 6.3))
            self.movers.append(self.add(mesh, material, at))
            return
        box = bmesh.new()
        if kind == 6:
            bmesh.ops.create_icosphere(box, subdivisions=int(rng.integers(1, 3)), radius=0.5)
        elif kind == 7:
            bmesh.ops.create_cone(box, segments=int(rng.integers(3, 9)), radius1=0.5, radius2=rng.uniform(0, 0.5),
                                  depth=rng.uniform(0.3, 1.2), cap_ends=True)  # fmt: skip
        elif kind == 8:
            bmesh.ops.create_monkey(box)
        else:
            bmesh.ops.create_cube(box, size=1, matrix=Matrix.Diagonal((*rng.uniform(0.3, 1, 3), 1)))
        o = self.place(from_bmesh(box, kind == 8), material)
        if kind == 8:
            o.modifiers.new("smooth", "SUBSURF").render_levels = 2
        else:
            bevel = o.modifiers.new("bevel", "BEVEL")
            bevel.width, bevel.segments = rng.uniform(0.01, 0.08), 3
        corners = np.array([v.co for v in o.data.vertices])
        turn = geo.random_rotation(rng) if chance(rng, 0.3) else geo.rotation((0, 0, 1), rng.uniform(0, 6.3))
        corners = corners @ turn.T * size
        lift = np.array(at) - (0, 0, corners[:, 2].min())
        o.matrix_world = Matrix.Translation(Vector(lift)) @ Matrix(turn.tolist()).to_4x4() @ Matrix.Scale(size, 4)
        self.movers.append(o)

    def _fur(self, at: np.ndarray, size: float) -> None:
        """Add a ball with hair: curves, as Cycles has them."""
        rng = self.rng
        count, steps = int(rng.integers(1500, 8000)), 6
        out = geo.unit(rng.normal(size=(count, 3)))
        r = size * rng.uniform(0.2, 0.4)
        t = np.linspace(0, 1, steps)[None, :, None]
        length = size * rng.uniform(0.1, 0.35) * rng.uniform(0.5, 1.1, (count, 1, 1))
        curl = rng.normal(size=(count, 1, 3)) * rng.uniform(0.05, 0.5)
        path = out[:, None] * r + length * (t * out[:, None] + t**2 * (curl - (0, 0, 0.4))) + (0, 0, size / 2)
        hair = strands(path, size * rng.uniform(0.001, 0.005))
        self.place(hair, mat.hair(rng), Matrix.Translation(Vector(at)))
        self.add(geo.sphere(r).moved(0, 0, size / 2), mat.paint(rng, 0.8), at)

    def _wires(self, at: np.ndarray, size: float) -> None:
        """Add a tangle of thin cable."""
        rng = self.rng
        material = mat.thing(rng, size, 0.5, 0.0)
        radius = size * log_uniform(rng, 0.002, 0.015)
        parts = []
        for _ in range(rng.integers(3, 14)):
            t = np.linspace(0, 1, 60)[:, None]
            waves = [rng.normal(size=3) * np.sin(t * rng.uniform(1, 14) + rng.uniform(0, 6)) for _ in range(4)]
            path = np.sum(waves, axis=0) * 0.14
            path[:, 2] = np.abs(path[:, 2]) + radius / size
            parts.append(geo.tube(path * size, radius, 6))
        self.add(geo.merge(parts), material, at)

    def _cage(self, at: np.ndarray, size: float) -> None:
        """Add a wire frame around something."""
        rng = self.rng
        box = bmesh.new()
        if chance(rng, 0.5):
            bmesh.ops.create_icosphere(box, subdivisions=int(rng.integers(2, 4)), radius=0.5)
        else:
            segments = {"u_segments": int(rng.integers(8, 32)), "v_segments": int(rng.integers(5, 20))}
            bmesh.ops.create_uvsphere(box, radius=0.5, **segments)
        o = self.place(from_bmesh(box, False), mat.thing(rng, size, 0.6, 0.0))
        o.modifiers.new("wires", "WIREFRAME").thickness = log_uniform(rng, 0.006, 0.03)
        o.matrix_world = Matrix.Translation(Vector(at + (0, 0, size / 2))) @ Matrix.Scale(size, 4)
        self.movers.append(o)
        if chance(rng, 0.6):
            self._solid(at + (0, 0, size * 0.1), size * 0.5, 0.3, 0.2)

    def _plant(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        size *= rng.uniform(1, 2)
        pot = geo.lathe(np.array([[1e-3, 0], [0.13, 0], [0.18, 0.25], [0.16, 0.25], [0.15, 0.2], [1e-3, 0.2]]))
        self.add(pot.scaled(size), mat.thing(rng, size, 0.15, 0.0), at)
        soil = at + (0, 0, 0.2 * size)
        if chance(rng, 0.6):
            trunk, tips = geo.branching(rng, 0.9 * size, 0.02 * size, 2)
            self.add(trunk, mat.paint(rng, 0.5, 20 / size), soil)
            centres = np.repeat(tips, 6, 0) + rng.normal(size=(6 * len(tips), 3)) * 0.06 * size
            leaves = geo.leaves(rng, centres, size * rng.uniform(0.05, 0.18))
        else:
            roots = np.c_[rng.normal(size=(120, 2)) * 0.05 * size, np.zeros(120)]
            leaves = geo.blades(rng, roots, size * 0.8, size * rng.uniform(0.01, 0.06), rng.uniform(0.3, 1))
        self.add(leaves, mat.leaf(rng), soil)

    def _heap(self, at: np.ndarray, size: float) -> None:
        """Many copies of one small thing: beads, dice, pebbles."""
        rng = self.rng
        small = size * rng.uniform(0.08, 0.2)
        shapes = [geo.sphere(0.5, 20), geo.block(0.8, 0.8, 0.8), geo.blob(rng, 0.5, 0.3), geo.cylinder(0.4, 0.3, 16)]
        material = mat.thing(rng, small, 0.35, 0.25)
        data = blender_mesh(shapes[rng.integers(len(shapes))].fitted(small))
        for i in range(int(rng.integers(20, 90))):
            spread = rng.normal(size=2) * size * 0.3
            height = max(0.0, size * 0.3 - np.hypot(*spread) * 0.7) * rng.random()
            turn = Matrix(geo.random_rotation(rng).tolist()).to_4x4()
            lift = Matrix.Translation(Vector((*(at[:2] + spread), at[2] + height + small * 0.45)))
            o = self.place(data, material, lift @ turn)
            if i < 3:
                self.movers.append(o)

    def _letters(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        curve = bpy.data.curves.new("letters", "FONT")
        letters = list("ABCDEFGHKLMNOPRSTUXYZabdefghkmrstxz23456789&?!")
        curve.body = "".join(rng.choice(letters, int(rng.integers(1, 7))))
        curve.size, curve.extrude = size * rng.uniform(0.5, 1.2), size * rng.uniform(0.02, 0.15)
        curve.bevel_depth = size * 0.01
        turn = Matrix.Rotation(rng.uniform(0, 6.3), 4, "Z") @ Matrix.Rotation(math.pi / 2, 4, "X")
        self.place(curve, mat.thing(rng, size, 0.35, 0.05), Matrix.Translation(Vector(at)) @ turn)

    def _chain(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        link = size * rng.uniform(0.03, 0.08)
        data = blender_mesh(geo.torus(link * 0.5, link * 0.12, 20).scaled((1.3, 0.8, 1)))
        material = mat.metal(rng, 10 / size)
        t = np.linspace(0, rng.uniform(4, 12), int(size * 6 / link))
        path = np.stack([np.cos(t) * (1 + 0.3 * np.sin(2.3 * t)), np.sin(t * 1.3), 0 * t], 1) * size * 0.4
        for i in range(len(path) - 1):
            turn = Vector(path[i + 1] - path[i]).to_track_quat("X", "Z").to_matrix().to_4x4()
            flip = Matrix.Rotation(rng.uniform(-0.3, 0.3) + (i % 2) * 1.2, 4, "X")
            self.place(data, material, Matrix.Translation(Vector(at + path[i] + (0, 0, link * 0.4))) @ turn @ flip)

    def _candle(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        r, h = size * rng.uniform(0.1, 0.3), size * rng.uniform(0.3, 0.9)
        wax = geo.lathe(np.array([[1e-4, 0], [r, 0], [r, h], [r * 0.8, h * 0.96], [1e-4, h * 0.94]]))
        self.add(wax, mat.waxen(rng, r), at)
        if chance(rng, 0.6):
            flame = geo.sphere(1, 12).scaled((0.06 * size, 0.06 * size, 0.14 * size)).moved(0, 0, h + 0.1 * size)
            self.emitter(flame, log_uniform(rng, 0.05, 1.0), np.array([1, 0.5, 0.15]), at)

    def furniture(self, at: np.ndarray, angle: float) -> None:
        """Something that stands on a floor."""
        rng, kind = self.rng, self.rng.random()
        self.focus.append(at + (0, 0, rng.uniform(0.3, 0.9)))
        spin = Matrix.Translation(Vector(at)) @ Matrix.Rotation(angle, 4, "Z")
        if kind < 0.55:
            w, d, h = rng.uniform(0.5, 1.8), rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.9)
            table = geo.table(w, d, h, rng.uniform(0.015, 0.08))
            self.place(table, mat.paint(rng, 0.25, 2) if chance(rng, 0.8) else mat.glass(rng), spin)
            self.tops.append((at + (0, 0, h), w * 0.35, d * 0.35))
        elif kind < 0.72:
            w, h, boards = rng.uniform(0.6, 1.5), rng.uniform(0.8, 2.1), int(rng.integers(2, 7))
            self.place(geo.shelf(w, 0.3, h, boards), mat.paint(rng, 0.4, 2), spin)
            rows = [geo.books(rng, w * 0.9, 0.2, h / boards).moved(0, 0, i * h / boards + 0.02) for i in range(boards)]
            self.place(geo.merge(rows), mat.palette(rng), spin)
        elif kind < 0.86:
            self._seat(spin)
        else:
            w, d, h = rng.uniform(0.4, 1.3), rng.uniform(0.35, 0.6), rng.uniform(0.4, 1.9)
            self.place(geo.block(w, d, h), mat.paint(rng, 0.3, 2), spin)
            for i in range(int(rng.integers(1, 5))):
                z = h * (i + 0.5) / 5
                drawer = geo.box((-w * 0.45, -d / 2 - 0.01, z - h * 0.08), (w * 0.45, -d / 2, z + h * 0.08))
                self.place(drawer, mat.paint(rng, 0.6, 3), spin)
                handle = np.array([[-0.06, -d / 2 - 0.04, z], [0, -d / 2 - 0.045, z], [0.06, -d / 2 - 0.04, z]])
                self.place(geo.tube(handle, 0.006), mat.metal(rng), spin)
            self.tops.append((at + (0, 0, h), w * 0.35, d * 0.35))

    def _seat(self, spin: Matrix) -> None:
        """Add a sofa or chair of soft blocks on thin legs."""
        rng = self.rng
        w, material = rng.uniform(0.5, 2.0), mat.cloth(rng, 6)
        blocks = [((0, 0, 0.4), (w, 0.7, 0.25)), ((0, 0.3, 0.65), (w, 0.2, 0.6)), ((-w / 2, 0, 0.5), (0.15, 0.7, 0.4)),
                  ((w / 2, 0, 0.5), (0.15, 0.7, 0.4))]  # fmt: skip
        for centre, extent in blocks:
            cube = bmesh.new()
            bmesh.ops.create_cube(cube, size=1, matrix=Matrix.Translation(centre) @ Matrix.Diagonal((*extent, 1)))
            o = self.place(from_bmesh(cube, True), material, spin)
            bevel = o.modifiers.new("soft", "BEVEL")
            bevel.width, bevel.segments = min(extent) * 0.3, 4
        feet = itertools.product((-w * 0.45, w * 0.45), (-0.3, 0.3))
        legs = [geo.tube(np.array([[x, y, 0], [x, y, 0.15], [x, y, 0.3]]), 0.012) for x, y in feet]
        self.place(geo.merge(legs), mat.metal(rng), spin)
        for _ in range(int(rng.integers(0, 4))):
            pillow = geo.blob(rng, 0.22, 0.15).scaled((1, 0.45, 1)).moved(rng.uniform(-w / 3, w / 3), 0.1, 0.7)
            self.place(pillow, mat.cloth(rng, 12), spin)

    def clutter(self, low: int, high: int, shiny: float = 0.25, clear: float = 0.12) -> None:
        """Small things on every surface so far."""
        rng = self.rng
        for top, a, b in self.tops:
            for _ in range(rng.integers(low, high)):
                self.put(top + (rng.uniform(-a, a), rng.uniform(-b, b), 0), rng.uniform(0.06, 0.3), shiny, clear)

    # -- rooms -------------------------------------------------------------------------------------

    def room(self, size: tuple[float, float, float], openings: int, light_paint: float = 0.65) -> None:
        """Add a closed box of walls around the origin; `openings` are cut out at random."""
        rng, t = self.rng, 0.2
        w, d, h = size
        self.bounds = np.array([-w / 2, -d / 2, 0]), np.array([w / 2, d / 2, h])
        light = chance(rng, light_paint)
        shared = mat.paint(rng, 0.35, 1.5, light)
        frame = mat.thing(rng, 0.5, 0.3, 0.0)
        holes: list[list[tuple[float, float, float, float]]] = [[] for _ in range(4)]
        for _ in range(openings):
            side = int(rng.integers(4))
            length = (w, d)[side % 2]
            if chance(rng, 0.2):  # a gap: a door left ajar, a slit under the ceiling
                a, z0 = rng.uniform(0.05, 0.4), 0.01
                x0, z1 = rng.uniform(0.2, length - 0.7), 2.0
            else:
                a, b = rng.uniform(0.4, min(2.2, length - 1)), rng.uniform(0.4, 1.8)
                x0, z0 = rng.uniform(0.2, length - a - 0.2), rng.uniform(0.3, max(h - b - 0.1, 0.35))
                z1 = min(z0 + b, h - 0.05)
            holes[side].append((x0, z0, x0 + a, z1))
        for side in range(4):
            length = (w, d)[side % 2]
            corner = Matrix.Translation((-length / 2, -(d, w)[side % 2] / 2 - t, 0))
            spin = Matrix.Rotation(side * math.pi / 2, 4, "Z") @ corner
            material = shared if chance(rng, 0.6) else mat.paint(rng, 0.3, 1.5, light)
            self.place(geo.wall(length, h, t, holes[side]), material, spin)
            for x0, z0, x1, z1 in holes[side]:
                self.openings.append((spin @ Matrix.Translation((x0, 0, z0)), x1 - x0, z1 - z0))
                self._dress(spin @ Matrix.Translation((x0, t / 2, z0)), x1 - x0, z1 - z0, frame)
        floor = geo.box((-w / 2 - t, -d / 2 - t, -0.2), (w / 2 + t, d / 2 + t, 0))
        self.add(floor, mat.paint(rng, 0.1, 1.2))
        ceiling = geo.box((-w / 2 - t, -d / 2 - t, h), (w / 2 + t, d / 2 + t, h + 0.2))
        self.add(ceiling, mat.paint(rng, 0.8, 1.0, True))
        if chance(rng, 0.3):  # beams
            material = mat.paint(rng, 0.2, 2)
            for x in np.arange(-w / 2 + 0.4, w / 2, rng.uniform(0.6, 1.2)):
                self.add(geo.box((x, -d / 2, h - 0.18), (x + 0.12, d / 2, h)), material)
        if chance(rng, 0.4):  # skirting
            material = mat.paint(rng, 0.9, 2, True)
            self.add(geo.box((-w / 2, d / 2 - 0.02, 0), (w / 2, d / 2, 0.12)), material)
            self.add(geo.box((-w / 2, -d / 2, 0), (-w / 2 + 0.02, d / 2, 0.12)), material)

    def _dress(self, spin: Matrix, w: float, h: float, material: Material) -> None:
        """Hang something in a window: blinds, bars, a pane, a curtain."""
        rng, kind = self.rng, self.rng.random()
        if kind < 0.25:
            tilt = geo.rotation((1, 0, 0), rng.uniform(-1.2, 1.2))
            slat = geo.box((0, -0.022, -0.001), (w, 0.022, 0.001)).rotated(tilt)
            slats = geo.merge([slat.moved(0, 0, z) for z in np.arange(0.02, h, 0.045)])
            self.place(slats, material, spin)
        elif kind < 0.5:
            self.place(geo.bars(w, h, int(rng.integers(1, 6)), 0.025, False), material, spin)
        elif kind < 0.65:
            along = np.linspace(-0.1, w * rng.uniform(0.5, 1.1), 80)
            x, z = np.meshgrid(along, np.linspace(-0.1, h + 0.1, 12), indexing="ij")
            y = 0.14 + 0.035 * np.sin(x * rng.uniform(20, 60) + 0.4 * np.sin(z * 3))
            self.place(geo.surface(np.stack([x, y, z], -1), np.stack([x, z], -1)), mat.shade(rng), spin)
        if chance(rng, 0.35):
            glass = geo.quads(np.array([[[0, 0, 0], [w, 0, 0], [w, 0, h], [0, 0, h]]], float))
            self.place(glass, mat.pane(rng), spin)

    def portals(self) -> None:
        """Tell Cycles where the sky is seen from inside, as users do."""
        for corner, w, h in self.openings:
            data = bpy.data.lights.new("portal", "AREA")
            data.shape, data.size, data.size_y = "RECTANGLE", w, h
            data.cycles.is_portal = True
            # Area lights face -z; the room lies in the wall's +y.
            turn = Matrix.Rotation(math.pi / 2, 4, "X")
            self.place(data, None, corner @ Matrix.Translation((w / 2, -0.05, h / 2)) @ turn)

    def spot(self, low: float = 0.0, high: float = 0.0, margin: float = 0.12) -> np.ndarray:
        """Draw a point in the room, its height between two shares of the room's."""
        a, b = self.corners
        p = self.rng.uniform(a + (b - a) * margin, b - (b - a) * margin)
        p[2] = b[2] * self.rng.uniform(low, high)
        return p

    def furnish(self, pieces: int) -> None:
        rng = self.rng
        a, b = self.corners
        taken: list[np.ndarray] = []
        for _ in range(pieces * 5):
            if len(taken) == pieces:
                break
            p, angle = self.spot(), rng.uniform(0, 6.3)
            if chance(rng, 0.6):  # against a wall
                axis, end = int(rng.integers(2)), int(rng.integers(2))
                p[axis] = (a[axis] + 0.4, b[axis] - 0.4)[end]
                angle = {(0, 0): math.pi / 2, (0, 1): -math.pi / 2, (1, 0): math.pi, (1, 1): 0.0}[axis, end]
            if all(np.hypot(*(p - q)[:2]) > 0.9 for q in taken):
                taken.append(p)
                self.furniture(p, angle)
        for _ in range(rng.integers(1, 6)):
            self.put(self.spot(), rng.uniform(0.15, 0.8))
        for _ in range(rng.integers(0, 5)):
            self.hang_picture()
        if chance(rng, 0.3):
            self._rug()
        if chance(rng, 0.25):
            rail = geo.bars(rng.uniform(1, 2.5), rng.uniform(0.6, 1.2), int(rng.integers(8, 50)),
                            log_uniform(rng, 0.005, 0.02), chance(rng, 0.3))  # fmt: skip
            self.add(rail.turned(rng.uniform(0, 6.3)), mat.thing(rng, 0.3, 0.6, 0.0), self.spot())
        if chance(rng, 0.2):
            column = geo.cylinder(rng.uniform(0.08, 0.25), b[2], 40)
            self.add(column, mat.paint(rng, 0.3, 2), self.spot())

    def _rug(self) -> None:
        """Add a rug with a pile of hair."""
        rng = self.rng
        w, d = rng.uniform(0.8, 2.2, 2)
        at, count = self.spot() + (0, 0, 0.004), 9000
        self.add(geo.box((-w / 2, -d / 2, 0), (w / 2, d / 2, 0.006)), mat.cloth(rng, 5), at)
        if chance(rng, 0.6):
            roots = np.c_[rng.uniform(-w / 2, w / 2, count), rng.uniform(-d / 2, d / 2, count), np.zeros(count)]
            t = np.linspace(0, 1, 4)[None, :, None]
            path = roots[:, None] + 0.035 * (t * (0, 0, 1) + t**2 * rng.normal(size=(count, 1, 3)) * (0.5, 0.5, 0))
            self.place(strands(path, 0.0015), mat.hair(rng), Matrix.Translation(Vector(at)))

    def hang_picture(self) -> None:
        rng = self.rng
        low, high = self.corners
        a, b = rng.uniform(0.25, 1.1, 2)
        side = int(rng.integers(4))
        length, depth = ((high - low)[0], (high - low)[1]) if side % 2 == 0 else ((high - low)[1], (high - low)[0])
        at = Matrix.Translation((rng.uniform(-0.38, 0.38) * length, -depth / 2, rng.uniform(0.9, high[2] - 0.6)))
        spin = Matrix.Rotation(side * math.pi / 2, 4, "Z") @ at
        self.place(geo.box((-a / 2 - 0.03, 0, -b / 2 - 0.03), (a / 2 + 0.03, 0.025, b / 2 + 0.03)),
                   mat.thing(rng, 0.3, 0.4, 0.0), spin)  # fmt: skip
        face = geo.quads(np.array([[[-a, 0.028, -b], [-a, 0.028, b], [a, 0.028, b], [a, 0.028, -b]]]) / (2, 1, 2),
                         np.array([[[0, 0], [0, 1], [1, 1], [1, 0]]], float))  # fmt: skip
        kind = rng.random()
        if kind < 0.15:
            material = mat.metal(rng)
        elif kind < 0.22:
            material = mat.screen(rng, log_uniform(rng, 0.3, 5))
        else:
            material = mat.picture(tex.pattern(rng, 0.0), rng)
        self.place(face, material, spin)
        self.focus.append(np.array(spin.translation))

    # -- lamps of rooms ----------------------------------------------------------------------------

    def bulb(self) -> None:
        """Add a tiny bright ball, seen or unseen."""
        rng, at = self.rng, self.spot(0.3, 0.95)
        if chance(rng, 0.4):
            power = log_uniform(rng, 20, 120)
            self.lamp("POINT", at, power, self.tint(), shadow_soft_size=log_uniform(rng, 0.002, 0.06))
        else:
            self.emitter(geo.sphere(log_uniform(rng, 0.008, 0.06), 16), log_uniform(rng, 5, 40), self.tint(), at)

    def shaded(self) -> None:
        """Add a bulb in a shade, on a stand or hanging: opaque, of cloth or of glass."""
        rng, hanging = self.rng, chance(self.rng, 0.5)
        at = self.spot(0.55, 0.85) if hanging else self.spot(0.35, 0.55)
        r, h = rng.uniform(0.08, 0.28), rng.uniform(0.12, 0.4)
        z = np.linspace(0, h, 6)
        body = geo.lathe(np.stack([r * (1 - rng.uniform(0, 0.7) * z / h), z], 1))
        kind = rng.random()
        self.add(body, mat.shade(rng) if kind < 0.5 else mat.metal(rng) if kind < 0.65 else mat.paint(rng, 0.7, 5), at)
        ball = geo.sphere(log_uniform(rng, 0.012, 0.05), 16)
        self.emitter(ball, log_uniform(rng, 8, 40), self.tint(0.1), at + (0, 0, h * 0.5))
        low, high = (at[2] + h, self.corners[1][2]) if hanging else (0.0, at[2] + h * 0.3)
        self.add(geo.cylinder(0.006, high - low, 12), mat.metal(rng), (at[0], at[1], low))
        self.focus.append(at)

    def cove(self) -> None:
        """Add an area light a hand's breadth from the ceiling or a wall, facing it."""
        rng = self.rng
        _, b = self.corners
        at, size = self.spot(0.8, 0.9), rng.uniform(0.15, 1.5)
        target = at + (0, 0, 1)
        if chance(rng, 0.5):
            at[2], target = b[2] - rng.uniform(0.05, 0.3), np.array([at[0], at[1], b[2] + 1])
        else:
            at[1], at[2] = b[1] - rng.uniform(0.05, 0.3), b[2] * rng.uniform(0.3, 0.9)
            target = at + (0, 1, 0)
        self.lamp("AREA", at, log_uniform(rng, 20, 150), self.tint(), target,
                  shape="RECTANGLE", size=size, size_y=rng.uniform(0.03, 0.3))  # fmt: skip
        back = geo.box((-size / 2, -0.16, -0.02), (size / 2, 0.16, -0.005))
        turn = Vector(target - at).to_track_quat("Z", "Y").to_matrix().to_4x4()
        self.place(back, mat.paint(rng, 0.8), Matrix.Translation(Vector(at)) @ turn)

    def behind(self) -> None:
        """Add a light behind a partition."""
        rng = self.rng
        at, angle = self.spot(), rng.choice([0, math.pi / 2])
        screen = geo.box((-0.9, -0.03, 0), (0.9, 0.03, rng.uniform(0.5, 0.95) * self.corners[1][2])).turned(angle)
        self.add(screen, mat.paint(rng, 0.4, 2), at)
        offset = geo.rotation((0, 0, 1), angle) @ np.array([rng.uniform(-0.6, 0.6), 0.3, rng.uniform(0.2, 1.8)])
        power = log_uniform(rng, 30, 150)
        self.lamp("POINT", at + offset, power, self.tint(), shadow_soft_size=log_uniform(rng, 0.01, 0.1))

    def beam(self) -> None:
        rng = self.rng
        self.lamp("SPOT", self.spot(0.7, 0.95), log_uniform(rng, 50, 400), self.tint(), self.spot(0, 0.4),
                  spot_size=math.radians(rng.uniform(12, 70)), spot_blend=rng.random(),
                  shadow_soft_size=log_uniform(rng, 0.005, 0.1))  # fmt: skip

    def tube(self) -> None:
        """Add a neon tube, bent."""
        rng = self.rng
        start = self.spot(0.4, 0.9)
        t = np.linspace(0, 1, 40)[:, None]
        path = rng.normal(size=3) * 0.5 * t + rng.normal(size=3) * 0.25 * np.sin(t * rng.uniform(2, 9))
        self.emitter(geo.tube(path, log_uniform(rng, 0.006, 0.02), 8), log_uniform(rng, 5, 30), self.tint(0.7), start)
        self.focus.append(start)

    def panel(self) -> None:
        rng, at = self.rng, self.spot(0.97, 0.98)
        self.lamp("AREA", at, log_uniform(rng, 40, 150), self.tint(0.1),
                  shape=str(rng.choice(["SQUARE", "DISK"])), size=rng.uniform(0.3, 1.4))  # fmt: skip

    def string(self, count: int) -> None:
        """Many small coloured lights along a wire or scattered."""
        rng = self.rng
        scattered = chance(rng, 0.5)
        a, b = self.spot(0.5, 0.9), self.spot(0.5, 0.9)
        data = blender_mesh(geo.sphere(log_uniform(rng, 0.006, 0.035), 10))
        lamps = [mat.lamp(self.tint(0.7) * log_uniform(rng, 30, 3000)) for _ in range(5)]
        meshes = []
        for material in lamps:
            copy = data.copy()
            copy.materials.append(material)
            meshes.append(copy)
        path = []
        for i in range(count):
            t = i / max(count - 1, 1)
            p = self.spot(0.03, 0.9) if scattered else a + t * (b - a) - (0, 0, 1.4 * t * (1 - t))
            path.append(p)
            self.place(meshes[i % 5], None, Matrix.Translation(Vector(p)))
        if not scattered:
            self.add(geo.tube(np.array(path) + (0, 0, 0.02), 0.004, 5), mat.paint(rng, 1.0))
        self.focus.append(path[count // 2])
