# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: RUF005 -- adding a tuple to an array is a sum, not a concatenation
"""Random scenes. A seed and the asset files determine a scene.

Most scenes are hard for a path tracer: rooms lit through small openings, lamps in shades or facing walls, many lights
where each sample picks one, glass between light and floor, thin geometry. About one scene in four is easy (large
lights, open sky), so that a network also learns to keep a good image.
"""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from research.datagen import meshes as geo
from research.datagen import textures as tex
from research.datagen.meshes import Mesh

from . import materials as mat
from .assets import Assets, read_gltf, read_image, read_obj
from .trace import Camera

VERSION = 4  # of the generator: raise it when a seed would give another scene
Rng = np.random.Generator

_WINDOW = (0.35, 1.2)  # metres, a side


class Scene:
    """A scene under construction: meshes, lights, and what a camera may look at."""

    def __init__(self, rng: Rng, assets: Assets) -> None:
        self.rng, self.assets = rng, assets
        self.kind = ""
        self.sources: set[str] = set()
        self.focus: list[np.ndarray] = []  # points worth looking at
        self.surfaces: list[tuple[np.ndarray, float, float]] = []  # tops to put things on: centre, half sizes
        self.room: np.ndarray | None = None  # (3,) inner size, the floor centred on the origin
        self.parts: dict[str, object] = {}  # what Mitsuba gets

    @property
    def size(self) -> np.ndarray:
        """Inner size (3,) of the room."""
        assert self.room is not None
        return self.room

    # -- building blocks ---------------------------------------------------------------------------

    def add(self, mesh: Mesh, bsdf: mat.Bsdf, radiance: np.ndarray | None = None, weight: float = 1.0) -> None:
        """Add a mesh; with a `radiance` (3,) it is a light, drawn in proportion to `weight`."""
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(bsdf)
        if radiance is not None:
            rgb = [float(c) for c in radiance]
            light = {"type": "area", "radiance": {"type": "rgb", "value": rgb}, "sampling_weight": weight}
            props["emitter"] = mi.load_dict(light)
        name = f"mesh{len(self.parts)}"
        n = mesh.n
        shape = mi.Mesh(
            name, vertex_count=len(mesh.v), face_count=len(mesh.f),
            has_vertex_normals=n is not None, has_vertex_texcoords=True, props=props,
        )  # fmt: skip
        params = mi.traverse(shape)
        params["vertex_positions"] = np.ascontiguousarray(mesh.v, np.float32).ravel()
        params["faces"] = np.ascontiguousarray(mesh.f, np.uint32).ravel()
        params["vertex_texcoords"] = np.ascontiguousarray(mesh.uv, np.float32).ravel()
        if n is not None:
            params["vertex_normals"] = np.ascontiguousarray(n, np.float32).ravel()
        params.update()
        self.parts[name] = shape

    def light(self, mesh: Mesh, radiance: np.ndarray, weight: float = 1.0) -> None:
        self.add(mesh, mat.diffuse(np.full((2, 2, 3), 0.2)), radiance, weight)

    def environment(self, scale: float, prefer_hdri: float = 0.6) -> None:
        """Add an HDRI or a procedural sky, turned at random."""
        rng = self.rng
        if self.assets.hdris and rng.random() < prefer_hdri:
            image, name = self.assets.hdri(rng)
            self.sources.add(f"hdri/{name} (CC0, Poly Haven)")
        else:
            image = tex.sky(rng)
        to_world = mi.ScalarTransform4f().rotate([0, 0, 1], float(rng.uniform(0, 360))).rotate([1, 0, 0], 90)
        self.parts["environment"] = mi.load_dict({
            "type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image, np.float32)), "scale": scale,
            "to_world": to_world,
        })  # fmt: skip

    def finish(self) -> mi.Scene:
        """Return the scene as Mitsuba has it."""
        return mi.load_dict({"type": "scene", **self.parts})

    # -- things ------------------------------------------------------------------------------------

    def tinted_light(self, power: float, tint: float = 0.3) -> np.ndarray:
        """Draw a radiance: warm or cold white, or with `tint` towards 1 any hue."""
        rng = self.rng
        warm = np.array([1.0, rng.uniform(0.5, 1.0), rng.uniform(0.2, 1.2)])
        hue = tex.color(rng, 0.5, 1.0)
        return power * (hue if rng.random() < tint else warm)

    def shape(self, size: float) -> Mesh:
        """Return a single procedural object of the given largest extent, standing on z = 0."""
        rng = self.rng
        makers: list[Callable[[], Mesh]] = [
            lambda: geo.block(*rng.uniform(0.3, 1, 3)),
            lambda: geo.sphere(0.5),
            lambda: geo.cylinder(rng.uniform(0.1, 0.5), rng.uniform(0.3, 1)),
            lambda: geo.torus(0.4, rng.uniform(0.05, 0.2)).rotated(geo.random_rotation(rng)),
            lambda: geo.vase(rng, 1.0),
            lambda: geo.vase(rng, 1.0),
            lambda: geo.blob(rng, 0.5, rng.uniform(0.1, 0.5)),
            lambda: geo.knot(rng, 1.0).rotated(geo.random_rotation(rng)),
            lambda: geo.block(1, 1, 1).rotated(geo.random_rotation(rng)),
        ]
        mesh = makers[rng.integers(len(makers))]().fitted(size).tiled(1 / size)
        return mesh.turned(rng.uniform(0, 6.3)).tiled(rng.uniform(0.3, 2))

    def put(self, at: np.ndarray, size: float, shiny: float = 0.25, clear: float = 0.08) -> None:
        """One object: procedural, a heap, a hair ball, a plant, or a model file."""
        rng, kind = self.rng, self.rng.random()
        self.focus.append(at + (0, 0, size * 0.4))
        if kind < 0.08:
            self.add(geo.rubble(rng, 25, size * 0.3, size * 0.35).moved(*at), mat.thing(rng, tex.palette(rng)))
        elif kind < 0.14:
            self._fur(at, size)
        elif kind < 0.24:
            self._plant(at, size * rng.uniform(1, 2))
        elif kind < 0.42 and self.assets.models:
            self._model(at, size)
        else:
            self.add(self.shape(size).moved(*at), mat.thing(rng, None, shiny, clear))

    def _fur(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        out = geo.unit(rng.normal(size=(int(rng.integers(1500, 6000)), 3)))
        r = size * rng.uniform(0.25, 0.4)
        centre = at + (0, 0, size / 2)
        hair = geo.strands(rng, centre + out * r, out, size * rng.uniform(0.1, 0.35), size * rng.uniform(0.004, 0.015))
        colors = tex.foliage(rng)
        self.add(hair, mat.glossy(colors, 0.3) if rng.random() < 0.6 else mat.diffuse(colors))
        self.add(geo.sphere(r).moved(*centre), mat.diffuse(colors[-1:].repeat(2, 0)))

    def _plant(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        pot = geo.lathe(np.array([[1e-3, 0], [0.13, 0], [0.18, 0.25], [0.16, 0.25], [0.15, 0.2], [1e-3, 0.2]]))
        self.add(pot.scaled(size).moved(*at), mat.thing(rng, tex.pattern(rng, 0.6)))
        soil = at + (0, 0, 0.2 * size)
        if rng.random() < 0.5:
            trunk, tips = geo.branching(rng, 0.9 * size, 0.02 * size, 2)
            self.add(trunk.moved(*soil), mat.diffuse(tex.wood(rng)))
            centres = soil + np.repeat(tips, 5, 0) + rng.normal(size=(5 * len(tips), 3)) * 0.05 * size
            leaf = geo.leaves(rng, centres, size * rng.uniform(0.05, 0.15))
        else:
            roots = np.c_[rng.normal(size=(150, 2)) * 0.05 * size, np.zeros(150)] + soil
            leaf = geo.blades(rng, roots, size * 0.8, size * rng.uniform(0.01, 0.05), rng.uniform(0.3, 1))
        self.add(leaf, mat.glossy(tex.foliage(rng), 0.3) if rng.random() < 0.5 else mat.diffuse(tex.foliage(rng)))

    def _model(self, at: np.ndarray, size: float) -> None:
        rng = self.rng
        path = self.assets.models[rng.integers(len(self.assets.models))]
        if "Spheres" in path.name and rng.random() < 0.8:  # a test chart: recognisable, so rarely
            path = self.assets.models[rng.integers(len(self.assets.models))]
        self.sources.add(f"models/{path.stem} (CC0 or CC-BY 4.0, Khronos glTF sample models)")
        parts = read_gltf(str(path))
        low = np.min([m.low for m, _ in parts], 0)
        high = np.max([m.high for m, _ in parts], 0)
        s, angle = size * 1.5 / max((high - low).max(), 1e-6), rng.uniform(0, 6.3)
        shift = -np.array([*(low + high)[:2] / 2, low[2]])
        for mesh, image in parts:
            plain = np.ptp(image) < 1e-3
            bsdf = mat.thing(rng) if plain and rng.random() < 0.5 else mat.thing(rng, image)
            self.add(mesh.moved(*shift).scaled(s).turned(angle).moved(*at), bsdf)

    def furniture(self, at: np.ndarray, angle: float) -> None:
        """Something that stands on a floor: a file if there are any, or a table, shelf or cupboard."""
        rng = self.rng
        kind = rng.random()
        if self.assets.furniture and kind < 0.5:
            path = self.assets.furniture[rng.integers(len(self.assets.furniture))]
            self.sources.add(f"models/KayKit-Furniture-Bits/{path.name} (CC0)")
            mesh = read_obj(str(path)).scaled(0.75)
            mesh = mesh.moved(0, 0, -mesh.low[2]).turned(angle).moved(*at)
            image = path.parent / "furniturebits_texture.png"
            if image.exists() and rng.random() < 0.5:
                picture = read_image(str(image), 1024)[::-1]
                # Other hues than the one palette all the files share.
                picture = np.clip(picture ** rng.uniform(0.8, 2.5) * rng.uniform(0.4, 1.1, 3), 0.003, 0.9)
                self.add(mesh, mat.thing(rng, picture))
            else:
                # The file's coordinates point into a palette; other images are projected.
                mesh.uv = np.stack([mesh.v[:, 0] + mesh.v[:, 2], mesh.v[:, 1] + mesh.v[:, 2]], 1)
                self.add(mesh, mat.thing(rng, None, 0.1, 0.0))
            if "table" in path.name:
                self.surfaces.append((np.array([at[0], at[1], mesh.high[2]]), 0.3, 0.3))
            self.focus.append((mesh.low + mesh.high) / 2)
            return
        if kind < 0.72:
            w, d, h = rng.uniform(0.5, 1.6), rng.uniform(0.5, 0.9), rng.uniform(0.35, 0.9)
            mesh = geo.table(w, d, h, rng.uniform(0.02, 0.08))
            self.surfaces.append((at + (0, 0, h), w * 0.35, d * 0.35))
            self.add(mesh.tiled(rng.uniform(0.4, 2)).turned(angle).moved(*at), mat.structure(rng))
        elif kind < 0.9:
            w, d, h, boards = rng.uniform(0.6, 1.4), 0.3, rng.uniform(0.8, 2.0), int(rng.integers(2, 7))
            self.add(geo.shelf(w, d, h, boards).turned(angle).moved(*at), mat.structure(rng))
            rows = [geo.books(rng, w * 0.9, d * 0.7, h / boards).moved(0, 0, i * h / boards + 0.02)
                    for i in range(boards)]  # fmt: skip
            self.add(geo.merge(rows).turned(angle).moved(*at), mat.thing(rng, tex.palette(rng)))
        else:
            w, d, h = rng.uniform(0.4, 1.2), rng.uniform(0.35, 0.6), rng.uniform(0.4, 1.8)
            self.add(geo.block(w, d, h).tiled(rng.uniform(0.5, 2)).turned(angle).moved(*at), mat.structure(rng))
            self.surfaces.append((at + (0, 0, h), w * 0.35, d * 0.35))
        self.focus.append(at + (0, 0, 0.6))

    def clutter(self, count: tuple[int, int], shiny: float = 0.25, clear: float = 0.12) -> None:
        """Small things on every surface so far."""
        rng = self.rng
        for top, a, b in self.surfaces:
            for _ in range(rng.integers(*count)):
                at = top + (rng.uniform(-a, a), rng.uniform(-b, b), 0)
                self.put(at, rng.uniform(0.06, 0.3), shiny, clear)

    # -- rooms -------------------------------------------------------------------------------------

    def shell(self, openings: int, size: tuple[float, float] = (3, 7), daylight: float = 0.0, gap: float = 0.0) -> None:
        """Floor, four walls, ceiling; `openings` windows, door gaps or skylights cut out of them.

        With `daylight` a panel of that radiance hangs outside each opening: an artist's trick. With a `gap`, in metres,
        a door stands that far ajar, and behind it is a small lit hall.
        """
        rng, t = self.rng, 0.15
        w, d = rng.uniform(*size, 2)
        h = rng.uniform(2.3, 3.6)
        self.room = np.array([w, d, h])
        lengths, heights = [w, w, d + 2 * t, d + 2 * t, w], [h, h, h, h, d]
        holes: list[list[tuple[float, float, float, float]]] = [[] for _ in range(5)]
        for _ in range(openings):
            side = int(rng.choice(5, p=[0.23, 0.23, 0.23, 0.23, 0.08]))
            holes[side].append(self._hole(side, lengths[side], heights[side]))
        if gap:
            door = rng.uniform(0.4, w - 1.4)
            holes[0].append((door, 0.01, door + gap, 2.0))
        along, across, up = np.eye(3), geo.rotation((0, 0, 1), np.pi / 2), geo.rotation((1, 0, 0), -np.pi / 2)
        front = (-w / 2, -d / 2 - t, 0)
        places = [
            (along, front), (along, (-w / 2, d / 2, 0)),
            (across, front), (across, (w / 2 + t, -d / 2 - t, 0)), (up, (-w / 2, -d / 2, h + t)),
        ]  # fmt: skip

        def place(mesh: Mesh, side: int) -> Mesh:
            turn, at = places[side]
            return mesh.rotated(turn).moved(*at)

        # Most rooms are painted light: light that fills the shadows is part of what makes an interior.
        same, light_paint = rng.random() < 0.6, rng.random() < 0.65

        def paint() -> mat.Bsdf:
            image = tex.pattern(rng, 0.35)
            return mat.structure(rng, 0.92 * image**0.45 if light_paint else image)

        shared = paint()
        dressing = mat.thing(rng, tex.plain(rng))
        for side in range(5):
            mesh = geo.wall(lengths[side], heights[side], t, holes[side]).tiled(rng.choice([0.4, 0.7, 1.0, 1.5]))
            white = mat.diffuse(np.broadcast_to(tex.color(rng, 0.4, 0.85), (2, 2, 3)))
            bsdf = white if side == 4 and rng.random() < 0.7 else shared if same else paint()
            self.add(place(mesh, side), bsdf)
            for x0, z0, x1, z1 in holes[side]:

                def in_window(m: Mesh, x: float = x0, z: float = z0, side: int = side) -> Mesh:
                    return place(m.moved(x, t / 2, z), side)

                if gap and side == 0:
                    self._hall(x0, x1, lambda m: place(m, 0))
                    continue
                self._dress_window(x1 - x0, z1 - z0, in_window, dressing)
                if daylight:
                    low, high, y = x0 - 0.1, x1 + 0.1, t + 0.1
                    corners = [[low, y, z0], [high, y, z0], [high, y, z1 + 0.1], [low, y, z1 + 0.1]]
                    if side in (0, 3, 4):  # walls whose y = 0 is the outer face
                        corners = [[x, -0.1, z] for x, _, z in corners[::-1]]
                    self.light(place(geo.quads(np.array([corners])), side), self.tinted_light(daylight, 0.1))
        floor = geo.box((-w / 2 - t, -d / 2 - t, -0.2), (w / 2 + t, d / 2 + t, 0)).tiled(
            rng.choice([0.4, 0.7, 1.2, 2.0])
        )
        self.add(floor, mat.structure(rng, tex.pattern(rng, 0.12) ** rng.choice([0.6, 1.0])))

    def _hole(self, side: int, length: float, height: float) -> tuple[float, float, float, float]:
        """Draw a window, a door gap or a skylight: its corners (x0, z0, x1, z1) in its wall."""
        rng = self.rng
        if rng.random() < 0.15 and side < 4:  # a door left ajar
            x = rng.uniform(0.2, length - 1)
            return x, 0.01, x + rng.uniform(0.04, 0.4), 2.0
        a, b = rng.uniform(*_WINDOW, 2)
        x = rng.uniform(0.2, max(length - a - 0.2, 0.25))
        z = rng.uniform(0.3 * height, max(height - b - 0.1, 0.31 * height))
        return x, z, min(x + a, length - 0.2), min(z + b, height - 0.05)

    def _hall(self, x0: float, x1: float, place: Callable[[Mesh], Mesh]) -> None:
        """Add a closed space outside the gap from x0 to x1 of the front wall; its lamp is seldom seen from the room."""
        rng = self.rng
        low, high = np.array([x0 - rng.uniform(0.5, 1.5), -rng.uniform(1.0, 2.0), 0]), np.array([x1 + 1.0, 0, 2.3])
        (a, b, c), (d, e, f) = low, high
        sides = [
            [[a, b, c], [d, b, c], [d, b, f], [a, b, f]], [[a, b, c], [a, e, c], [a, e, f], [a, b, f]],
            [[d, b, c], [d, e, c], [d, e, f], [d, b, f]], [[a, b, f], [d, b, f], [d, e, f], [a, e, f]],
        ]  # fmt: skip
        self.add(place(geo.quads(np.array(sides))), mat.diffuse(np.full((2, 2, 3), rng.uniform(0.5, 0.85))))
        r = rng.uniform(0.03, 0.15)
        lamp = low + np.array([0.2, 0.2, 0.2]) + rng.random(3) * (0.6, 0.5, 0.8) * (high - low - 0.4)
        self.light(place(geo.sphere(r, 16).moved(*lamp)), self.tinted_light(5 / r**2, 0.1))

    def _dress_window(self, w: float, h: float, place: Callable[[Mesh], Mesh], bsdf: mat.Bsdf) -> None:
        rng = self.rng
        kind = rng.random()
        if kind < 0.25:
            self.add(place(geo.bars(w, h, max(int(h / 0.05), 3), 0.02, True)), bsdf)
        elif kind < 0.5:
            self.add(place(geo.bars(w, h, int(rng.integers(2, 7)), 0.025, False)), bsdf)
        if rng.random() < 0.12:
            pane = geo.quads(np.array([[[0, 0, 0], [w, 0, 0], [w, 0, h], [0, 0, h]]], float))
            self.add(place(pane), mat.pane())

    def furnish(self, pieces: int) -> None:
        """Furniture along walls and about the floor, pictures and mirrors, things on the floor."""
        rng = self.rng
        w, d, _ = self.size
        taken: list[np.ndarray] = []
        for _ in range(pieces * 4):
            if len(taken) == pieces:
                break
            along = rng.random() < 0.6
            p = np.array([rng.uniform(-w / 2 + 0.6, w / 2 - 0.6), rng.uniform(-d / 2 + 0.6, d / 2 - 0.6), 0])
            angle = rng.uniform(0, 6.3)
            if along:
                side = rng.integers(4)
                angle = side * np.pi / 2
                p[1 - side % 2] = ((1, -1, -1, 1)[side]) * (d, w)[side % 2] / 2 * 1.0
                p[1 - side % 2] -= np.sign(p[1 - side % 2]) * 0.45
            if all(np.hypot(*(p - q)[:2]) > 1.0 for q in taken):
                taken.append(p)
                self.furniture(p, angle)
        for _ in range(rng.integers(1, 6)):
            at = np.array([rng.uniform(-w / 2 + 0.3, w / 2 - 0.3), rng.uniform(-d / 2 + 0.3, d / 2 - 0.3), 0])
            self.put(at, rng.uniform(0.15, 0.8))
        for _ in range(rng.integers(0, 5)):
            self._picture()
        if rng.random() < 0.25:
            at = np.array([rng.uniform(-w / 3, w / 3), rng.uniform(-d / 3, d / 3), 0])
            rail = geo.bars(rng.uniform(1, 2.5), rng.uniform(0.7, 1.1), int(rng.integers(8, 40)), 0.015, False)
            self.add(rail.turned(rng.uniform(0, 6.3)).moved(*at), mat.thing(rng, None, 0.5, 0.0))
        if rng.random() < 0.2:
            steps = geo.stairs(rng.uniform(0.8, 1.4), 0.26, 0.18, int(rng.integers(4, 11)))
            self.add(steps.moved(rng.uniform(-w / 4, w / 4), d / 2 - 2.6, 0), mat.structure(rng))
        if rng.random() < 0.3:
            self._rug()

    def _rug(self) -> None:
        rng = self.rng
        w, d, _ = self.size
        a, b = rng.uniform(0.8, 2.0, 2)
        at = np.array([rng.uniform(-w / 4, w / 4), rng.uniform(-d / 4, d / 4), 0.004])
        roots = np.c_[rng.uniform(-a / 2, a / 2, 12000), rng.uniform(-b / 2, b / 2, 12000), np.zeros(12000)] + at
        pile = geo.blades(rng, roots, 0.04, 0.006, 0.8)
        pile.uv = roots[:, :2].repeat(5, 0)
        self.add(pile, mat.diffuse(tex.pattern(rng, 0.1)))

    def _picture(self) -> None:
        rng = self.rng
        w, d, h = self.size
        a, b = rng.uniform(0.25, 1.1, 2)
        side, z = rng.integers(4), rng.uniform(0.9, h - 0.7)
        frame = geo.box((-a / 2 - 0.03, 0, -b / 2 - 0.03), (a / 2 + 0.03, 0.02, b / 2 + 0.03))
        face = geo.quads(np.array([[[-a, 0.022, -b], [a, 0.022, -b], [a, 0.022, b], [-a, 0.022, b]]]) / (2, 1, 2))
        kind = rng.random()
        image = self.assets.picture(rng) if self.assets.hdris and kind < 0.4 else tex.pattern(rng, 0.0)
        if kind < 0.4 and self.assets.hdris:
            self.sources.add("hdri/* as pictures (CC0, Poly Haven)")
        bsdf = mat.mirror(np.full((2, 2, 3), 0.9)) if kind > 0.85 else mat.thing(rng, image)
        # Facing -y of its wall means facing the room: turn so that local +y points inwards.
        angle = (0, -np.pi / 2, np.pi, np.pi / 2)[side]
        half = (d, w)[side % 2] / 2
        inwards = np.array([-np.sin(angle), np.cos(angle), 0])
        sideways = np.array([np.cos(angle), np.sin(angle), 0]) * rng.uniform(-0.35, 0.35) * (w, d)[side % 2]
        at = -inwards * half + sideways + (0, 0, z)
        self.add(frame.turned(angle).moved(*at), mat.thing(rng, None, 0.4, 0.0))
        self.add(face.turned(angle).moved(*at), bsdf)
        self.focus.append(at)

    def inside(self, low: float, high: float) -> np.ndarray:
        """Draw a point in the room with its height between two shares of the room's."""
        w, d, h = self.size
        rng = self.rng
        return np.array([rng.uniform(-0.42, 0.42) * w, rng.uniform(-0.42, 0.42) * d, rng.uniform(low, high) * h])

    # -- lamps of rooms ----------------------------------------------------------------------------

    def lamp_tiny(self) -> None:
        """Add a small bright ball, or a point that no ray can hit."""
        if self.rng.random() < 0.2:
            origin, intensity = self.inside(0.3, 0.95).tolist(), self.tinted_light(1.0).tolist()
            point = {"type": "point", "position": origin, "intensity": {"type": "rgb", "value": intensity}}
            self.parts[f"point{len(self.parts)}"] = mi.load_dict(point)
            return
        r = 10 ** self.rng.uniform(-2.1, -1.2)
        self.light(geo.sphere(r, 16).moved(*self.inside(0.3, 0.95)), self.tinted_light(0.3 / r**2))

    def lamp_shade(self) -> None:
        """Add a bulb in an opaque shade, open above and below: on a stand or hanging."""
        rng = self.rng
        r, h = rng.uniform(0.1, 0.25), rng.uniform(0.15, 0.35)
        hanging = rng.random() < 0.5
        at = self.inside(0.55, 0.85) if hanging else self.inside(0.4, 0.5)
        z = np.linspace(0, h, 6)
        shade = geo.lathe(np.stack([r * (1 - rng.uniform(0, 0.6) * z / h), z], 1))
        self.add(shade.moved(*at), mat.thing(rng, None, 0.2, 0.0))
        bulb = rng.uniform(0.015, 0.05)
        self.light(geo.sphere(bulb, 16).moved(*(at + (0, 0, h * 0.5))), self.tinted_light(0.4 / bulb**2))
        rod = (at[2], self.size[2]) if hanging else (0, at[2] + h * 0.4)
        rod_mesh = geo.cylinder(0.008, rod[1] - rod[0] - (0.0 if not hanging else h)).moved(*at[:2], rod[0])
        self.add(rod_mesh if not hanging else rod_mesh.moved(0, 0, h), mat.metal(rng))
        self.focus.append(at)

    def lamp_indirect(self) -> None:
        """Add a panel a hand's breadth from a wall or the ceiling, facing it."""
        rng = self.rng
        w, d, h = self.size
        a, b, gap = rng.uniform(0.2, 1.2), rng.uniform(0.1, 0.4), rng.uniform(0.05, 0.25)
        panel = geo.rectangle(a, b)
        back = geo.box((-a / 2 - 0.02, -b / 2 - 0.02, -0.03), (a / 2 + 0.02, b / 2 + 0.02, -0.005))
        if rng.random() < 0.5:
            turn, at = np.eye(3), np.array([*rng.uniform(-0.35, 0.35, 2) * (w, d), h - gap])
        else:
            turn = geo.rotation((1, 0, 0), np.pi / 2)
            at = np.array([rng.uniform(-0.35, 0.35) * w, -d / 2 + gap, rng.uniform(0.3, 0.9) * h])
        self.light(panel.rotated(turn).moved(*at), self.tinted_light(2 / (a * b)))
        self.add(back.rotated(turn).moved(*at), mat.thing(rng, tex.plain(rng)))

    def lamp_hidden(self) -> None:
        """Add a light behind a partition."""
        rng = self.rng
        at = self.inside(0.0, 0.0) * (0.8, 0.8, 1)
        angle = rng.choice([0, np.pi / 2])
        partition = geo.box((-1, -0.04, 0), (1, 0.04, rng.uniform(0.6, 0.95) * self.size[2]))
        self.add(partition.turned(angle).moved(*at), mat.structure(rng))
        r = rng.uniform(0.02, 0.12)
        offset = geo.rotation((0, 0, 1), angle) @ np.array([rng.uniform(-0.6, 0.6), 0.35, rng.uniform(0.3, 1.6)])
        self.light(geo.sphere(r, 16).moved(*(at + offset)), self.tinted_light(0.5 / r**2))

    def lamp_spot(self) -> None:
        power = self.tinted_light(10 ** self.rng.uniform(0, 1.2)).tolist()
        origin, target, angle = self.inside(0.7, 0.95).tolist(), self.inside(0, 0.4).tolist(), self.rng.uniform(8, 35)
        self.parts[f"spot{len(self.parts)}"] = mi.load_dict({
            "type": "spot", "intensity": {"type": "rgb", "value": power},
            "cutoff_angle": float(angle), "beam_width": float(angle * 0.7),
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0.1, 0.2, 1]),
        })  # fmt: skip

    def lamp_panel(self) -> None:
        rng = self.rng
        a, b = rng.uniform(0.2, 1.0, 2)
        panel = geo.rectangle(a, b).rotated(geo.rotation((1, 0, 0), np.pi))
        x, y = rng.uniform(-0.3, 0.3, 2) * self.size[:2]
        self.light(panel.moved(x, y, self.size[2] - 0.02), self.tinted_light(1.5 / (a * b)))

    def lamp_string(self, count: int) -> None:
        """Many small coloured lights along a wire or scattered."""
        rng = self.rng
        scattered, by_power = rng.random() < 0.4, rng.random() < 0.6
        a, b = self.inside(0.4, 0.9), self.inside(0.4, 0.9)
        for i in range(count):
            t = i / max(count - 1, 1)
            p = self.inside(0.05, 0.9) if scattered else a + t * (b - a) - (0, 0, 1.2 * t * (1 - t))
            r = rng.uniform(0.012, 0.05)
            power = 10 ** rng.uniform(-2.3, -0.3)
            mesh = geo.sphere(r, 10).moved(*p)
            self.light(mesh, self.tinted_light(power / r**2, tint=0.8), power if by_power else 1.0)


# -- kinds of scenes -------------------------------------------------------------------------------


def window_room(s: Scene) -> None:
    """Build a closed room lit through small openings only."""
    panels = 10 ** s.rng.uniform(0.3, 1.5) if s.rng.random() < 0.85 else 0.0
    # By the sky alone it takes more openings, or nothing arrives.
    s.shell(int(s.rng.integers(1, 4) if panels else s.rng.integers(4, 9)), daylight=panels)
    if not panels or s.rng.random() < 0.3:
        s.environment(10 ** s.rng.uniform(-0.5, 0.5))
    s.furnish(int(s.rng.integers(3, 9)))
    s.clutter((1, 6))
    if s.rng.random() < 0.2:
        s.lamp_tiny()


def lamp_room(s: Scene) -> None:
    """Build a room without daylight: one to three difficult lamps."""
    s.shell(0)
    s.furnish(int(s.rng.integers(3, 9)))
    s.clutter((1, 6))
    lamps = [
        s.lamp_tiny, s.lamp_tiny, s.lamp_shade, s.lamp_shade,
        s.lamp_indirect, s.lamp_hidden, s.lamp_spot, s.lamp_panel,
    ]  # fmt: skip
    for _ in range(s.rng.integers(1, 4)):
        lamps[s.rng.integers(len(lamps))]()


def ajar_room(s: Scene) -> None:
    """Build a room where light is rare: it comes through a door ajar, and perhaps from a weak small lamp."""
    s.shell(0, (2.5, 5.0), gap=float(10 ** s.rng.uniform(-1.2, -0.4)))
    s.furnish(int(s.rng.integers(2, 7)))
    s.clutter((1, 5), clear=0.3)
    if s.rng.random() < 0.3:
        s.lamp_hidden()


def many_lights(s: Scene) -> None:
    """Build a room with dozens of small lights. A sample picks one of them."""
    s.shell(int(s.rng.random() < 0.3))
    s.environment(10 ** s.rng.uniform(-1.5, -0.5))
    s.furnish(int(s.rng.integers(2, 7)))
    s.clutter((1, 5), shiny=0.4)
    s.lamp_string(int(s.rng.integers(10, 60)))


def caustics(s: Scene) -> None:
    """Glass and metal over a matt table, small bright lights."""
    rng = s.rng
    s.shell(0, (2.5, 4.5))
    top = geo.table(1.8, 1.2, 0.75, 0.07)
    s.add(top.tiled(rng.uniform(0.5, 2)), mat.diffuse(tex.pattern(rng, 0.3)))
    s.surfaces.append((np.array([0, 0, 0.75]), 0.7, 0.45))
    s.clutter((5, 14), shiny=0.25, clear=0.5)
    s.furnish(int(rng.integers(0, 4)))
    lamps = [s.lamp_tiny, s.lamp_tiny, s.lamp_shade, s.lamp_panel]
    for _ in range(rng.integers(1, 4)):
        lamps[rng.integers(len(lamps))]()


def outdoors(s: Scene) -> None:
    """Ground, grass, fences, trees, rocks, walls under a sky."""
    rng = s.rng
    s.environment(10 ** rng.uniform(-0.5, 0.5), 0.55)
    s.add(geo.rectangle(80, 80).tiled(rng.choice([0.1, 0.3, 0.6])), mat.diffuse(tex.pattern(rng, 0.1)))
    if rng.random() < 0.6:
        count, spread = int(rng.integers(5000, 30000)), rng.uniform(1.0, 4.0)
        roots = np.c_[rng.normal(size=(count, 2)) * spread, np.zeros(count)]
        grass = geo.blades(rng, roots, rng.uniform(0.08, 0.5), rng.uniform(0.004, 0.015), rng.uniform(0.1, 0.8))
        s.add(grass, mat.glossy(tex.foliage(rng), 0.35) if rng.random() < 0.4 else mat.diffuse(tex.foliage(rng)))
    for _ in range(rng.integers(0, 4)):
        x, y = rng.normal(size=2) * 3
        height = rng.uniform(1.5, 5)
        trunk, tips = geo.branching(rng, height, 0.03 * height, 3)
        s.add(trunk.moved(x, y, 0), mat.diffuse(tex.wood(rng)))
        centres = np.repeat(tips, 4, 0) + rng.normal(size=(4 * len(tips), 3)) * 0.15 + (x, y, 0)
        s.add(geo.leaves(rng, centres, rng.uniform(0.05, 0.2)), mat.diffuse(tex.foliage(rng)))
        s.focus.append(np.array([x, y, height * 0.6]))
    for _ in range(rng.integers(1, 4)):
        p = np.array([*rng.normal(size=2) * 3, 0])
        length, angle = rng.uniform(2, 6), rng.uniform(0, 6.3)
        if rng.random() < 0.6:
            fence = geo.bars(length, rng.uniform(0.5, 1.5), int(length / rng.uniform(0.04, 0.2)), 0.02, False)
            s.add(fence.moved(-length / 2, 0, 0).turned(angle).moved(*p), mat.thing(rng, None, 0.3, 0.0))
        else:
            hole = (length * 0.3, 0.6, length * 0.6, 1.5)
            house = geo.wall(length, rng.uniform(1.8, 4), 0.25, [hole])
            s.add(house.moved(-length / 2, 0, 0).turned(angle).moved(*p), mat.structure(rng, tex.pattern(rng, 0.1)))
        s.focus.append(p + (0, 0, 0.6))
    for _ in range(rng.integers(3, 12)):
        s.put(np.array([*rng.normal(size=2) * 1.5, 0]), 10 ** rng.uniform(-0.9, 0.2), 0.3, 0.1)


def studio(s: Scene) -> None:
    """Build an easy scene: objects on a ground under large lights or an open environment."""
    rng = s.rng
    s.add(geo.rectangle(20, 20).tiled(rng.uniform(0.3, 2)), mat.structure(rng))
    if rng.random() < 0.5:
        s.environment(1.0, 0.7)
    for _ in range(rng.integers(1, 4)):
        a = rng.uniform(0, 6.3)
        panel = geo.rectangle(*rng.uniform(0.5, 2.5, 2)).rotated(geo.rotation((1, 0, 0), np.pi))
        tilt = geo.rotation((-np.sin(a), np.cos(a), 0), rng.uniform(0, 0.9))
        at = tilt @ np.array([0, 0, rng.uniform(2.0, 4.0)])
        s.light(panel.rotated(tilt).moved(*at), s.tinted_light(10 ** rng.uniform(0, 0.8)))
    for _ in range(rng.integers(4, 16)):
        s.put(np.array([*rng.normal(size=2) * 0.6, 0]), rng.uniform(0.15, 0.7), 0.3, 0.1)
    if rng.random() < 0.5:
        s.furniture(np.array([*rng.normal(size=2), 0]), rng.uniform(0, 6.3))
        s.clutter((1, 4))


def lit_room(s: Scene) -> None:
    """Build a room under large panels: easier than a real one."""
    s.shell(int(s.rng.integers(0, 3)))
    s.environment(10 ** s.rng.uniform(-0.7, 0.3))
    s.furnish(int(s.rng.integers(2, 8)))
    s.clutter((1, 6))
    for _ in range(s.rng.integers(1, 3)):
        s.lamp_panel()


KINDS: dict[Callable[[Scene], None], float] = {
    window_room: 0.27, lamp_room: 0.18, ajar_room: 0.12, many_lights: 0.08, caustics: 0.08,
    outdoors: 0.12, studio: 0.10, lit_room: 0.14,
}  # fmt: skip


def _drawn(seed: int) -> tuple[Callable[[Scene], None], Rng]:
    """Return the kind of a seed's scene, and the random numbers that follow."""
    rng = np.random.default_rng([seed, VERSION])
    return list(KINDS)[rng.choice(len(KINDS), p=np.array(list(KINDS.values())) / sum(KINDS.values()))], rng


def kind_of(seed: int) -> str:
    """Return the name of the kind of a seed's scene, one of ``KINDS``."""
    return _drawn(seed)[0].__name__


def build(seed: int, assets: Assets) -> tuple[mi.Scene, Scene]:
    """Build the Mitsuba scene of a seed, and its plan."""
    kind, rng = _drawn(seed)
    plan = Scene(rng, assets)
    plan.kind = kind.__name__
    kind(plan)
    return plan.finish(), plan


def camera(plan: Scene, rng: Rng) -> Camera:
    """Draw a random camera. The caller checks that it shows something."""
    target = plan.focus[rng.integers(len(plan.focus))] + rng.normal(size=3) * 0.15
    if plan.room is not None:
        w, d, h = plan.room
        origin = np.array([*(rng.uniform(-0.46, 0.46, 2) * (w, d)), rng.uniform(0.12, 0.75) * h])
        if rng.random() < 0.35:  # a close-up
            away = origin - target
            origin = target + away / np.linalg.norm(away) * min(rng.uniform(0.4, 1.4), np.linalg.norm(away))
            origin = np.clip(origin, (-0.47 * w, -0.47 * d, 0.1), (0.47 * w, 0.47 * d, h - 0.1))
        fov = rng.uniform(*((18, 35), (35, 85), (35, 85), (85, 110))[rng.integers(4)])
    else:
        a, distance = rng.uniform(0, 6.3), 10 ** rng.uniform(-0.2, 0.6)
        origin = target + (distance * np.cos(a), distance * np.sin(a), 0)
        origin[2] = rng.uniform(0.08, 0.5 + distance * 0.6)
        fov = rng.uniform(25, 70)
    distance = float(np.linalg.norm(target - origin))
    blurred = rng.random() < 0.25
    x, y, z = map(float, origin)
    to_x, to_y, to_z = map(float, target)
    return Camera(
        (x, y, z), (to_x, to_y, to_z), float(fov),
        aperture=float(distance * 10 ** rng.uniform(-2.2, -1.3)) if blurred else 0.0,
        focus=distance * float(rng.uniform(0.7, 1.3)) if blurred else 1.0,
        roll=float(rng.normal() * 0.06),
    )  # fmt: skip
